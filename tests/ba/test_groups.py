"""Every residual group: values by their formulas, derivatives those of `jax.jacfwd`, padding that does no harm."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from dense_reference import start_of
from jax import Array
from quick_jit import quick_jit
from scipy.spatial.transform import Rotation
from small_problems import EVERY_CAMERA, small_problem, with_bars

from jaxba.ba import AbstractPrior, AspectPrior, AttitudePrior, Rows, Step, Unknowns, make_plan
from jaxba.ba._system import make_system
from jaxba.ba.groups import PRIORS, Reprojection
from jaxba.geometry import Linear, Pose

PROBLEM = with_bars(small_problem(EVERY_CAMERA[3], num_cameras=2, lever_arm=True, position_offset=True))
UNKNOWNS = start_of(PROBLEM)


def no_step(unknowns: Unknowns) -> Step:
    poses = np.zeros((unknowns.poses.translation.shape[0], 6))
    return Step(poses, *(np.zeros(np.shape(x)) for x in (unknowns.intrinsics, unknowns.antenna, unknowns.points)))


@quick_jit
def evaluate(prior: AbstractPrior, unknowns: Unknowns) -> tuple[Array, Step, Step, Rows]:
    """Return the residual, its derivative, the gradient of the cost, and the prior's own rows."""

    def residual(step: Step) -> Array:
        return prior.residual(unknowns.retract(step))

    zero = no_step(unknowns)
    gradient = jax.grad(lambda step: jnp.sum(residual(step) ** 2))(zero)
    return residual(zero), jax.jacfwd(residual)(zero), gradient, prior.rows(unknowns)


def assert_rows_equal_jacfwd(prior: AbstractPrior, unknowns: Unknowns, tolerance: float = 1e-12) -> np.ndarray:
    """Check the prior's rows, and return its residual."""
    value, expected, gradient, rows = jax.device_get(evaluate(prior, unknowns))
    np.testing.assert_allclose(rows.residual, value, rtol=0, atol=1e-12)
    numbers = np.arange(rows.residual.shape[1])
    for block, whole in (
        (rows.pose, expected.poses),
        (rows.intrinsics, expected.intrinsics),
        (rows.point, expected.points),
    ):
        dense = np.zeros(whole.shape)
        if block is not None:
            dense[:, numbers, block.index] = np.moveaxis(block.jacobian, 1, 2)
        # 1e-12 of the largest entry: rounding of two orders of summation
        np.testing.assert_allclose(dense, whole, rtol=0, atol=tolerance * max(1.0, np.abs(whole).max()))
    antenna = np.zeros(expected.antenna.shape) if rows.antenna is None else np.moveaxis(rows.antenna, 1, 2)
    np.testing.assert_allclose(antenna, expected.antenna, rtol=0, atol=1e-12 * max(1.0, np.abs(antenna).max()))
    for reverse, whole in zip(jax.tree.leaves(gradient), jax.tree.leaves(expected), strict=True):
        forward = 2 * np.einsum("rc,rc...->...", value, whole)
        np.testing.assert_allclose(reverse, forward, rtol=0, atol=tolerance * max(1.0, np.abs(forward).max()))
    return value


@pytest.mark.parametrize("name", PRIORS)
def test_derivatives_of_every_prior_equal_jacfwd(name):
    assert_rows_equal_jacfwd(PROBLEM.prior(name), UNKNOWNS)


def test_derivatives_of_an_aspect_equal_jacfwd_and_its_residual_the_formula():
    prior = AspectPrior(camera_index=np.array([1, 0]), ratio=np.array([1.0, 1.01]), std=np.array([1e-3, 2e-3]))
    focal = np.random.default_rng(0).uniform(800, 1200, UNKNOWNS.intrinsics.shape)
    unknowns = eqx.tree_at(lambda u: u.intrinsics, UNKNOWNS, jnp.asarray(focal))
    assert_rows_equal_jacfwd(prior, unknowns)
    fx, fy = focal.T[:2]
    expected = [(fx[1] / fy[1] - 1) / 1e-3, (fx[0] / fy[0] - 1.01) / 2e-3]
    np.testing.assert_allclose(prior.residual(unknowns)[0], expected, rtol=1e-12)


