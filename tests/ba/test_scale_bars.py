"""Scale bars are one row `(|x - y| - L) / sigma` each: optimum, covariances and tests equal a dense reference."""

import dataclasses
from typing import ClassVar

import equinox as eqx
import numpy as np
import pytest
from dense_reference import Dense
from jax import Array
from small_problems import RADIAL, small_problem, with_bars
from test_covariance import assert_inner, bordered_inverse, calibrated, dense_covariance, small_block
from test_statistics import dense_rows

import jaxba
from jaxba._errors import JaxbaError
from jaxba.ba import AbstractPrior, Problem, Rows, ScaleBarPrior, Unknowns, free_gauge, with_scale_bars
from jaxba.ba._projection import camera_centers
from jaxba.geometry import AbstractLoss, Cauchy, Linear


class PlainBars(AbstractPrior):
    """The bars of `ScaleBarPrior` as the formula says it, for the dense reference alone."""

    name: ClassVar[str] = "bars"
    one: np.ndarray
    other: np.ndarray
    length_m: np.ndarray
    std: np.ndarray
    loss: AbstractLoss = Linear()

    def residual(self, unknowns: Unknowns) -> Array:
        apart = unknowns.points[self.one] - unknowns.points[self.other]
        return ((((apart**2).sum(axis=1)) ** 0.5 - self.length_m) / self.std)[None]

    def rows(self, unknowns: Unknowns) -> Rows:
        raise NotImplementedError


def plain(problem: Problem, without: Problem) -> Problem:
    """Return `without` with the bars of a problem as plain rows."""
    bars = problem.prior("scale_bar")
    assert isinstance(bars, ScaleBarPrior)
    one, other = np.asarray(bars.point_index).reshape(-1, 2).T
    length_m, std = np.asarray(bars.length_m)[::2], np.asarray(bars.std_m)[::2, 0]
    return dataclasses.replace(without, priors=(*without.priors, PlainBars(one, other, length_m, std)))


@pytest.fixture(scope="module")
def without() -> Problem:
    return small_problem(RADIAL, lever_arm=True, position_offset=True)


@pytest.fixture(scope="module")
def solution(without: Problem) -> jaxba.Solution:
    return jaxba.solve(with_bars(without), ftol=0.0, xtol=1e-12)


def test_the_optimum_is_scipys_and_the_cost_that_of_the_plain_rows(without: Problem, solution: jaxba.Solution):
    reference = Dense(plain(with_bars(without), without))
    vector = reference.scipy_optimum()
    assert float(solution.final_cost) == pytest.approx(reference.cost(vector), rel=1e-10)
    offsets = dataclasses.replace(solution, position_offset=solution.position_offset[:2]).apply(without)
    parameters = np.stack([np.asarray(getattr(offsets.cameras, n)) for n in offsets.cameras.parameter_names()], axis=1)
    found = reference.tangent(Unknowns(offsets.poses, parameters, offsets.antenna, offsets.points))
    scale = np.sqrt(sum(np.sum(g.jacobian**2, axis=(0, 1)) for g in reference.groups(vector)))
    np.testing.assert_allclose(scale * found, scale * vector, atol=1e-4)  # sigmas, of thousands
    # the bars bend the block
    bare = jaxba.solve(without)
    assert np.abs(np.asarray(bare.points) - np.asarray(solution.points)).max() > 0.05


@pytest.mark.parametrize("num_tiles", [1, 2])
def test_covariances_and_tests_are_those_of_the_plain_rows(without: Problem, solution: jaxba.Solution, num_tiles: int):
    problem = solution.apply(with_bars(without))
    of_plain = plain(
        problem, dataclasses.replace(solution, position_offset=solution.position_offset[:2]).apply(without)
    )
    found = jaxba.statistics(problem, max_observations=problem.num_observations / num_tiles)
    expected = dense_covariance(of_plain, Linear())
    covariance = found.covariance
    for blocks, place in ((covariance.points, expected.step.points), (covariance.poses, expected.step.poses)):
        of_dense = expected.of(place.astype(int))
        scale = 1 / np.sqrt(np.einsum("nii->ni", of_dense))
        whole = of_dense * scale[:, :, None] * scale[:, None]
        np.testing.assert_allclose(blocks * scale[:, :, None] * scale[:, None], whole, atol=1e-8)
    antenna = expected.of(expected.step.antenna.astype(int))
    np.testing.assert_allclose(covariance.position_offset, antenna[3:, 3:], rtol=1e-7, atol=1e-14)
    assert len(covariance.border) == len(covariance.border_names) and not any(
        "offset 2" in n for n in covariance.border_names
    )
    assert covariance.redundancy == expected.redundancy
    assert covariance.variance_factor == pytest.approx(expected.variance_factor, rel=1e-9)
    dense = dense_rows(Dense(of_plain))[-1]
    bars, own = found.prior("scale_bar"), dense.leverage[:, 0, 0]
    np.testing.assert_allclose(bars.residual[:, 0], dense.residual[:, 0] * [0.02, 0.05], rtol=1e-6)
    np.testing.assert_allclose(bars.redundancy[:, 0], 1 - own, rtol=1e-7)
    np.testing.assert_allclose(bars.test[:, 0], dense.residual[:, 0] / np.sqrt(1 - own), rtol=1e-6)
    assert np.isnan(bars.reach_m).all()
    total = np.nansum(found.observations.redundancy) + sum(np.nansum(rows.redundancy) for rows in found.priors)
    assert total == pytest.approx(covariance.redundancy, abs=1e-6)
    table = found.prior_frame("scale_bar")
    assert table["point_1"].tolist() == [2, 9] and table["point_2"].tolist() == [9, 5]
    component = next(c for c in found.components if c.group == "scale_bar")
    assert component.count == 2 and component.redundancy == pytest.approx(np.sum(1 - own))
    assert len(found.reweighted().prior("scale_bar").std_m) == 4


