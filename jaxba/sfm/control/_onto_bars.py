"""A block brought onto its scale bars: each of them tested against all else, and the scale of a block without a place.

Bars are tested before they may pull. With m what the block without any bar says of them minus their lengths, and
P = (C + S)^-1, C the covariance of the distances and S that of the lengths, the bar with the largest

    |w_i| = |(P m)_i| / sqrt(P_ii)

over `OUTLIER` is set aside and the others tested anew; where another one has the same w, which two bars against each
other have, nothing tells which is wrong, and all of these are set aside. A block that nothing measured has placed is
brought to the median scale of its bars, and C leaves that free. The block is then solved with the bars that are left,
and these tested again where they hold it. Bars with an end at a check point are compared alone.
"""

import contextlib
import dataclasses
from collections.abc import Callable

import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int

from jaxba._errors import JaxbaError
from jaxba.ba import propagate
from jaxba.geometry import Similarity
from jaxba.scene import BarFit, Block, Control, ScaleBars
from jaxba.sfm._measured import OUTLIER
from jaxba.sfm._rounds import Solved
from jaxba.sfm._spread import spread, weighed
from jaxba.sfm.control._bar_ends import BarEnds
from jaxba.sfm.control._start import transformed

_LEAST_REDUNDANCY = 1e-6
_ALIKE = 5e-3  # tests that differ by no more of the largest tell nothing of which is wrong


@dataclasses.dataclass(frozen=True, eq=False)
class _Bars:
    """Bars, and what their sigmas are computed with."""

    bars: ScaleBars
    std_px: float
    control: Control
    max_memory: float | str | None

    def ends(self, block: Block) -> BarEnds:
        return BarEnds.of(block, self.bars, self.control)


def onto_bars(
    solved: Solved,
    bars: ScaleBars,
    std_px: float,
    control: Control,
    max_memory: float | str | None,
    solve: Callable[[Block, Bool[np.ndarray, " bars"], float], Solved],
) -> tuple[Solved, BarFit]:
    """Return the block solved with the bars that all else agrees with, and how it fits them.

    - `solve`: solves a block with some of the bars; its last argument is how much larger it is than at the start.
    """
    if not bars.num:
        return solved, BarFit.nothing()
    given, is_free = _Bars(bars, std_px, control, max_memory), not solved.block.is_georeferenced
    nothing = np.zeros(bars.num, bool)
    ends = given.ends(solved.block)
    use = ends.has_place & ~bars.is_check
    seen = _distances(solved, given, nothing)
    aside, unclear = _tested(seen, bars, use, is_free=is_free)
    use &= ~aside
    factor = 1.0
    while True:
        if use.any() and is_free:
            now = given.ends(solved.block).distance_m[use]
            grow = float(np.median(bars.length_m[use] / now))
            factor, solved = factor * grow, dataclasses.replace(solved, block=transformed(solved.block, scaling(grow)))
        if use.any() or solved.problem.num_bar_ends:  # else no bar holds the block, nor did one
            solved = solve(solved.block, use, factor)
        fit = _fit(solved, given, use, aside, unclear)
        over = np.where(use, np.nan_to_num(np.abs(fit.over_sigma)), 0.0)
        worst = int(np.argmax(over))
        if over[worst] <= OUTLIER:
            return solved, fit
        use[worst], aside[worst] = False, True


def scaling(factor: float) -> Similarity:
    """Return the similarity that multiplies coordinates."""
    return Similarity(scale=factor, rotation=np.eye(3), shift=np.zeros(3))


def compared(block: Block, map_points: Callable[[np.ndarray], np.ndarray], bars: ScaleBars, control: Control) -> BarFit:
    """Return how a block that was fitted to control afterwards fits the bars, by their marks alone.

    - `map_points`: what coordinates take beside the block.
    """
    ends = BarEnds.of(block, bars, control)
    xyz_m = map_points(ends.point_m)
    along = xyz_m[bars.first] - xyz_m[bars.second]
    distance_m = np.linalg.norm(along, axis=1)
    residual_m = distance_m - bars.length_m
    variance_m2 = ends.variance_m2[bars.first] + ends.variance_m2[bars.second]
    std_m = np.sqrt(np.sum((along / distance_m[:, None]) ** 2 * variance_m2, axis=1))
    no = np.zeros(bars.num, bool)
    return BarFit(
        distance_m=distance_m,
        distance_std_m=std_m,
        residual_m=residual_m,
        over_sigma=residual_m / np.hypot(std_m, bars.std_m),
        is_used=no,
        is_set_aside=no,
        is_unclear=no,
    )