# about half a turn the rotation vector jumps; beside it the derivative of arctan2 loses four digits
@pytest.mark.parametrize("angle", [0.0, 1e-9, 1e-5, np.pi - 1e-6, np.pi - 1e-3])
def test_derivatives_of_an_attitude_equal_jacfwd_from_no_turn_to_half_a_turn(angle):
    axes = np.array([[1.0, 0, 0], [0, 0.6, -0.8], [0.48, 0.6, 0.64]])
    adjusted = Rotation.from_quat(UNKNOWNS.poses.quaternion[:3], scalar_first=True)
    measured = Rotation.from_rotvec(-angle * axes) * adjusted
    index, std_rad = np.arange(3, dtype=np.int32), np.array([[0.01, 0.02, 0.03]] * 3)
    prior = AttitudePrior(index, measured.as_quat(scalar_first=True), std_rad)
    residual = assert_rows_equal_jacfwd(prior, UNKNOWNS, tolerance=1e-9)
    expected = (angle * axes).T / np.array([[0.01], [0.02], [0.03]])
    np.testing.assert_allclose(residual, expected, rtol=0, atol=1e-7)


def test_residuals_of_priors_equal_their_formulas():
    rotation = Rotation.from_quat(UNKNOWNS.poses.quaternion, scalar_first=True)
    position, attitude, control = (PROBLEM.prior(name) for name in ("position", "attitude", "control"))
    centers = rotation.inv().apply(UNKNOWNS.lever_arm - UNKNOWNS.poses.translation)
    offsets = np.asarray(UNKNOWNS.position_offset)[np.argmax(position.offset_weights, axis=1)]
    assert len(np.unique(offsets, axis=0)) == 2
    expected = {
        "position": (centers[position.image_index] + offsets - position.xyz) / position.std_m,
        "attitude": (
            rotation[attitude.image_index] * Rotation.from_quat(attitude.quaternion, scalar_first=True).inv()
        ).as_rotvec()
        / attitude.std_rad,
        "control": (UNKNOWNS.points[control.point_index] - control.xyz) / control.std_m,
    }
    for name, values in expected.items():
        residual = np.asarray(evaluate(PROBLEM.prior(name), UNKNOWNS)[0])
        np.testing.assert_allclose(residual.T, values, rtol=0, atol=1e-9)


def reprojection(camera, refined: tuple[bool, ...]) -> tuple[Reprojection, Unknowns]:
    """Two runs of four observations of two cameras; one point on the optical axis, one behind, the last row padding."""
    rng = np.random.default_rng(0)
    quaternion = np.concatenate([Rotation.random(2, rng=rng).as_quat(scalar_first=True), [[1.0, 0, 0, 0]]])
    translation = np.concatenate([rng.normal(size=(2, 3)), np.zeros((1, 3))])
    in_cam = np.array([[1.0, -2, 6], [0, 0, 5], [-2, 1, 7], [1, 1, 8]])
    in_cam = np.concatenate([in_cam, in_cam[[0, 2, 3, 3]]])
    if camera.sees_behind:
        in_cam[3, 2] = -2.0
    run_image = np.array([0, 1], np.int32)
    of_row = np.repeat(run_image, 4)
    rotation = Rotation.from_quat(quaternion, scalar_first=True)
    points = rotation[of_row].inv().apply(in_cam - translation[of_row])
    points[7] = rotation[1].inv().apply(-translation[1])  # padding may lie anywhere, even in the camera's centre
    names = camera.parameter_names()
    parameters = np.array([[float(getattr(camera, n)) * scale for n in names] for scale in (1.0, 1.1)])
    weight = rng.uniform(1, 2, 8)
    weight[7] = 0.0
    group = Reprojection(
        xy_px=rng.uniform(0, 500, (2, 2, 4)),
        weight=weight.reshape(2, 4),
        point_index=np.arange(8, dtype=np.int32).reshape(2, 4),
        run_image=run_image,
        camera_index=np.array([1, 0, 0], np.int32),
        model=type(camera),
        refined=refined,
    )
    return group, Unknowns(Pose(quaternion, translation), parameters, np.zeros(3), points)