def test_a_bar_sets_the_scale_of_a_free_block(without: Problem):
    free = dataclasses.replace(without, priors=()).fix(poses=[0], intrinsics=True)
    free = eqx.tree_at(lambda p: (p.free.lever_arm, p.free.position_offset), free, (np.array(False),) * 2)
    assert free_gauge(free) == ("scale",)

    def solved(length_m: float) -> jaxba.Solution:
        return jaxba.solve(with_scale_bars(free, [2], [9], [length_m], [0.01]), ftol=0.0, xtol=1e-12)

    assert free_gauge(with_scale_bars(free, [2], [9], [20.0], [0.01])) == ()
    one, other = solved(20.0), solved(20.001)
    points = np.asarray(one.points)
    assert np.linalg.norm(points[2] - points[9]) == pytest.approx(20.0, abs=1e-9)
    assert one.report is not None
    seen = np.setdiff1d(np.arange(len(points)), one.report.dropped.points)
    growth = (np.asarray(other.points) - points)[seen] / 0.001
    origin = camera_centers(free.poses)[0]
    np.testing.assert_allclose(growth, (points[seen] - origin) / 20.0, atol=1e-4)


@pytest.mark.parametrize(
    ("given", "message"),
    [
        (([2], [2], [1.0], [0.1]), "has point 2 at both ends"),
        (([2], [99], [1.0], [0.1]), "bar 0 has point 99 of 20"),
        (([2, 9], [9, 2], [1.0, 1.0], [0.1, 0.1]), "two bars have the same points"),
        (([2], [9], [-1.0], [0.1]), "bar 0 has length_m=-1"),
        (([2], [9], [1.0], [np.nan]), "bar 0 has std_m=nan"),
        (([2], [9], [1.0, 2.0], [0.1]), r"length_m has shape \(2,\) for 1 bars"),
        (([], [], [], []), "give one point number or more"),
        (([1, 2], [3], [1.0], [0.1]), "and as many in second"),
    ],
)
def test_bars_that_cannot_be_are_refused(without: Problem, given: tuple, message: str):
    with pytest.raises(JaxbaError, match=message):
        with_scale_bars(without, *given)


def test_bars_twice_a_bar_cut_in_two_and_tiles_are_refused(without: Problem):
    problem = with_bars(without)
    with pytest.raises(JaxbaError, match="give all of them at once"):
        with_bars(problem)
    half = dataclasses.replace(problem, free=dataclasses.replace(problem.free, position_offset=np.array(False)))
    with pytest.raises(JaxbaError, match="two rows, one after the other, are one bar"):
        jaxba.solve(half)
    robust = dataclasses.replace(problem.prior("scale_bar"), loss=Cauchy(2.0))
    with pytest.raises(JaxbaError, match="prior scale_bar: loss Cauchy; it is to be Linear"):
        jaxba.solve(dataclasses.replace(problem, priors=(*problem.priors[:-1], robust)))
    with pytest.raises(JaxbaError, match="the block has scale bars"):
        jaxba.partition(problem, max_images=2, overlap=1)


def test_rejection_leaves_an_end_the_two_observations_that_it_needs(without: Problem):
    problem = with_bars(without)
    seen = problem.observations
    mine = np.flatnonzero(np.asarray(seen.point_index) == 9)
    kept = np.setdiff1d(np.arange(problem.num_observations), mine[2:])
    xy_px = np.array(seen.xy_px)
    xy_px[mine[0]] += 60.0
    few = jaxba.Observations(xy_px[kept], seen.std_px[kept], seen.image_index[kept], seen.point_index[kept])
    found = jaxba.solve_and_reject(dataclasses.replace(problem, observations=few), loss=Cauchy(2.0))
    assert found.used[np.isin(kept, mine[:2])].all() and not found.used.all()


def test_inner_constraints_leave_the_scale_to_the_bars():
    """The reference has the plain rows, and constraints over what they leave free: six directions."""
    problem = small_block()
    problem = calibrated(with_scale_bars(problem, [0, 5], [9, 14], [30.0, 25.0], [0.01, 0.02]))
    found = jaxba.statistics(problem, datum="inner")
    assert [prior.name for prior in found.problem.priors] == ["intrinsics", "scale_bar"]
    alone = plain(found.problem, dataclasses.replace(
        found.problem, priors=found.problem.priors[:1], position_offset=np.zeros((0, 3)),
        free=dataclasses.replace(found.problem.free, position_offset=np.array(False)),
    ))  # fmt: skip
    expected, _ = bordered_inverse(Dense(alone), alone, 6)
    assert_inner(found.covariance, expected, alone)
    total = sum(np.nansum(rows.redundancy) for rows in (found.observations, *found.priors))
    assert total == pytest.approx(found.covariance.redundancy, abs=1e-6)


def test_offsets_that_are_held_go_into_the_positions(without: Problem):
    held = dataclasses.replace(without, free=dataclasses.replace(without.free, position_offset=np.array(False)))
    found = with_bars(held)
    assert len(found.position_offset) == found.num_bar_ends == 4
    assert found.prior("position_offset") is None
    before, after = held.prior("position"), found.prior("position")
    np.testing.assert_allclose(after.xyz, before.xyz - before.offset(np.asarray(held.position_offset)))
