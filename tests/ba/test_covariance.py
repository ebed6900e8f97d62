"""Covariances equal blocks of a dense inverse of J^T J, J being that of the dense reference."""

import dataclasses
import functools
import types

import equinox as eqx
import jax
import numpy as np
import pytest
from dense_reference import Dense, loss_derivatives
from quick_jit import quick_jit
from scipy.optimize import brentq
from scipy.stats import chi2
from small_problems import one_of, two_flights

from jaxba._errors import JaxbaError
from jaxba.ba import (
    Covariance,
    IntrinsicsPrior,
    Observations,
    Problem,
    Step,
    camera_covariance,
    covariance,
    solve,
    statistics,
)
from jaxba.ba._unknowns import antenna_names
from jaxba.geometry import AbstractLoss, Cauchy, Huber, Linear
from jaxba.simulation import Survey, uav_block


def at_truth(survey: Survey) -> Problem:
    problem, truth = survey.problem, survey.truth
    return eqx.tree_at(lambda p: (p.poses, p.cameras, p.points), problem, (truth.poses, truth.cameras, truth.points))


def small_block(**options: object) -> Problem:
    """Twelve images and 200 points at the truth; the dense reference takes their cube."""
    return at_truth(uav_block(12, seed=6, points_per_image=16.0, **options))


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
    "offset of positions, lever arm held": (
        lambda: two_flights(small_block(num_control=4, position_offset_m=(0.4, -0.3, 0.2), position_offset_std_m=0.5)),
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
class DenseCovariance:
    """Covariance of all unknowns, zero where fixed; `step` gives the place of each unknown."""

    matrix: np.ndarray
    step: Step
    variance_factor: float
    redundancy: int

    def of(self, place: np.ndarray) -> np.ndarray:
        return self.matrix[place[..., :, None], place[..., None, :]]


def dense_covariance(problem: Problem, loss: AbstractLoss) -> DenseCovariance:
    dense = Dense(problem, loss)
    jacobians, squares = [], []
    for residual, jacobian, group_loss in dense.groups():
        depends = (jacobian != 0).any(axis=2)
        squared = np.sum(np.where(depends, residual, 0) ** 2, axis=1)
        squares.append((isinstance(group_loss, Linear), squared, depends.sum(axis=1)))
        _, weight, _ = loss_derivatives(group_loss, squared)
        jacobians.append((jacobian * np.sqrt(weight)[:, None, None]).reshape(-1, dense.size))
    jacobian = np.concatenate(jacobians)
    scale = 1 / np.linalg.norm(jacobian, axis=0)
    root = np.linalg.inv(np.linalg.qr(jacobian * scale, mode="r")) * scale[:, None]  # no square of the condition
    names = type(problem.cameras).parameter_names()
    shapes = (problem.num_images, 6), (problem.num_cameras, len(names)), problem.antenna.shape, (problem.num_points, 3)
    ends = np.cumsum([np.prod(shape) for shape in shapes])
    parts = np.split(np.arange(ends[-1]), ends[:-1])
    step = Step(*(part.reshape(shape).astype(float) for part, shape in zip(parts, shapes, strict=True)))
    place = dense.flat(step).astype(int)
    matrix = np.zeros((ends[-1], ends[-1]))
    matrix[np.ix_(place, place)] = root @ root.T
    redundancy = sum(int(count.sum()) for _, _, count in squares) - dense.size
    return DenseCovariance(matrix, step, dense_variance_factor(squares, redundancy), redundancy)


def dense_variance_factor(squares: list[tuple[bool, np.ndarray, np.ndarray]], redundancy: int) -> float:
    """Return the factor at which squares, cut off at the 99th percentile where a loss is robust, are as expected.

    The expectation is an integral, and the equation is solved by bisection.
    """
    left = redundancy / sum(count.sum() for _, _, count in squares)
    expected = 0.0
    limits = []
    for linear, _, count in squares:
        some = range(1, int(count.max()) + 1)
        limit = np.array([np.inf, *(np.inf if linear else chi2.ppf(0.99, c) for c in some)])
        mean = [0.0, *(c if linear else chi2.expect(lambda x, m=limit[c]: min(x, m), (c,)) for c in some)]
        limits.append(limit[count])
        expected += left * np.sum(np.array(mean)[count])

    def surplus(factor: float) -> float:
        cut = [np.minimum(s, m * left * factor) for (_, s, _), m in zip(squares, limits, strict=True)]
        return float(sum(np.sum(c) for c in cut) - expected * factor)

    return brentq(surplus, 1e-9, 1e9, xtol=1e-12, rtol=1e-12)


def assert_same(found: np.ndarray, expected: np.ndarray) -> None:
    """Equal relative to the sigmas."""
    sigma = np.sqrt(np.diagonal(expected, axis1=-2, axis2=-1))
    unit = sigma[..., :, None] * sigma[..., None, :]
    assert found.shape == expected.shape
    np.testing.assert_array_equal(found[unit == 0], 0.0)
    np.testing.assert_allclose(found[unit > 0] / unit[unit > 0], expected[unit > 0] / unit[unit > 0], rtol=0, atol=1e-8)


@functools.cache
def case_and_dense(case: str) -> tuple[Problem, AbstractLoss, DenseCovariance]:
    make, loss = CASES[case]
    problem = make()
    return problem, loss, dense_covariance(problem, loss)


@pytest.mark.parametrize(
    ("case", "num_tiles"),
    [*((case, 1) for case in CASES), ("shared camera, every prior", 2), ("own cameras, some fixed", 4)],
)
def test_covariances_equal_a_dense_inverse(case: str, num_tiles: int):
    problem, loss, dense = case_and_dense(case)
    found = covariance(problem, loss=loss, max_observations=problem.num_observations / num_tiles)
    place = types.SimpleNamespace(**{name: leaf.astype(int) for name, leaf in vars(dense.step).items()})
    assert_same(found.poses, dense.of(place.poses))
    assert_same(found.points, dense.of(place.points))
    assert_same(found.intrinsics, dense.of(place.intrinsics))
    assert_same(found.lever_arm, dense.of(place.antenna[:3]))
    if len(problem.position_offset):
        assert_same(found.position_offset, dense.of(place.antenna[3:]))
    names = type(problem.cameras).parameter_names()
    by_name = {f"camera {c} {n}": p for c, row in enumerate(place.intrinsics) for n, p in zip(names, row, strict=True)}
    by_name |= dict(zip(antenna_names(len(problem.position_offset)), place.antenna, strict=False))
    assert_same(found.border, dense.of(np.array([by_name[name] for name in found.border_names], int)))
    assert found.redundancy == dense.redundancy
    assert found.variance_factor == pytest.approx(dense.variance_factor, rel=1e-6)


@pytest.mark.parametrize("case", CASES)
def test_joint_covariance_of_cameras_is_a_part_of_the_dense_inverse(case: str):
    """It breaks where images or cameras are out of order, or what lies between those of two images is lost."""
    problem, loss, dense = case_and_dense(case)
    place = np.append(dense.step.poses.ravel(), dense.step.intrinsics.ravel()).astype(int)
    assert_same(camera_covariance(problem, loss=loss), dense.of(place))


@pytest.mark.parametrize("num_tiles", [1, 3])
def test_inner_constraints_are_those_of_a_dense_bordered_system(num_tiles: int):
    """The reference takes the directions that are free from the null space of J^T J, and the constraints as they stand.

    It breaks where priors still hold the block, a direction is missing, or constraints are over other unknowns.
    """
    problem = calibrated(small_block(lever_arm_std_m=0.05, num_control=4))
    found = statistics(problem, datum="inner", max_observations=problem.num_observations / num_tiles)
    assert [prior.name for prior in found.problem.priors] == ["intrinsics"]
    dense = Dense(found.problem)
    expected, jacobian = bordered_inverse(dense, found.problem, 7)
    assert_inner(found.covariance, expected, found.problem)
    leverage = np.einsum("ni,ij,nj->n", jacobian, expected, jacobian)
    of_pixels = 1 - leverage[: 2 * problem.num_observations]
    np.testing.assert_allclose(found.observations.redundancy.ravel(), of_pixels, rtol=0, atol=1e-8)
    total = sum(np.nansum(rows.redundancy) for rows in (found.observations, *found.priors))
    assert total == pytest.approx(found.covariance.redundancy, abs=1e-6)


def bordered_inverse(dense: Dense, problem: Problem, num_free: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the covariance of all unknowns under inner constraints over the points, and the Jacobian."""
    jacobian = np.concatenate([group.jacobian.reshape(-1, dense.size) for group in dense.groups()])
    jacobian = jacobian[np.isfinite(jacobian).all(axis=1)]
    normal = jacobian.T @ jacobian
    unit = 1 / np.sqrt(np.diagonal(normal))
    values, vectors = np.linalg.eigh(normal * np.outer(unit, unit))
    assert values[num_free - 1] < 1e-9 * values[num_free]
    directions = unit[:, None] * vectors[:, :num_free]
    over_points = np.zeros_like(directions)
    of_points = slice(dense.size - 3 * problem.num_points, None)
    over_points[of_points] = directions[of_points]
    bordered = np.block([[normal, over_points], [over_points.T, np.zeros((num_free, num_free))]])
    scale = np.append(unit, 1 / np.linalg.norm(over_points, axis=0))
    inverse = np.linalg.inv(bordered * np.outer(scale, scale)) * np.outer(scale, scale)
    return inverse[: dense.size, : dense.size], jacobian


def assert_inner(found: Covariance, expected: np.ndarray, problem: Problem) -> None:
    """Compare poses, points and intrinsics with those of a dense covariance."""
    images, refined = problem.num_images, int(np.count_nonzero(problem.free.intrinsics))
    for of, index in (
        (found.poses, np.arange(6 * images).reshape(-1, 6)),
        (found.points, np.arange(len(expected) - 3 * problem.num_points, len(expected)).reshape(-1, 3)),
        (found.border[None], 6 * images + np.arange(refined)[None]),
    ):
        blocks = expected[index[:, :, None], index[:, None]]
        sigma = np.sqrt(np.einsum("nii->ni", blocks))
        unit = sigma[:, :, None] * sigma[:, None]
        np.testing.assert_allclose(of / unit, blocks / unit, rtol=0, atol=1e-8)


def test_inner_constraints_are_refused_where_something_is_fixed():
    with pytest.raises(JaxbaError, match='1 poses are fixed; free them, or leave the datum at "priors"'):
        covariance(small_block().fix(poses=[3]), datum="inner")


def test_inner_constraints_are_refused_for_too_few_points():
    problem = uav_block(6, seed=6, points_per_image=16.0).problem
    seen = problem.observations
    often = np.argsort(-np.bincount(seen.point_index), kind="stable")[:8]
    kept = np.isin(seen.point_index, often)
    few = dataclasses.replace(problem, observations=jax.tree.map(lambda a: a[kept], seen))
    with pytest.raises(JaxbaError, match=r'datum "inner" needs 10 points or more'):
        covariance(few.fix(intrinsics=True), datum="inner")


def with_a_fixed_point() -> Problem:
    """As a block is in which a point seen once is held, so that both share one program."""
    return small_block().fix(points=[20])


def test_centers_are_positions_in_the_world():
    problem = with_a_fixed_point()
    found = covariance(problem)
    of_center = jax.jacfwd(lambda poses, step: poses.retract(step).center, argnums=1)
    seen = np.asarray(quick_jit(of_center)(problem.poses, np.zeros((12, 6))))
    for i in range(12):
        turn = seen[i, :, i]
        np.testing.assert_allclose(found.centers[i], turn @ found.poses[i] @ turn.T, rtol=1e-9, atol=1e-15)


def test_variance_factor_is_one_for_noise_as_large_as_its_sigma():
    problem = with_a_fixed_point()
    found = covariance(problem)
    # at the truth 2 cost is chi-squared with as many degrees as rows, not as the redundancy
    rows = 2 * problem.num_observations + 36
    assert found.variance_factor * found.redundancy / rows == pytest.approx(1.0, abs=4 * np.sqrt(2 / rows))


@pytest.mark.parametrize("index", [1, 2, 3], ids=["soft_l1", "huber", "cauchy"])
@pytest.mark.parametrize("times", [1.0, 3.0])
def test_variance_factor_tells_right_sigmas_from_small_ones_under_any_loss(index: int, times: float):
    loss = one_of(index)
    problem = uav_block(12, seed=6, points_per_image=28.0, mean_track_length=6.0).problem
    small = dataclasses.replace(problem.observations, std_px=problem.observations.std_px / times)
    position = problem.priors[0]
    problem = dataclasses.replace(
        problem, observations=small, priors=(dataclasses.replace(position, std_m=position.std_m / times),)
    )
    loss = dataclasses.replace(loss, f_scale=loss.f_scale * times)
    solution = solve(problem, loss=loss)
    factor = covariance(solution.apply(problem), loss=loss).variance_factor
    assert factor == pytest.approx(times**2, rel=0.1)  # the sigma of a variance of 2,000 residuals is 3%


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
    """Three points that an image shares with one other each give its pose three rows, with the points unknown."""
    problem = small_block(num_control=4)
    names = tuple(f"{i}.jpg" for i in range(12))
    seen, prior = problem.observations, problem.priors[0]
    mine = np.flatnonzero((seen.image_index == 4) & (seen.point_index > 20))
    others = [np.flatnonzero((seen.point_index == p) & (seen.image_index != 4))[1:] for p in seen.point_index[mine[:3]]]
    away = np.setdiff1d(np.flatnonzero(seen.image_index == 4), mine[:3])
    keep = np.setdiff1d(np.arange(problem.num_observations), np.concatenate([away, *others]))
    std_m = np.array(prior.std_m)
    std_m[4] = np.inf
    loose = dataclasses.replace(
        eqx.tree_at(lambda p: p.priors[0].std_m, problem, std_m),
        observations=Observations(seen.xy_px[keep], seen.std_px[keep], seen.image_index[keep], seen.point_index[keep]),
        image_names=names,
    )
    with pytest.raises(JaxbaError, match=r"do not determine the pose of image 4 \(4.jpg\)"):
        covariance(loose)


def test_without_shared_unknowns_tracks_tell_what_observations_do():
    problem = small_block().fix(intrinsics=True)
    assert_same(covariance(problem, independent="tracks").centers, covariance(problem).centers)


@pytest.mark.parametrize(
    ("case", "num_tiles"),
    [
        ("shared camera, every prior", 1),
        ("shared camera, every prior", 2),
        ("three cameras, fixed blocks, robust", 1),
        ("own cameras, some fixed", 1),
    ],
)
def test_covariances_by_tracks_are_those_of_dense_scores(case: str, num_tiles: int):
    """The reference sums each track's gradient with all unknowns of a dense system, its point among them."""
    problem, loss, plain = case_and_dense(case)
    rng = np.random.default_rng(0)
    seen = problem.observations
    worse = np.exp(rng.normal(size=problem.num_points))[np.asarray(seen.point_index)][:, None]
    noise = worse * np.asarray(seen.std_px)[:, None] * rng.normal(size=seen.xy_px.shape)
    problem = eqx.tree_at(lambda p: p.observations.xy_px, problem, np.asarray(seen.xy_px) + noise)
    room = problem.num_observations / num_tiles
    found = covariance(problem, loss=loss, independent="tracks", max_observations=room)
    dense = Dense(problem, loss)
    groups, weights = dense.groups(), []
    normal = np.zeros((dense.size, dense.size))
    for group in groups:
        weight = loss_derivatives(group.loss, np.sum(group.residual**2, axis=1))[1]
        weights.append(weight)
        normal += np.einsum("r,rcm,rcn->mn", weight, group.jacobian, group.jacobian, optimize=True)
    unit = 1 / np.sqrt(np.diagonal(normal))
    inverse = np.linalg.inv(normal * np.outer(unit, unit)) * np.outer(unit, unit)
    pixels, point = groups[0], np.asarray(problem.observations.point_index)
    scores = np.zeros((problem.num_points, dense.size))
    np.add.at(scores, point, np.einsum("r,rcm,rc->rm", weights[0], pixels.jacobian, pixels.residual))
    alike = np.einsum("r,rcm,rcn->mn", weights[0], pixels.jacobian, pixels.jacobian, optimize=True)
    of_points = 2 * np.bincount(point, minlength=problem.num_points) - 3 * np.asarray(problem.free.points)
    freedom = np.maximum(of_points, 0).sum()
    factor = np.sum(weights[0] * np.sum(pixels.residual**2, axis=1)) / freedom
    shared = np.ones(dense.size, bool)
    shared[: 6 * np.count_nonzero(problem.free.poses)] = False
    shared[dense.size - 3 * np.count_nonzero(problem.free.points) :] = False
    if case.startswith("own"):
        shared[: -3 * np.count_nonzero(problem.free.points) - np.count_nonzero(problem.free_antenna)] = False
    whiten = np.linalg.inv(np.linalg.cholesky(inverse[np.ix_(shared, shared)]))
    pulls = (scores @ inverse)[:, shared] @ whiten.T
    of_each = pulls[:, :, None] * pulls[:, None, :] / factor
    of_all = of_each.sum(axis=0)
    of_alike = whiten @ (inverse @ alike @ inverse)[np.ix_(shared, shared)] @ whiten.T
    chance = np.sum((of_each - of_all / len(of_each)) ** 2)
    certain = 1 - chance / np.sum((of_all - of_alike) ** 2)
    assert 0.2 < certain < 0.98
    whole = inverse + certain * (inverse @ (scores.T @ scores / factor - alike) @ inverse)
    place = plain.step.intrinsics.astype(int)
    matrix = np.zeros_like(plain.matrix)
    free = dense.flat(plain.step).astype(int)
    matrix[np.ix_(free, free)] = whole
    of_tracks = matrix[place[..., :, None], place[..., None, :]]
    if case.startswith("own"):  # each is its image's, and no unknown that tracks of other images tell
        assert_same(found.intrinsics, covariance(problem, loss=loss).intrinsics)
    else:
        assert_same(found.intrinsics, of_tracks)
        as_alike = covariance(problem, loss=loss).intrinsics[:, 0, 0]
        assert np.max(np.abs(found.intrinsics[:, 0, 0] / as_alike - 1)) > 0.005
    arm = plain.step.antenna[:3].astype(int)
    assert_same(found.lever_arm, matrix[np.ix_(arm, arm)])