@pytest.mark.parametrize("camera", EVERY_CAMERA, ids=lambda camera: type(camera).__name__)
def test_derivatives_of_every_camera_equal_jacfwd_with_padding_and_beside_the_axis(camera):
    refined = tuple(i != 1 for i in range(len(camera.parameter_names())))
    group, unknowns = reprojection(camera, refined)

    def residual(step: Step) -> Array:
        return group.residual(unknowns.retract(step))[0]

    @quick_jit
    def both(step: Step) -> tuple[Array, Step, Array, Step]:
        pull = jax.vjp(residual, step)[1]
        return residual(step), jax.jacfwd(residual)(step), group.rows(unknowns), pull(jnp.ones((2, 2, 4)))[0]

    value, expected, rows, reverse = jax.device_get(both(no_step(unknowns)))
    assert all(np.all(np.isfinite(leaf)) for leaf in jax.tree.leaves((value, expected, rows, reverse)))
    assert np.all(np.asarray(value)[:, 1, 3] == 0) and np.all(np.asarray(rows)[1, :, :, 3] == 0)

    runs, lanes = np.repeat([0, 1], 4), np.tile(np.arange(4), 2)
    camera_of_row = np.asarray(group.camera_index)[runs]
    columns = [
        np.asarray(expected.poses)[:, runs, lanes, runs],
        np.asarray(expected.intrinsics)[:, runs, lanes, camera_of_row][..., list(refined)],
        np.asarray(value)[:, runs, lanes, None],
        np.asarray(expected.points)[:, runs, lanes, np.arange(8)],
    ]
    # (2, 8, columns) as rows have it; 1e-12 of the largest entry: rounding of two orders of multiplication
    found = np.moveaxis(np.asarray(rows)[runs, :, :, lanes], 0, 1)
    whole = np.concatenate(columns, axis=-1)
    np.testing.assert_allclose(found, whole, rtol=1e-11, atol=1e-12 * np.abs(whole).max())


@pytest.mark.parametrize("name", PRIORS)
def test_rows_of_infinite_sigma_weigh_nothing_and_keep_derivatives_finite(name):
    prior = PROBLEM.prior(name)
    sigma = next(field for field in ("std_m", "std_rad", "std") if hasattr(prior, field))
    padded = eqx.tree_at(lambda p: getattr(p, sigma), prior, np.full_like(getattr(prior, sigma), np.inf))

    residual, _, gradient, rows = jax.device_get(evaluate(padded, UNKNOWNS))
    touched = [block.jacobian for block in (rows.pose, rows.intrinsics, rows.point) if block is not None]
    assert touched or rows.antenna is not None
    for leaf in jax.tree.leaves((residual, gradient, rows.residual, rows.antenna, touched)):
        assert np.all(leaf == 0)


@pytest.mark.parametrize("name", PRIORS)
def test_a_prior_without_rows_is_filled_up_with_rows_that_weigh_nothing(name):
    # breaks where a part or a tile that has no row of a prior has no equations: a filled-up bar had no direction
    prior = PROBLEM.prior(name)
    given = {field: value for field, value in vars(prior).items() if field != "loss" and value is not None}
    empty = dataclasses.replace(prior, **{field: np.asarray(value)[:0] for field, value in given.items()})
    problem = eqx.tree_at(lambda p: p.priors, PROBLEM, (empty,))
    plan = make_plan(problem)
    (filled,) = make_system(problem, plan, Linear()).priors

    unmoved = eqx.tree_at(lambda u: u.antenna, UNKNOWNS, np.zeros_like(UNKNOWNS.antenna))
    residual, _, gradient, rows = jax.device_get(evaluate(filled, unmoved))
    touched = [block.jacobian for block in (rows.pose, rows.intrinsics, rows.point) if block is not None]
    assert rows.residual.shape[1] == plan.shape.prior_rows[0] > 0
    for leaf in jax.tree.leaves((residual, gradient, rows.residual, rows.antenna, touched)):
        assert np.all(leaf == 0)
