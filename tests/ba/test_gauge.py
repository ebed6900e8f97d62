"""Free directions equal the null space of a dense Jacobian, and are called what they are."""

import dataclasses

import equinox as eqx
import jax
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from small_problems import RADIAL, small_problem

from jaxba._errors import JaxbaError
from jaxba.ba import Observations, Problem, free_gauge
from jaxba.ba.checks._gauge import require_gauge
from jaxba.ba.groups import (
    AttitudePrior,
    ControlPointPrior,
    IntrinsicsPrior,
    LeverArmPrior,
    PositionOffsetPrior,
    PositionPrior,
)
from jaxba.geometry import Pinhole, Pose
from jaxba.simulation import uav_block

TRANSLATIONS = ("translation x", "translation y", "translation z")
ROTATIONS = ("rotation about x", "rotation about y", "rotation about z")
ALL = (*TRANSLATIONS, *ROTATIONS, "scale")


def block(num_lines: int = 2, *, nadir: bool = False) -> Problem:
    """Eight images in lines along x over 60 points that all of them see, without priors; only geometry counts here."""
    rng = np.random.default_rng(0)
    centers = np.array([[20.0 * i, 30.0 * j, 100.0] for j in range(num_lines) for i in range(8 // num_lines)])
    points = rng.uniform([-20, -20, -5], [100, 50, 5], (60, 3))
    turn = np.zeros((8, 3)) if nadir else rng.normal(0, 0.1, (8, 3))
    down = Rotation.from_rotvec([np.pi, 0, 0])  # half a turn about x: the camera looks down
    poses = pose_of(Rotation.from_rotvec(turn) * down, centers)
    seen = Observations(np.zeros((480, 2)), np.ones(480), np.repeat(np.arange(8), 60), np.tile(np.arange(60), 8))
    return Problem.build(poses, Pinhole(1000.0, 1000.0, 500.0, 500.0), points, seen).fix(intrinsics=True)


def pose_of(rotation: Rotation, centers: np.ndarray) -> Pose:
    return Pose(rotation.as_quat(scalar_first=True), -rotation.apply(centers))


def rotation_and_centers(problem: Problem) -> tuple[Rotation, np.ndarray]:
    rotation = Rotation.from_quat(problem.poses.quaternion, scalar_first=True)
    return rotation, -rotation.inv().apply(problem.poses.translation)


def positions(problem: Problem, images: range = range(8), std_m: float = 0.05) -> PositionPrior:
    index = np.array(images, int)
    xyz = rotation_and_centers(problem)[1][index]
    return PositionPrior(image_index=index, xyz=xyz, std_m=np.full((len(index), 3), std_m))


def attitudes(problem: Problem, images: range) -> AttitudePrior:
    index = np.array(images, int)
    quaternion = np.asarray(problem.poses.quaternion)[index]
    return AttitudePrior(image_index=index, quaternion=quaternion, std_rad=np.full((len(index), 3), 0.01))


def control(
    problem: Problem, points: list[int], std_m: tuple[float, float, float] = (0.01, 0.01, 0.01)
) -> ControlPointPrior:
    std = np.tile(np.array(std_m), (len(points), 1))
    return ControlPointPrior(point_index=np.array(points), xyz=problem.points[points], std_m=std)


def calibration() -> IntrinsicsPrior:
    return IntrinsicsPrior(camera_index=np.zeros(1, int), parameters=np.ones((1, 4)), std=np.ones((1, 4)))


def given(problem: Problem, *priors: object, lever_arm: bool = False, position_offset: int = 0) -> Problem:
    free = dataclasses.replace(
        problem.free, lever_arm=np.array(lever_arm), position_offset=np.array(position_offset > 0)
    )
    return dataclasses.replace(problem, priors=priors, free=free, position_offset=np.zeros((position_offset, 3)))


def of_flights(prior: PositionPrior) -> PositionPrior:
    """Every second position has the second offset."""
    return dataclasses.replace(prior, offset_weights=np.eye(2)[np.asarray(prior.image_index) % 2])


def only_first(prior: PositionPrior) -> PositionPrior:
    """No position has the second offset."""
    return dataclasses.replace(prior, offset_weights=np.tile([1.0, 0.0], (len(prior.xyz), 1)))


CASES = {
    "nothing": (lambda p: p, ALL),
    "one pose": (lambda p: p.fix(poses=[2]), ("scale",)),
    "two poses": (lambda p: p.fix(poses=[2, 5]), ()),
    "one point": (lambda p: p.fix(points=[3]), (*ROTATIONS, "scale")),
    "pose and point": (lambda p: p.fix(poses=[0], points=[3]), ()),
    "three points": (lambda p: p.fix(points=[3, 8, 20]), ()),
    "all poses": (lambda p: p.fix(poses=True), ()),
    "all points": (lambda p: p.fix(points=True), ()),
    "positions": (lambda p: given(p, positions(p)), ()),
    "one position": (lambda p: given(p, positions(p, range(1))), (*ROTATIONS, "scale")),
    "attitudes": (lambda p: given(p, attitudes(p, range(8))), (*TRANSLATIONS, "scale")),
    "one attitude": (lambda p: given(p, attitudes(p, range(1))), (*TRANSLATIONS, "scale")),
    "position and attitude": (lambda p: given(p, positions(p, range(1)), attitudes(p, range(4, 5))), ("scale",)),
    "positions along a line": (lambda p: given(p, positions(p, range(4))), ("rotation about x",)),
    "line and attitude": (lambda p: given(p, positions(p, range(4)), attitudes(p, range(1))), ()),
    "line and control": (lambda p: given(p, positions(p, range(4)), control(p, [7])), ()),
    "control": (lambda p: given(p, control(p, [3, 8, 20])), ()),
    "level": (
        lambda p: given(p, control(p, [3, 8, 20], (np.inf, np.inf, 0.01))),
        # growth that lifts the three points is undone by a tilt
        ("translation x", "translation y", "rotation about x + rotation about y + scale", "rotation about z"),
    ),
    "plane": (lambda p: given(p, control(p, [3, 8], (0.01, 0.01, np.inf))), None),
    "calibration": (lambda p: given(p, calibration()), ALL),
    "no rows": (lambda p: given(p, positions(p, range(0)), attitudes(p, range(1))), (*TRANSLATIONS, "scale")),
    "hidden position": (lambda p: given(p, positions(p, std_m=np.inf)), ALL),
    "mixed sigmas": (lambda p: given(p, positions(p, std_m=1e-3), attitudes(p, range(8))), ()),
    "free lever arm": (lambda p: given(p, positions(p), lever_arm=True), ()),
    "free position offset": (
        lambda p: given(p, positions(p), position_offset=1),
        tuple(f"translation {a} + position offset {a}" for a in "xyz"),
    ),
    "position offset and control": (lambda p: given(p, positions(p), control(p, [3, 8, 20]), position_offset=1), ()),
    "position offset and a control point": (
        lambda p: given(p, positions(p), control(p, [3]), lever_arm=True, position_offset=1),
        (),
    ),
    "known position offset": (
        lambda p: given(
            p, positions(p), PositionOffsetPrior(np.zeros((1, 3)), np.full((1, 3), 0.5)), position_offset=1
        ),
        (),
    ),
    "offsets of two flights": (
        lambda p: given(p, of_flights(positions(p)), position_offset=2),
        tuple(f"translation {a} + position offset 0 {a} + position offset 1 {a}" for a in "xyz"),
    ),
    "offset of a flight without positions": (
        lambda p: given(p, only_first(positions(p)), control(p, [3, 8, 20]), position_offset=2),
        ("position offset 1 x", "position offset 1 y", "position offset 1 z"),
    ),
    "idle lever arm": (
        lambda p: given(p.fix(poses=[0, 7]), lever_arm=True),
        ("lever arm x", "lever arm y", "lever arm z"),
    ),
}


@pytest.mark.parametrize("case", CASES)
def test_free_directions_are_named(case: str):
    make, expected = CASES[case]
    found = free_gauge(make(block()))
    if expected is not None:
        assert found == expected
    assert len(found) == nullity(make(block()))


def nullity(problem: Problem) -> int:
    """Count the singular directions of the dense Jacobian of everything free, written out by hand."""
    antenna = problem.free_antenna
    free = np.concatenate([np.repeat(problem.free.poses, 6), np.repeat(problem.free.points, 3), antenna])
    jacobian = np.concatenate([pixel_rows(problem), *(prior_rows(prior, problem) for prior in problem.priors)])[:, free]
    jacobian /= np.maximum(np.linalg.norm(jacobian, axis=0), 1e-12)
    values = np.linalg.svd(jacobian, compute_uv=False)
    # the weakest real directions of these blocks lie near 1e-5, rounding below 1e-12
    return int(np.sum(values < 1e-9)) + max(0, jacobian.shape[1] - len(values))


def cross_matrix(vector: np.ndarray) -> np.ndarray:
    return np.cross(np.eye(3), vector)  # the rows e_i x v, so that cross_matrix(v) @ w = v x w


def pixel_rows(problem: Problem) -> np.ndarray:
    """Derivatives of the pixels by steps (w, v) of poses, points, lever arm and offset: p' = exp(w)(R x + t) + v."""
    rotation, _ = rotation_and_centers(problem)
    rotation, seen, images = rotation.as_matrix(), problem.observations, problem.num_images
    rows = np.zeros((len(seen.image_index), 2, images * 6 + problem.num_points * 3 + len(problem.antenna)))
    for row, i, j in zip(rows, seen.image_index, seen.point_index, strict=True):
        p = rotation[i] @ problem.points[j] + problem.poses.translation[i]
        of_p = 1000.0 / p[2] * np.array([[1, 0, -p[0] / p[2]], [0, 1, -p[1] / p[2]]])
        row[:, 6 * i : 6 * i + 6] = of_p @ np.concatenate([-cross_matrix(p), np.eye(3)], axis=1)
        at = 6 * images + 3 * j
        row[:, at : at + 3] = of_p @ rotation[i]
    return rows.reshape(-1, rows.shape[2])


def prior_rows(prior: object, problem: Problem) -> np.ndarray:
    """Derivatives of a prior's residuals by the same steps."""
    images, points = problem.num_images, problem.num_points
    arm = images * 6 + points * 3
    size = arm + len(problem.antenna)
    if isinstance(prior, IntrinsicsPrior):
        return np.zeros((0, size))
    index = getattr(prior, "image_index", getattr(prior, "point_index", np.zeros(1, int)))
    rows = np.zeros((len(index), 3, size))
    rotation = rotation_and_centers(problem)[0].as_matrix()
    for row, i in zip(rows, index, strict=True):
        if isinstance(prior, PositionPrior):  # R^T (arm - t) + offset, the lever arm being zero
            assert not np.any(problem.lever_arm)
            row[:, 6 * i + 3 : 6 * i + 6], row[:, arm : arm + 3] = -rotation[i].T, rotation[i].T
            if len(problem.position_offset):
                given = prior.offset_weights
                weights = np.ones(len(problem.position_offset)) if given is None else given[list(index).index(i)]
                row[:, arm + 3 :] = np.kron(weights, np.eye(3))
        elif isinstance(prior, AttitudePrior):
            row[:, 6 * i : 6 * i + 3] = np.eye(3)
        elif isinstance(prior, ControlPointPrior):
            row[:, 6 * images + 3 * i : 6 * images + 3 * i + 3] = np.eye(3)
        else:
            assert isinstance(prior, LeverArmPrior | PositionOffsetPrior)  # of one row
            at = arm + (0 if isinstance(prior, LeverArmPrior) else 3)
            row[:, at : at + 3] = np.eye(3)
    sigma = prior.std_rad if isinstance(prior, AttitudePrior) else prior.std_m
    return (rows / sigma[:, :, None]).reshape(-1, size)


def test_lever_arm_along_the_axis_moves_a_level_block():
    problem = block(nadir=True)
    level = given(problem, positions(problem), lever_arm=True)
    # all cameras have one attitude, so the arm moves as the block does along each axis
    found = free_gauge(level)
    assert found == tuple(f"translation {a} + lever arm {a}" for a in "xyz")
    known = LeverArmPrior(xyz=np.zeros((1, 3)), std_m=np.full((1, 3), 0.01))
    assert free_gauge(given(problem, positions(problem), known, lever_arm=True)) == ()


def test_oblique_line_is_named_by_both_axes():
    problem = block()
    turn = Rotation.from_rotvec([0, 0, 0.6])
    rotation, centers = rotation_and_centers(problem)
    poses = pose_of(rotation * turn.inv(), turn.apply(centers))
    turned = dataclasses.replace(problem, poses=poses, points=turn.apply(problem.points))
    assert free_gauge(given(turned, positions(turned, range(4)))) == ("rotation about x + rotation about y",)


def test_block_far_from_the_origin_has_the_same_gauge():
    problem = block()
    shift = np.array([4.5e5, 4.6e6, 300.0])
    rotation, centers = rotation_and_centers(problem)
    far = dataclasses.replace(problem, poses=pose_of(rotation, centers + shift), points=problem.points + shift)
    assert free_gauge(far) == ALL
    assert free_gauge(far.fix(poses=[0])) == ("scale",)
    assert free_gauge(given(far, positions(far, range(4)))) == ("rotation about x",)
    assert free_gauge(given(far, positions(far))) == ()


def test_part_without_priors_is_found_beside_one_with():
    problem = block()
    seen = problem.observations
    left, right = seen.image_index < 4, seen.point_index < 30
    split = dataclasses.replace(
        problem,
        observations=jax.tree.map(lambda a: a[left == right], seen),
    )
    assert free_gauge(given(split, positions(split))) == ("rotation about x",)  # each part is a line
    assert free_gauge(given(split, positions(split), attitudes(split, range(8)))) == ()
    assert free_gauge(given(split, positions(split, range(4)), attitudes(split, range(4)))) == ALL


def test_fixed_pose_that_sees_nothing_fixes_nothing():
    problem = block()
    unseen = dataclasses.replace(
        problem, observations=jax.tree.map(lambda a: a[problem.observations.image_index != 0], problem.observations)
    )
    assert free_gauge(unseen.fix(poses=[0])) == ALL


def test_many_rows_of_priors_are_all_looked_at():
    survey = uav_block(300, seed=1, points_per_image=30.0)
    assert free_gauge(survey.problem) == ()
    prior = survey.problem.priors[0]
    std_m = np.full_like(prior.std_m, np.inf)
    std_m[280] = 0.1  # in the second piece of rows
    assert free_gauge(eqx.tree_at(lambda p: p.priors[0].std_m, survey.problem, std_m)) == (*ROTATIONS, "scale")


def test_refusal_says_what_is_free_and_what_to_do():
    with pytest.raises(JaxbaError) as error:
        require_gauge(block(), "Covariance")
    assert str(error.value) == (
        f"Covariance: problem has no gauge, 7 directions are free ({', '.join(ALL)}). "
        "Add a position prior with finite std_m or three control points, or fix two poses. "
        'Or take those of the photos alone: datum="inner".'
    )
    problem = block()
    with pytest.raises(JaxbaError, match=r"1 direction is free \(rotation about x\). Positions along one line"):
        require_gauge(given(problem, positions(problem, range(4))), "Gradients")
    require_gauge(problem.fix(poses=[0, 7]), "Covariance")
    with pytest.raises(JaxbaError, match="Hold the lever arm fixed"):
        require_gauge(given(problem.fix(poses=[0, 7]), lever_arm=True), "Covariance")


ABSURD = (0.0, np.nan, np.inf, 1e308, 1e200, 1e31, 1e30, 1e20, 1e12, 1e-12, 1e-20, 1e-30, 1e-31, 1e-308, 5e-324)


def test_absurd_numbers_are_refused_or_judged():
    """Any number of a problem, or all of an array, is set to or multiplied by an absurd one: nothing else is raised."""
    rng = np.random.default_rng(0)
    leaves, tree = jax.tree.flatten(small_problem(RADIAL, lever_arm=True, position_offset=True))
    numbers = [i for i, leaf in enumerate(leaves) if np.asarray(leaf).dtype.kind == "f"]
    judged = refused = 0
    for _ in range(150):
        i, changed = rng.choice(numbers), list(leaves)
        value = rng.choice(ABSURD) * rng.choice([1, 1, 1, -1])
        array = changed[i] = np.array(leaves[i])
        where = ... if rng.random() < 0.5 else np.unravel_index(rng.integers(array.size), array.shape)
        with np.errstate(all="ignore"):
            array[where] = value if rng.random() < 0.5 else array[where] * value
        problem = jax.tree.unflatten(tree, changed)
        try:
            free_gauge(problem.fix(poses=[0] if rng.random() < 0.5 else []))
            judged += 1
        except JaxbaError:
            refused += 1
    assert min(judged, refused) > 20


@pytest.mark.parametrize("std_m", [1e-30, 1e-12, 1e12, 1e30])
def test_the_unit_of_a_sigma_does_not_matter(std_m: float):
    survey = uav_block(8)
    assert free_gauge(eqx.tree_at(lambda p: p.priors[0].std_m, survey.problem, np.full((8, 3), std_m))) == ()


@pytest.mark.parametrize(
    ("std_m", "message"),
    [(1e-200, "has 1e-200 .*; give a sigma from 1e-30 to 1e"), (1e200, "has 1e.200 .*; give a sigma from 1e-30 to 1e")],
)
def test_an_absurd_sigma_is_named(std_m: float, message: str):
    survey = uav_block(8)
    with pytest.raises(JaxbaError, match=f"prior position: std_m .*: image 0 {message}"):
        free_gauge(eqx.tree_at(lambda p: p.priors[0].std_m, survey.problem, np.full((8, 3), std_m)))


def test_an_absurd_coordinate_is_named():
    problem = block()
    with pytest.raises(JaxbaError, match=r"points: point 0 has 1e\+308 \(and \d+ more\); correct it .* beyond 1e\+30"):
        free_gauge(dataclasses.replace(problem, points=np.full_like(problem.points, 1e308)))
