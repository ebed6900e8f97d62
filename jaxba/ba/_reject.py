"""Rounds of solve and reject: observations beyond median + factor x MAD are left out, and the rest is solved again.

The threshold is the one surveyors know from other programs: the median of the reprojection errors in pixels plus
`mad_factor` times their median absolute deviation, not scaled. Each round judges all observations anew, so one that was
left out comes back if it fits after all.
"""

import dataclasses
from collections.abc import Callable, Generator
from typing import Any

import equinox as eqx
import numpy as np
from jaxtyping import Bool

from jaxba.ba._problem import Observations, Problem
from jaxba.ba._quality import Quality, quality, require_mad_factor
from jaxba.ba._solution import Solution
from jaxba.ba._solve import solve
from jaxba.geometry import require_number


@dataclasses.dataclass(frozen=True)
class Rejected:
    """Result of `solve_and_reject`.

    - `solutions`: of each round; `solution` is the last one's.
    - `used`: the observations that the last round used.
    - `quality`: errors of all observations at the solution, statistics over those used.
    - `num_rejected`: rejected before each round after the first.
    """

    solutions: tuple[Solution, ...]
    used: Bool[np.ndarray, " observations"]
    quality: Quality
    num_rejected: tuple[int, ...]

    @property
    def solution(self) -> Solution:
        return self.solutions[-1]


def solve_and_reject(
    problem: Problem,
    *,
    rounds: int = 2,
    mad_factor: float = 2.5,
    solver: Callable[..., Solution] = solve,
    **options: Any,
) -> Rejected:
    """Solve, then `rounds` times reject by the MAD rule and solve again from there.

    - `solver`: `solve` or `solve_tiled`, to which the `options` belong.

    >>> import jaxba
    >>> survey = jaxba.synthetic.uav_block(8, outlier_fraction=0.05)
    >>> cleaned = jaxba.solve_and_reject(survey.problem, rounds=2, loss=jaxba.Huber(1.0))
    >>> bool((cleaned.used & survey.truth.is_outlier).sum() < 0.1 * survey.truth.is_outlier.sum())
    True
    """
    steps = rejecting(problem, rounds=rounds, mad_factor=mad_factor)
    subset = next(steps)
    while True:
        try:
            subset = steps.send(solver(subset, **options))
        except StopIteration as done:
            return done.value


def rejecting(problem: Problem, *, rounds: int = 2, mad_factor: float = 2.5) -> Generator[Problem, Solution, Rejected]:
    """Yield the problem of each round, take its solution, and return what `solve_and_reject` does.

    So whoever solves has a choice of when and how, such as many problems at once.
    """
    require_number("solve_and_reject: rounds", rounds, 0.0, 2.0**31 - 1, "give a whole number, 0 or more", whole=True)
    require_mad_factor(mad_factor)
    used = np.ones(problem.num_observations, bool)
    solution = yield problem
    num_rejected, solutions = [], [solution]
    while True:
        used = _kept(used, solution)
        problem = solution.apply(problem)
        found = quality(problem, used, mad_factor=mad_factor)
        fits = _with_bar_ends(problem, used, found.error_px <= found.threshold_px)
        if len(num_rejected) == int(rounds) or np.array_equal(fits, used) or solution.result == "interrupted":
            return Rejected(tuple(solutions), used, found, tuple(num_rejected))
        num_rejected.append(int(np.count_nonzero(~fits)))
        used = fits
        solution = yield _with_observations(problem, used)
        solutions.append(solution)


def _with_bar_ends(
    problem: Problem, used: Bool[np.ndarray, " observations"], fits: Bool[np.ndarray, " observations"]
) -> Bool[np.ndarray, " observations"]:
    """Return what fits, with all observations of ends of scale bars that would keep fewer than two of them."""
    bars = problem.prior("scale_bar")
    if bars is None:
        return fits
    point = np.asarray(problem.observations.point_index)
    few = np.bincount(point[fits], minlength=problem.num_points) < 2
    is_end = np.isin(np.arange(problem.num_points), np.asarray(vars(bars)["point_index"]))
    return fits | (used & (few & is_end)[point])


def _with_observations(problem: Problem, used: Bool[np.ndarray, " observations"]) -> Problem:
    seen = problem.observations
    subset = Observations(
        np.asarray(seen.xy_px)[used],
        np.asarray(seen.std_px)[used],
        np.asarray(seen.image_index)[used],
        np.asarray(seen.point_index)[used],
    )
    return eqx.tree_at(lambda p: p.observations, problem, subset)


def _kept(used: Bool[np.ndarray, " observations"], solution: Solution) -> Bool[np.ndarray, " observations"]:
    """Return which of the observations that a solve was given it kept."""
    kept = used.copy()
    if solution.report is not None:
        kept[used] = ~solution.report.dropped.observations
    return kept
