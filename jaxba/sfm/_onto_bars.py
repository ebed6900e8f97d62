"""A block brought onto its scale bars: each of them tested against all else, and the scale of a block without a place.

Bars with an end at a check point are compared alone. After each solve the bar that contradicts all else most, beyond
`OUTLIER` sigmas of what the block says without it, is set aside and the block solved again. A block that nothing
measured has placed is brought to the bars' scale before it is solved with them.
"""

import dataclasses
from collections.abc import Callable

import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool

from jaxba._errors import JaxbaError
from jaxba.ba import propagate
from jaxba.geometry import Similarity
from jaxba.scene import BarFit, Block, Control, ScaleBars
from jaxba.sfm._bar_ends import BarEnds
from jaxba.sfm._control_start import transformed
from jaxba.sfm._measured import OUTLIER
from jaxba.sfm._rounds import Solved
from jaxba.sfm._spread import spread, weighed

_LEAST_REDUNDANCY = 1e-6


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
    factor, block = 1.0, solved.block
    ends = BarEnds.of(block, bars, control)
    use = ends.has_place & ~bars.is_check
    if not block.is_georeferenced and use.any():
        factor = float(np.median(bars.length_m[use] / ends.distance_m[use]))
        block = transformed(block, scaling(factor))
    aside = np.zeros(bars.num, bool)
    if use.any():
        solved = solve(block, use, factor)
    while True:
        fit = _fit(solved, bars, use, aside, std_px, control, max_memory)
        over = np.where(use, np.nan_to_num(np.abs(fit.over_sigma)), 0.0)
        worst = int(np.argmax(over))
        if over[worst] <= OUTLIER:
            return solved, fit
        use[worst], aside[worst] = False, True
        solved = solve(solved.block, use, factor)


def scaling(factor: float) -> Similarity:
    """Return the similarity that multiplies coordinates."""
    return Similarity(scale=factor, rotation=np.eye(3), shift=np.zeros(3))


def _fit(
    solved: Solved,
    bars: ScaleBars,
    use: Bool[np.ndarray, " bars"],
    aside: Bool[np.ndarray, " bars"],
    std_px: float,
    control: Control,
    max_memory: float | str | None,
) -> BarFit:
    """Return how a solution fits all bars, with sigmas from its covariance."""
    block, ends = solved.block, BarEnds.of(solved.block, bars, control)
    shown = spread(block, solved.error_px, std_px, solved.loss).scatter
    problem = weighed(solved.problem, shown, block.num_observations)
    loss = dataclasses.replace(solved.loss, f_scale=solved.loss.f_scale / shown)
    others = ends.has_place & ~use
    problem, of_others = ends.in_problem(problem, block, others)
    points = np.full((bars.num, 2), -1)
    points[others] = of_others
    held = problem.prior("scale_bar")
    if held is not None:
        points[use] = np.asarray(vars(held)["point_index"]).reshape(-1, 2)
    rows = np.flatnonzero(points[:, 0] >= 0)
    distance, std = np.full(bars.num, np.nan), np.full(bars.num, np.nan)
    if len(rows):
        xyz, (one, other) = np.asarray(problem.points), points[rows].T
        distance[rows] = np.linalg.norm(xyz[one] - xyz[other], axis=1)
        try:
            found = propagate(
                lambda p: jnp.linalg.norm(p.points[one] - p.points[other], axis=1),
                problem,
                loss=loss,
                max_memory=max_memory,
            )
            std[rows] = np.sqrt(np.maximum(np.diagonal(found.covariance), 0.0))
        except JaxbaError:
            pass  # the sigmas of the block are told to be missing
    residual = distance - bars.length_m
    redundancy = 1 - std**2 / bars.std_m**2
    with np.errstate(invalid="ignore"):
        held_over = residual / (bars.std_m * np.sqrt(np.where(redundancy > _LEAST_REDUNDANCY, redundancy, np.nan)))
    return BarFit(
        distance_m=distance,
        distance_std_m=std,
        residual_m=residual,
        over_sigma=np.where(use, held_over, residual / np.hypot(std, bars.std_m)),
        is_used=use.copy(),
        is_set_aside=aside.copy(),
    )
