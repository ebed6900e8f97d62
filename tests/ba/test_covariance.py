"""Covariances equal blocks of a dense inverse of J^T J, J being jax's own derivative of residuals written out here."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree

from jaxba._errors import JaxbaError
from jaxba.ba import IntrinsicsPrior, Observations, Problem, Step, Unknowns, _covariance as module, covariance
from jaxba.geometry import AbstractLoss, Cauchy, Huber, Linear
from jaxba.simulation import Survey, uav_block


def at_truth(survey: Survey) -> Problem:
    problem, truth = survey.problem, survey.truth
    return eqx.tree_at(lambda p: (p.poses, p.cameras, p.points), problem, (truth.poses, truth.cameras, truth.points))


def small_block(**options: object) -> Problem:
    """Twelve images and 350 points at the truth."""
    return at_truth(uav_block(12, seed=6, points_per_image=28.0, **options))


def calibrated(problem: Problem) -> Problem:
    names = type(problem.cameras).parameter_names()
    parameters = np.stack([np.asarray(getattr(problem.cameras, n)) for n in names], axis=1)
    std = np.tile([20.0, 20.0, 5.0, 5.0, 0.01, 0.01, 0.001, 0.001, np.inf], (len(parameters), 1))
    prior = IntrinsicsPrior(camera_index=np.arange(len(parameters)), parameters=parameters, std=std)
    return dataclasses.replace(problem, priors=(*problem.priors, prior))


def partly_fixed(problem: Problem) -> Problem:
    return problem.fix(poses=[3, 7], points=[0, 5, 100], intrinsics=["k2"])


CASES = {
    "shared camera, every prior": (
        lambda: calibrated(small_block(lever_arm_std_m=0.05, num_control=4, attitude_prior=True)),
        Linear(),
    ),
    "three cameras, fixed blocks, robust": (
        lambda: partly_fixed(small_block(num_cameras=3, num_control=4, outlier_fraction=0.1)),
        Cauchy(2.0),
    ),
    "own cameras, some fixed": (
        lambda: eqx.tree_at(
            lambda p: p.free.intrinsics,
            partly_fixed(calibrated(small_block(num_cameras=12, lever_arm_std_m=0.05))),
            np.arange(12 * 9).reshape(12, 9) % 5 > 2,
        ),
        Huber(1.5),
    ),
    "fixed points alone": (lambda: dataclasses.replace(small_block().fix(points=list(range(40))), priors=()), Linear()),
    "poses alone": (lambda: small_block().fix(intrinsics=True, points=True), Linear()),
}


@dataclasses.dataclass(frozen=True)
class Dense:
    """Covariance of all unknowns, zero where fixed; `step` gives the place of each unknown."""

    matrix: np.ndarray
    step: Step
    double_cost: float
    redundancy: int

    def of(self, place: np.ndarray) -> np.ndarray:
        place = np.asarray(place)
        return self.matrix[place[..., :, None], place[..., None, :]]


def dense_covariance(problem: Problem, loss: AbstractLoss) -> Dense:
    names, seen = type(problem.cameras).parameter_names(), problem.observations
    intrinsics = jnp.stack([jnp.asarray(getattr(problem.cameras, n)) for n in names], axis=1)
    values = jax.tree.map(jnp.asarray, (problem.poses, problem.lever_arm, problem.points))
    start = Unknowns(values[0], intrinsics, values[1], values[2])
    priors = jax.tree.map(jnp.asarray, problem.priors)
    shapes = Step(
        jnp.zeros((problem.num_images, 6)), jnp.zeros_like(intrinsics), jnp.zeros(3), jnp.zeros_like(values[2])
    )
    flat, unravel = ravel_pytree(shapes)
    image, point = jnp.asarray(seen.image_index), jnp.asarray(seen.point_index)

    @jax.jit
    def groups(flat: jax.Array) -> list[jax.Array]:
        moved = start.retract(unravel(flat))
        pose = jax.tree.map(lambda a: a[image], moved.poses)
        camera = type(problem.cameras).from_parameters(moved.intrinsics[jnp.asarray(problem.camera_index)[image]])
        xy_px = camera.project(pose.transform(moved.points[point]))
        pixels = (xy_px - seen.xy_px) / seen.std_px[:, None]
        return [pixels.T, *(prior.residual(moved) for prior in priors)]

    free = np.concatenate(
        [
            np.repeat(problem.free.poses, 6),
            np.ravel(problem.free.intrinsics),
            np.repeat(problem.free.lever_arm, 3),
            np.repeat(problem.free.points, 3),
        ]
    )
    residuals, jacobians = groups(flat), jax.jit(jax.jacfwd(groups))(flat)
    normal, double_cost, rows = np.zeros((len(flat), len(flat))), 0.0, 0
    for group_loss, residual, jacobian in zip([loss, *(p.loss for p in priors)], residuals, jacobians, strict=True):
        jacobian = np.asarray(jacobian) * free
        depends = (jacobian != 0).any(axis=-1)
        squared = jnp.asarray(np.sum(np.where(depends, residual, 0) ** 2, axis=0))
        weight = np.asarray(group_loss.derivatives(squared)[1])
        jacobian = (jacobian * np.sqrt(weight)[:, None]).reshape(-1, len(flat))
        normal += jacobian.T @ jacobian
        double_cost += float(jnp.sum(group_loss(squared)))
        rows += int(depends.sum())
    own = normal[np.ix_(free, free)]
    scale = 1 / np.sqrt(np.diag(own))
    matrix = np.zeros_like(normal)
    matrix[np.ix_(free, free)] = np.linalg.inv(own * np.outer(scale, scale)) * np.outer(scale, scale)
    return Dense(matrix, unravel(jnp.arange(len(flat), dtype=float)), double_cost, rows - int(free.sum()))


def assert_same(found: np.ndarray, expected: np.ndarray) -> None:
    """Equal relative to the sigmas; J^T J of these blocks has a condition of up to 1e9 once scaled, so 1e-6 is left."""
    sigma = np.sqrt(np.diagonal(expected, axis1=-2, axis2=-1))
    unit = sigma[..., :, None] * sigma[..., None, :]
    assert found.shape == expected.shape
    np.testing.assert_array_equal(found[unit == 0], 0.0)
    np.testing.assert_allclose(found[unit > 0] / unit[unit > 0], expected[unit > 0] / unit[unit > 0], atol=1e-6)


@pytest.mark.parametrize("case", CASES)
def test_covariances_equal_a_dense_inverse(case: str):
    make, loss = CASES[case]
    problem = make()
    found, dense = covariance(problem, loss=loss), dense_covariance(problem, loss)
    place = jax.tree.map(lambda a: np.asarray(a).astype(int), dense.step)
    assert_same(found.poses, dense.of(place.poses))
    assert_same(found.points, dense.of(place.points))
    assert_same(found.intrinsics, dense.of(place.intrinsics))
    assert_same(found.lever_arm, dense.of(place.lever_arm))
    names = type(problem.cameras).parameter_names()
    by_name = {f"camera {c} {n}": p for c, row in enumerate(place.intrinsics) for n, p in zip(names, row, strict=True)}
    by_name |= {f"lever arm {axis}": place.lever_arm[i] for i, axis in enumerate("xyz")}
    assert_same(found.border, dense.of(np.array([by_name[name] for name in found.border_names], int)))
    assert found.redundancy == dense.redundancy
    assert found.variance_factor == pytest.approx(dense.double_cost / dense.redundancy, rel=1e-9)


def test_centers_are_positions_in_the_world():
    problem = small_block()
    found = covariance(problem)
    seen = jax.jacfwd(lambda step: problem.poses.retract(step).center)(jnp.zeros((12, 6)))
    for i in range(12):
        turn = np.asarray(seen)[i, :, i]
        np.testing.assert_allclose(found.centers[i], turn @ found.poses[i] @ turn.T, rtol=1e-9, atol=1e-15)


def test_variance_factor_is_one_for_noise_as_large_as_its_sigma():
    survey = uav_block(30, seed=3)
    found = covariance(at_truth(survey))
    # at the truth 2 cost is chi-squared with as many degrees as rows, not as the redundancy
    rows = 2 * survey.problem.num_observations + 90
    assert found.variance_factor * found.redundancy / rows == pytest.approx(1.0, abs=4 * np.sqrt(2 / rows))


def test_point_seen_once_is_left_out_and_reported():
    problem = small_block()
    seen = problem.observations
    first = np.unique(seen.point_index, return_index=True)[1][20]
    keep = (seen.point_index != 20) | (np.arange(len(seen.point_index)) == first)
    found = covariance(dataclasses.replace(problem, observations=jax.tree.map(lambda a: a[keep], seen)))
    assert found.dropped.points.tolist() == [20] and not found.points[20].any() and found.points[21].any()


def test_block_without_gauge_is_refused():
    with pytest.raises(JaxbaError, match=r"Covariance: problem has no gauge, 7 directions are free .* Add a position"):
        covariance(small_block(gnss_std_m=None))


def test_unknown_without_measurements_is_named():
    problem = small_block(num_control=4)
    names = tuple(f"{i}.jpg" for i in range(12))
    seen, prior = problem.observations, problem.priors[0]
    mine = np.flatnonzero(seen.image_index == 4)
    keep = np.setdiff1d(np.arange(problem.num_observations), mine[2:])
    std_m = np.array(prior.std_m)
    std_m[4] = np.inf
    loose = dataclasses.replace(
        eqx.tree_at(lambda p: p.priors[0].std_m, problem, std_m),
        observations=Observations(seen.xy_px[keep], seen.std_px[keep], seen.image_index[keep], seen.point_index[keep]),
        image_names=names,
    )
    with pytest.raises(JaxbaError, match=r"do not determine the pose of image 4 \(4.jpg\)"):
        covariance(loose)


def test_block_beyond_the_limit_is_refused(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(module, "MAX_UNKNOWNS", 50)
    with pytest.raises(JaxbaError, match="80 unknowns of images and cameras, the limit is 50"):
        covariance(small_block())
