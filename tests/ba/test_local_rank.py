"""Images and cameras that their own measurements leave open are found, named and held, whatever the others know."""

import dataclasses
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from small_problems import EVERY_CAMERA, small_problem

import jaxba
from jaxba._errors import JaxbaError
from jaxba.ba import AttitudePrior, IntrinsicsPrior, PositionPrior, Problem, prepare
from jaxba.ba._projection import points_in_cam, project
from jaxba.ba.checks._check import Reason
from jaxba.ba.checks._local_rank import pose_ranks, undetermined_intrinsics
from jaxba.geometry import AbstractCamera, OpenCV, Pinhole
from jaxba.simulation import uav_block

IMAGE = 3


@pytest.fixture(scope="module")
def block() -> Problem:
    problem = uav_block(8, gnss_std_m=None).problem.fix(intrinsics=True)
    return dataclasses.replace(problem, image_names=tuple(f"DJI_{i:04d}.JPG" for i in range(8)))


def with_points(problem: Problem, count: int, *, on_line: bool = False) -> Problem:
    """Leave an image so many points, on one line in space if asked."""
    seen = problem.observations
    times = np.bincount(seen.point_index)
    of_image = np.flatnonzero((seen.image_index == IMAGE) & (times[seen.point_index] > 3))
    points = np.array(problem.points)
    if on_line:
        first, last = points[seen.point_index[of_image[:2]]]
        points[seen.point_index[of_image[:count]]] = first + np.linspace(0, 1, count)[:, None] * (last - first)
    kept = np.sort(np.append(np.flatnonzero(seen.image_index != IMAGE), of_image[:count]))
    kept = kept[np.bincount(seen.point_index[kept])[seen.point_index[kept]] > 1]
    unseen = np.setdiff1d(np.arange(len(points)), seen.point_index[kept])
    problem = problem.fix(points=unseen)
    problem = dataclasses.replace(problem, points=points)
    return eqx.tree_at(lambda p: p.observations, problem, jax.tree.map(lambda a: a[kept], seen))


def position(problem: Problem, std_m: tuple[float, float, float] = (0.02, 0.02, 0.05)) -> PositionPrior:
    centers = -np.einsum("nji,nj->ni", problem.poses.rotation, np.asarray(problem.poses.translation))
    return PositionPrior(np.array([IMAGE]), centers[[IMAGE]], np.array([std_m]))


def attitude(problem: Problem, std_rad: tuple[float, float, float] = (0.01, 0.01, 0.01)) -> AttitudePrior:
    return AttitudePrior(np.array([IMAGE]), np.asarray(problem.poses.quaternion)[[IMAGE]], np.array([std_rad]))


LEVEL, FLAT = (0.01, 0.01, np.inf), (0.02, 0.02, np.inf)
RANKS = {
    "one point": (1, False, (), 2),
    "two points": (2, False, (), 4),
    "three points": (3, False, (), 6),
    "five points on a line": (5, True, (), 5),
    "a point and a position": (1, False, (position,), 5),
    "a point and a distant position": (1, False, (lambda p: position(p, (1e6, 1e-6, 1e3)),), 5),
    "two points and a position": (2, False, (position,), 6),
    "a point and an attitude": (1, False, (attitude,), 5),
    "a point, position and attitude": (1, False, (position, attitude), 6),
    "a point, flat position and attitude": (1, False, (lambda p: position(p, FLAT), attitude), 6),
    "a point and nothing measured": (1, False, (lambda p: position(p, (np.inf,) * 3),), 2),
    "two points and level": (2, False, (lambda p: attitude(p, LEVEL),), 6),
    "a line and a position": (5, True, (position,), 6),
}


@pytest.mark.parametrize("case", RANKS)
def test_rank_of_a_pose_is_that_of_its_dense_jacobian(block: Problem, case: str):
    count, on_line, priors, rank = RANKS[case]
    problem = with_points(block, count, on_line=on_line)
    problem = dataclasses.replace(problem, priors=tuple(prior(problem) for prior in priors))
    every = np.arange(problem.num_observations)
    ranks = pose_ranks(problem, every, points_in_cam(problem))
    assert ranks[IMAGE] == rank == dense_rank(problem)
    assert np.all(np.delete(ranks, IMAGE) == 6)


