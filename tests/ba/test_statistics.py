"""Redundancy, tests and reliability equal what a dense Jacobian gives, and real adjustments with a row left out."""

import dataclasses
import threading

import numpy as np
import pytest
import scipy.stats
from dense_reference import Dense, loss_derivatives
from test_covariance import CASES

from jaxba.ba import (
    Problem,
    RowStatistics,
    Statistics,
    Step,
    _compiler,
    make_plan,
    prior_statistics,
    statistics,
    statistics_compiler,
)
from jaxba.ba.uncertainty._reliability import NONCENTRALITY, POWER, SIGNIFICANCE
from jaxba.geometry import Linear

_SOLVED = 24  # rows of a group that are left out of the dense equations, which are solved anew


@dataclasses.dataclass(frozen=True)
class DenseRows:
    """Of each row of a group; of some, what they are with the row left out.

    - `reach`: covariance of all unknowns with its predictions.
    """

    residual: np.ndarray
    weight: np.ndarray
    leverage: np.ndarray
    reach: np.ndarray
    some: np.ndarray
    error: np.ndarray
    covariance: np.ndarray


def dense_rows(dense: Dense) -> list[DenseRows]:
    groups = dense.groups()
    weights = [loss_derivatives(g.loss, np.sum(g.residual**2, axis=1))[1] for g in groups]
    normal = sum(
        np.einsum("r,rcm,rcn->mn", w, g.jacobian, g.jacobian, optimize=True)
        for w, g in zip(weights, groups, strict=True)
    )
    scale = 1 / np.sqrt(np.diagonal(normal))
    inverse = np.linalg.inv(normal * scale[:, None] * scale) * scale[:, None] * scale
    found = []
    for w, group in zip(weights, groups, strict=True):
        leverage = np.einsum("rcm,rdm->rcd", group.jacobian @ inverse, group.jacobian)
        some = np.arange(0, len(w), max(len(w) // _SOLVED, 1))
        error, covariance = [], []
        for k in some:
            j = group.jacobian[k]
            without = (normal - w[k] * j.T @ j) * scale[:, None] * scale
            right = np.column_stack([w[k] * j.T @ group.residual[k], j.T]) * scale[:, None]
            solved = np.linalg.solve(without, right) * scale[:, None]
            error.append(group.residual[k] + j @ solved[:, 0])
            covariance.append(np.eye(len(j)) + j @ solved[:, 1:])
        reach = np.einsum("mn,rcn->rmc", inverse, group.jacobian, optimize=True)
        found.append(DenseRows(group.residual, w, leverage, reach, some, np.array(error), np.array(covariance)))
    return found


@pytest.mark.parametrize(("case", "num_tiles"), [(case, 1 if k else 2) for k, case in enumerate(CASES)])
def test_row_statistics_equal_those_of_a_dense_jacobian(case: str, num_tiles: int):
    make, loss = CASES[case]
    problem = make()
    found = statistics(problem, loss=loss, max_observations=problem.num_observations / num_tiles)
    groups = found.observations, *found.priors
    dense = Dense(problem, loss)
    expected = dense_rows(dense)
    for rows, of_rows in zip(groups, expected, strict=True):
        assert_equal(rows, of_rows)
    assert_reach(found, expected, dense)
    if isinstance(loss, Linear):
        total = sum(np.nansum(rows.redundancy) for rows in groups)
        assert total == pytest.approx(found.covariance.redundancy, abs=1e-6)


def assert_equal(rows: RowStatistics, dense: DenseRows) -> None:
    own = np.einsum("nii->ni", dense.leverage)
    used = own > 0
    np.testing.assert_array_equal(np.isfinite(rows.redundancy), used)
    np.testing.assert_allclose(rows.weight, dense.weight, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(rows.over_sigma[used], dense.residual[used], rtol=0, atol=1e-8)
    np.testing.assert_allclose(rows.redundancy[used], (1 - dense.weight[:, None] * own)[used], rtol=0, atol=1e-8)
    # two rays of a point check each other in one direction: without one of them the equations are singular
    tested = (np.isfinite(rows.without) | ~used).all(axis=1)[dense.some] & used.any(axis=1)[dense.some]
    some, error, covariance = dense.some[tested], dense.error[tested], dense.covariance[tested]
    assert len(some) or not used.any()
    found = np.where(used[some], rows.without[some] / rows.std[some], 0.0)
    np.testing.assert_allclose(found, np.where(used[some], error, 0.0), rtol=1e-6, atol=1e-7)
    squared = np.einsum("ni,ni->n", error, np.linalg.solve(covariance, error[:, :, None])[:, :, 0])
    np.testing.assert_allclose(rows.row_test[some], squared, rtol=1e-6, atol=1e-7)
    # one component alone left out, by its own scalar formula
    weight, own, v = (part[some] for part in (rows.weight[:, None], own, dense.residual))
    alone = v / (1 - weight * own) / np.sqrt(1 + own / (1 - weight * own))
    np.testing.assert_allclose(rows.test[some][used[some]], alone[used[some]], rtol=1e-6, atol=1e-7)


def assert_reach(found: Statistics, expected: list[DenseRows], dense: Dense) -> None:
    """What an error just detectable does to a point, or to a camera's position, is what the covariances make of it."""
    problem = found.problem
    points, cameras = places(problem, dense)
    for rows, of_rows, group in zip(
        (found.observations, *found.priors), expected, (problem.observations, *problem.priors), strict=True
    ):
        if hasattr(group, "point_index"):
            place = points[group.point_index]
        elif hasattr(group, "image_index"):
            place = cameras[group.image_index]
        else:
            continue
        moved = np.take_along_axis(of_rows.reach, place[:, :, None], axis=1) * (place[:, :, None] >= 0)
        lengths = np.linalg.norm(moved, axis=1) * of_rows.weight[:, None] * (rows.detectable / rows.std)
        known = np.isfinite(rows.reach_m) & np.isfinite(lengths)
        assert known.any()
        np.testing.assert_allclose(rows.reach_m[known], lengths[known], rtol=1e-6, atol=1e-9)


def places(problem: Problem, dense: Dense) -> tuple[np.ndarray, np.ndarray]:
    """Return where each point and each camera's translation stand among the free unknowns, -1 where they are fixed.

    A camera's position moves by as much as its translation does, in another direction.
    """
    sizes = (problem.num_images, 6), problem.free.intrinsics.shape, problem.antenna.shape, (problem.num_points, 3)
    ends = np.cumsum([int(np.prod(size)) for size in sizes])
    number = np.arange(ends[-1]) + 1.0
    step = Step(*(part.reshape(size) for part, size in zip(np.split(number, ends[:-1]), sizes, strict=True)))
    place = np.full(ends[-1], -1)
    place[dense.flat(step).astype(int) - 1] = np.arange(dense.size)
    return place[step.points.astype(int) - 1], place[step.poses.astype(int) - 1][:, 3:]


def test_statistics_of_priors_alone_are_the_same():
    make, loss = CASES["shared camera, every prior"]
    problem = make()
    covariance, rows = prior_statistics(problem, loss=loss)
    found = statistics(problem, loss=loss, max_observations=problem.num_observations / 2)
    np.testing.assert_allclose(covariance.points, found.covariance.points, rtol=1e-9, atol=1e-15)
    for one, other in zip(rows, found.priors, strict=True):
        assert one.name == other.name
        for name in ("redundancy", "test", "row_test", "detectable", "reach_m"):
            np.testing.assert_allclose(getattr(one, name), getattr(other, name), rtol=1e-6, atol=1e-9)


def test_statistics_like_an_earlier_plan_are_the_same_and_compile_nothing_more():
    make, loss = CASES["shared camera, every prior"]
    problem = make()
    like = make_plan(problem, spare=0.2).shape
    stop = threading.Event()
    compile_all = statistics_compiler(problem, like, loss=loss, independent="tracks", stop=stop)
    stop.set()
    begun = _compiler._ahead.cache_info().misses
    compile_all()
    assert _compiler._ahead.cache_info().misses == begun  # it was stopped before
    stop.clear()
    compile_all()
    compiled = _compiler._ahead.cache_info().misses
    seen = problem.observations
    views = np.bincount(seen.point_index)[seen.point_index]
    keep = (np.arange(problem.num_observations) % 17 > 0) | (views < 4)  # no point is left with one
    kept = {field.name: getattr(seen, field.name)[keep] for field in dataclasses.fields(seen)}
    fewer = dataclasses.replace(problem, observations=dataclasses.replace(seen, **kept))
    found = statistics(fewer, loss=loss, independent="tracks", like=like)
    assert _compiler._ahead.cache_info().misses == compiled
    expected = statistics(fewer, loss=loss, independent="tracks")
    assert _compiler._ahead.cache_info().misses > compiled
    np.testing.assert_allclose(found.covariance.points, expected.covariance.points, rtol=1e-9, atol=1e-15)
    np.testing.assert_allclose(found.covariance.border, expected.covariance.border, rtol=1e-6, atol=1e-15)
    np.testing.assert_allclose(found.observations.redundancy, expected.observations.redundancy, rtol=1e-6, atol=1e-9)


def test_detectable_errors_are_those_of_the_level_and_power_of_the_test():
    # shifted by Baarda's 4.13, a standard normal variable is beyond the limit of 0.1% in four of five cases
    limit = scipy.stats.norm.isf(SIGNIFICANCE / 2)
    assert scipy.stats.norm.sf(limit - NONCENTRALITY) == pytest.approx(POWER, abs=1e-6)
    assert pytest.approx(4.13, abs=0.005) == NONCENTRALITY
