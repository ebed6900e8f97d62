"""Free directions equal the null space of a dense Jacobian, and are called what they are."""

import dataclasses
import functools
from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxba._errors import JaxbaError
from jaxba.ba import Observations, Problem, Step, Unknowns, free_gauge
from jaxba.ba._gauge import require_gauge
from jaxba.ba.groups import AttitudePrior, ControlPointPrior, IntrinsicsPrior, LeverArmPrior, PositionPrior
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
    down = Pose(np.tile([0.0, 1, 0, 0], (8, 1)), np.zeros((8, 3)))  # half a turn about x: the camera looks down
    poses = down.retract(jnp.asarray(np.concatenate([turn, np.zeros((8, 3))], axis=1)))
    poses = Pose.from_center(poses.rotation, jnp.asarray(centers))
    seen = Observations(np.zeros((480, 2)), np.ones(480), np.repeat(np.arange(8), 60), np.tile(np.arange(60), 8))
    poses = jax.tree.map(np.asarray, poses)
    return Problem.build(poses, Pinhole(1000.0, 1000.0, 500.0, 500.0), points, seen).fix(intrinsics=True)


def positions(problem: Problem, images: range = range(8), std_m: float = 0.05) -> PositionPrior:
    index = np.array(images, int)
    xyz = np.asarray(problem.poses.center)[index]
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


def given(problem: Problem, *priors: object, lever_arm: bool = False) -> Problem:
    free = dataclasses.replace(problem.free, lever_arm=np.array(lever_arm))
    return dataclasses.replace(problem, priors=priors, free=free)


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
    """Count the singular directions of the dense Jacobian of everything free."""
    free = np.concatenate(
        [np.repeat(problem.free.poses, 6), np.repeat(problem.free.points, 3), np.repeat(problem.free.lever_arm, 3)]
    )
    priors = jax.tree.map(jnp.asarray, problem.priors)
    of_priors = [jacobian_of(lambda moved, p=prior: p.residual(moved), problem) for prior in priors]
    jacobian = np.concatenate([pixel_jacobian(), *of_priors])[:, free]
    jacobian /= np.maximum(np.linalg.norm(jacobian, axis=0), 1e-12)
    values = np.linalg.svd(jacobian, compute_uv=False)
    # the weakest real directions of these blocks lie near 1e-5, rounding below 1e-12
    return int(np.sum(values < 1e-9)) + max(0, jacobian.shape[1] - len(values))


def jacobian_of(residual: Callable[[Unknowns], jax.Array], problem: Problem) -> np.ndarray:
    """jax's own derivative by all steps: poses, points, lever arm."""
    values = jax.tree.map(jnp.asarray, (problem.poses, problem.lever_arm, problem.points))
    start = Unknowns(values[0], jnp.zeros((1, 4)), values[1], values[2])
    sizes = (problem.num_images * 6, problem.num_points * 3, 3)

    def along(flat: jax.Array) -> jax.Array:
        poses, points, lever_arm = jnp.split(flat, np.cumsum(sizes)[:2])
        step = Step(poses.reshape(-1, 6), jnp.zeros((1, 4)), lever_arm, points.reshape(-1, 3))
        return residual(start.retract(step)).ravel()

    return np.asarray(jax.jacfwd(along)(jnp.zeros(sum(sizes))))


@functools.cache
def pixel_jacobian() -> np.ndarray:
    problem = block()
    seen = problem.observations

    def pixels(moved: Unknowns) -> jax.Array:
        pose = jax.tree.map(lambda a: a[seen.image_index], moved.poses)
        return problem.cameras.project(pose.transform(moved.points[seen.point_index]))

    return jacobian_of(pixels, problem)


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
    turn = np.array([[np.cos(0.6), -np.sin(0.6), 0], [np.sin(0.6), np.cos(0.6), 0], [0, 0, 1]])
    center = np.asarray(problem.poses.center) @ turn.T
    poses = Pose.from_center(problem.poses.rotation @ turn.T, jnp.asarray(center))
    turned = dataclasses.replace(problem, poses=jax.tree.map(np.asarray, poses), points=problem.points @ turn.T)
    assert free_gauge(given(turned, positions(turned, range(4)))) == ("rotation about x + rotation about y",)


def test_block_far_from_the_origin_has_the_same_gauge():
    problem = block()
    shift = np.array([4.5e5, 4.6e6, 300.0])
    poses = Pose.from_center(problem.poses.rotation, jnp.asarray(np.asarray(problem.poses.center) + shift))
    far = dataclasses.replace(problem, poses=jax.tree.map(np.asarray, poses), points=problem.points + shift)
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
        "Add a position prior with finite std_m or three control points, or fix two poses."
    )
    problem = block()
    with pytest.raises(JaxbaError, match=r"1 direction is free \(rotation about x\). Positions along one line"):
        require_gauge(given(problem, positions(problem, range(4))), "Gradients")
    require_gauge(problem.fix(poses=[0, 7]), "Covariance")
    with pytest.raises(JaxbaError, match="Hold the lever arm fixed"):
        require_gauge(given(problem.fix(poses=[0, 7]), lever_arm=True), "Covariance")