def dense_rank(problem: Problem) -> int:
    """Rank by central differences of pixels and of finite prior residuals by the pose's step."""
    observation = np.flatnonzero(problem.observations.image_index == IMAGE)
    columns = []
    for step in 1e-4 * np.eye(6):
        sides = []
        for sign in (1, -1):
            steps = np.zeros((8, 6))
            steps[IMAGE] = sign * step * np.repeat([1, 100], 3)
            moved = eqx.tree_at(
                lambda p: p.poses, problem, jax.tree.map(np.asarray, problem.poses.retract(jnp.asarray(steps)))
            )
            values = [project(moved, points_in_cam(moved)[:, observation], observation).ravel()]
            for prior in problem.priors:
                rotation = np.asarray(moved.poses.rotation)[IMAGE]
                measured = -rotation.T @ np.asarray(moved.poses.translation)[IMAGE]
                if isinstance(prior, AttitudePrior):
                    measured = 100 * (rotation @ np.asarray(problem.poses.rotation)[IMAGE].T)[[2, 0, 1], [1, 2, 0]]
                std = prior.std_rad if isinstance(prior, AttitudePrior) else prior.std_m
                values.append(100 * measured[np.isfinite(std[0])])
            sides.append(np.concatenate(values))
        columns.append(sides[0] - sides[1])
    singular = np.linalg.svd(np.array(columns), compute_uv=False)
    return int(np.count_nonzero(singular > 1e-5 * singular[0]))


@pytest.mark.parametrize("case", RANKS)
def test_an_open_image_is_held_and_named(block: Problem, case: str):
    count, on_line, priors, rank = RANKS[case]
    problem = with_points(block, count, on_line=on_line)
    problem = dataclasses.replace(problem, priors=tuple(prior(problem) for prior in priors))
    prepared = prepare(problem)
    if rank == 6:
        assert prepared.problem is problem
        return
    dropped = prepared.dropped
    assert dropped.images.tolist() == [IMAGE] and dropped.ranks.tolist() == [rank]
    assert dropped.count(Reason.WEAK_IMAGE) == count and not prepared.problem.free.poses[IMAGE]
    assert dropped.summary()[-1] == (
        f"1 image with too few points held fixed, {count} observation{'s' * (count > 1)} left out (number 3 "
        f"DJI_0003.JPG): what they see and their priors determine {rank} of a pose's 6 unknowns"
    )
    for prior in prepared.problem.priors:
        assert not np.isfinite(prior.std_m if isinstance(prior, PositionPrior) else prior.std_rad).any()


def test_a_fixed_image_may_see_one_point(block: Problem):
    assert not prepare(with_points(block, 1).fix(poses=[IMAGE])).dropped.any()


def test_what_an_open_image_alone_saw_goes_with_it(block: Problem):
    """Points that it shares with one other image are then seen once."""
    problem = with_points(block, 2)
    seen = problem.observations
    mine = seen.point_index[seen.image_index == IMAGE]
    others = [np.flatnonzero((seen.point_index == point) & (seen.image_index != IMAGE)) for point in mine]
    kept = np.setdiff1d(np.arange(len(seen.point_index)), np.concatenate([other[1:] for other in others]))
    problem = eqx.tree_at(lambda p: p.observations, problem, jax.tree.map(lambda a: a[kept], seen))
    dropped = prepare(problem).dropped
    assert dropped.images.tolist() == [IMAGE] and dropped.points.tolist() == sorted(mine)
    assert dropped.count(Reason.SEEN_ONCE) == dropped.count(Reason.WEAK_IMAGE) == 2


def test_images_that_all_see_too_little_are_refused(block: Problem):
    seen = block.observations
    pairs = np.isin(seen.point_index, np.unique(seen.point_index)[:2])
    problem = eqx.tree_at(lambda p: p.observations, block, jax.tree.map(lambda a: a[pairs], seen))
    with pytest.raises(JaxbaError, match=r"No observation is left .* in images that see too few points"):
        prepare(problem)