@dataclasses.dataclass(frozen=True, eq=False)
class _Distances:
    """Distances of bars in a solution, NaN without a place, and the joint covariance of those of `rows`."""

    distance_m: Float[np.ndarray, " bars"]
    rows: Int[np.ndarray, " known"]
    covariance_m2: Float[np.ndarray, "known known"]


def _distances(solved: Solved, given: _Bars, use: Bool[np.ndarray, " bars"]) -> _Distances:
    """Return the distances in a solution that `use` holds; without a covariance where there is none."""
    block, bars, ends = solved.block, given.bars, given.ends(solved.block)
    shown = spread(block, solved.error_px, given.std_px, solved.loss).scatter
    problem = weighed(solved.problem, shown, block.num_observations)
    loss = dataclasses.replace(solved.loss, f_scale=solved.loss.f_scale / shown)
    points, number = np.full((bars.num, 2), -1), {}
    if solved.control is not None:
        labels = [given.control.names[row] for row in solved.control.rows]
        number = {label: block.num_points + k for k, label in enumerate(labels)}
    held = problem.prior("scale_bar")
    if held is not None:
        points[use] = np.asarray(vars(held)["point_index"]).reshape(-1, 2)
        for end, point in zip(
            np.stack([bars.first, bars.second], axis=1)[use].ravel(), points[use].ravel(), strict=True
        ):
            number[bars.ends.names[end]] = int(point)
    others = ends.has_place & ~use
    problem, points[others] = ends.in_problem(problem, block, others, tuple(number.items()))
    rows = np.flatnonzero(points[:, 0] >= 0)
    distance_m, covariance_m2 = np.full(bars.num, np.nan), np.full((len(rows),) * 2, np.nan)
    if len(rows):
        xyz, (one, other) = np.asarray(problem.points), points[rows].T
        distance_m[rows] = np.linalg.norm(xyz[one] - xyz[other], axis=1)
        with contextlib.suppress(JaxbaError):  # that the block has no sigmas is told
            covariance_m2 = propagate(
                lambda p: jnp.linalg.norm(p.points[one] - p.points[other], axis=1),
                problem,
                loss=loss,
                max_memory=given.max_memory,
            ).covariance
    return _Distances(distance_m, rows, covariance_m2)


def _tested(
    seen: _Distances, bars: ScaleBars, use: Bool[np.ndarray, " bars"], *, is_free: bool
) -> tuple[Bool[np.ndarray, " bars"], Bool[np.ndarray, " bars"]]:
    """Return which bars contradict all else, by a block without any, and those of them that may be right."""
    aside, unclear = np.zeros(bars.num, bool), np.zeros(bars.num, bool)
    left = np.flatnonzero(use[seen.rows])
    if not np.isfinite(seen.covariance_m2).all():
        return aside, unclear
    while len(left):
        row = seen.rows[left]
        length_m, distance_m = bars.length_m[row], seen.distance_m[row]
        grow = float(np.median(length_m / distance_m)) if is_free else 1.0
        covariance_m2 = grow**2 * seen.covariance_m2[np.ix_(left, left)]
        if is_free:
            covariance_m2 = covariance_m2 + np.outer(length_m, length_m)  # of the scale nothing is known
        weight = np.linalg.inv(covariance_m2 + np.diag(bars.std_m[row] ** 2))
        test = np.abs(weight @ (grow * distance_m - length_m)) / np.sqrt(np.diagonal(weight))
        worst = test >= (1 - _ALIKE) * test.max()
        if test.max() <= OUTLIER:
            break
        aside[row[worst]] = True
        unclear[row[worst]] = worst.sum() > 1
        left = left[~worst]
    return aside, unclear


def _fit(
    solved: Solved,
    given: _Bars,
    use: Bool[np.ndarray, " bars"],
    aside: Bool[np.ndarray, " bars"],
    unclear: Bool[np.ndarray, " bars"],
) -> BarFit:
    """Return how a solution that `use` holds fits all bars."""
    bars, seen = given.bars, _distances(solved, given, use)
    std_m = np.full(bars.num, np.nan)
    std_m[seen.rows] = np.sqrt(np.maximum(np.diagonal(seen.covariance_m2), 0.0))
    residual_m = seen.distance_m - bars.length_m
    redundancy = 1 - std_m**2 / bars.std_m**2
    with np.errstate(invalid="ignore"):
        held_over = residual_m / (bars.std_m * np.sqrt(np.where(redundancy > _LEAST_REDUNDANCY, redundancy, np.nan)))
    return BarFit(
        distance_m=seen.distance_m,
        distance_std_m=std_m,
        residual_m=residual_m,
        over_sigma=np.where(use, held_over, residual_m / np.hypot(std_m, bars.std_m)),
        is_used=use.copy(),
        is_set_aside=aside.copy(),
        is_unclear=unclear.copy(),
    )