def own_camera(camera: AbstractCamera, count: int) -> Problem:
    """Every image has a camera of its own; one image is left so many points."""
    cameras = uav_block(8, gnss_std_m=None, num_cameras=8, camera=camera).problem
    return with_points(cameras, count)


@pytest.mark.parametrize(
    ("camera", "count", "held"),
    [
        (Pinhole(3650.0, 3650.0, 2736.0, 1824.0), 3, {"fx", "fy", "cx", "cy"}),
        (Pinhole(3650.0, 3650.0, 2736.0, 1824.0), 4, {"fx", "fy", "cx", "cy"}),
        (Pinhole(3650.0, 3650.0, 2736.0, 1824.0), 8, set()),
        (
            OpenCV(3650.0, 3650.0, 2736.0, 1824.0, -0.05, 0.01, 0.0, 0.0),
            6,
            {"fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2"},
        ),
        (OpenCV(3650.0, 3650.0, 2736.0, 1824.0, -0.05, 0.01, 0.0, 0.0), 12, set()),
    ],
)
def test_intrinsics_of_a_camera_with_few_points_are_held(camera: AbstractCamera, count: int, held: set[str]):
    problem = own_camera(camera, count)
    prepared = prepare(problem)
    names = np.array(camera.parameter_names())
    assert set(names[prepared.dropped.intrinsics[IMAGE]]) == held
    assert not np.delete(prepared.dropped.intrinsics, IMAGE, axis=0).any()
    assert len(prepared.dropped.images) == 0
    if held:
        said = prepared.dropped.summary()[-1]
        assert said.startswith("1 camera with intrinsics held fixed that its observations and priors do not determine")
        assert (
            "number 3 " in said
            and not (prepared.problem.free.intrinsics[IMAGE] & prepared.dropped.intrinsics[IMAGE]).any()
        )
        calibrated = IntrinsicsPrior(np.array([IMAGE]), own_values(problem)[[IMAGE]], np.full((1, len(names)), 0.1))
        assert not prepare(dataclasses.replace(problem, priors=(calibrated,))).dropped.intrinsics.any()


def own_values(problem: Problem) -> np.ndarray:
    names = problem.cameras.parameter_names()
    return np.stack([np.asarray(getattr(problem.cameras, name)) for name in names], axis=1)


def test_a_flat_nadir_block_leaves_focal_length_and_height_open():
    """Level images of a plane: focal length and height, principal point and position take each other's place."""
    problem = uav_block(
        8, gnss_std_m=None, attitude_jitter_rad=0.0, attitude_error_rad=0.0, terrain_relief_m=0.0, point_error_m=0.0,
        camera=Pinhole(3650.0, 3650.0, 2736.0, 1824.0), position_jitter_m=0.0,
    ).problem  # fmt: skip
    dropped = prepare(problem).dropped
    assert dropped.summary() == [
        "1 camera with intrinsics held fixed that its observations and priors do not determine "
        "(number 0 fx, fy, cx, cy)"
    ]
    centers = -np.einsum("nji,nj->ni", problem.poses.rotation, np.asarray(problem.poses.translation))
    measured = PositionPrior(np.arange(8), centers, np.full((8, 3), 0.02))
    assert not prepare(dataclasses.replace(problem, priors=(measured,))).dropped.any()


@pytest.mark.parametrize("camera", EVERY_CAMERA, ids=lambda c: type(c).__name__)
def test_small_problems_are_determined(camera: AbstractCamera):
    problem: Any = dataclasses.replace(small_problem(camera, num_cameras=2), priors=())
    every = np.arange(problem.num_observations)
    assert not undetermined_intrinsics(problem, every, points_in_cam(problem)).any()


def test_solving_holds_what_is_open(block: Problem):
    problem = dataclasses.replace(with_points(block, 2), priors=())
    solution = jaxba.solve(problem, loss=jaxba.Huber(1.0))
    assert solution.converged
    np.testing.assert_array_equal(solution.poses.translation[IMAGE], problem.poses.translation[IMAGE])
