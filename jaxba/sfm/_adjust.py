"""The adjustment in rounds: solve, judge every observation anew, prune edges, triangulate anew, solve again.

A round is in `_rounds.py`; how observations are judged stands in `_judge.py`, how edges are in `_edges.py`.

Tracks are completed before the first round (see `_complete.py`), so that all rounds have one shape: a radius of 2 to
6 px finds as much at the start values as at adjusted ones (points seen three times or more: +17% and +37% in two
blocks, 1% more from adjusted poses).

The first round frees the focal length and k1 alone and takes a few steps; all rounds share compiled code. A round ends
where the cost changes by less than 1e-4, and goes on to the last digits once the median has settled. The sigma of
an observation is estimated from the errors themselves, so that pixels and GNSS are weighed against each other rightly.
Convergence is judged by the median of the errors: it changes by less than 1%.
"""

import dataclasses
import functools
import logging
import threading
from collections.abc import Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from jaxba._errors import JaxbaError
from jaxba.ba import PlanShape, Problem, Solution, make_plan, statistics_compiler
from jaxba.geometry import AbstractLoss
from jaxba.scene import (
    BarFit,
    Block,
    CommonOffset,
    Control,
    Features,
    LeftOut,
    Photo,
    PrunedEdge,
    Reference,
    ScaleBars,
    Tracks,
    ViewGraph,
)
from jaxba.sfm._complete import complete_tracks
from jaxba.sfm._edges import edge_medians_px, edges_to_prune, match_rows, without_edges
from jaxba.sfm._intrinsics import free_parameters
from jaxba.sfm._judge import estimate_std, judge, used_in_track
from jaxba.sfm._points import apply_points, triangulate_tracks
from jaxba.sfm._rounds import Rounds, Settings, Solved, Tiling, without_images
from jaxba.sfm._spread import spread
from jaxba.sfm.control._control import ControlPart, Standing, agreeing_marks, mark_std
from jaxba.sfm.control._onto_bars import onto_bars, scaling
from jaxba.sfm.control._onto_control import OnControl, onto_control
from jaxba.sfm.control._start import transformed

_log = logging.getLogger(__name__)

_START_ERROR = 0.005  # of the longer side: what start values are good to
_FIRST_STEPS, _ROUND_STEPS, _ROUND_FTOL = 12, 40, 1e-4  # before the median has settled
_CONVERGED = 0.01
_SPARE = 0.03  # room for tracks that pruning cuts in two
_LEAST_OBSERVATIONS = 3  # of an image: fewer do not fix a pose


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class Adjusted:
    """Result of the rounds.

    - `block`: adjusted; its observations are those of the last solve. `error_px`: of each.
    - `problem`, `loss`: of the last solve, at its solution. `solution`: of the last solve.
    - `std_px`: sigma of an observation's coordinates. `position_scale`: factor on the sigmas of positions.
    - `num_judged`: observations that were judged by their error; those not in the block were rejected.
    - `limit_px`: error over which they were, of an observation in a long track (`_judge.py`); NaN without a round.
    - `medians_px`: of each round's observations after its solve. `converged`: the median no longer changed.
    - `control`: the control points of the last solve, their start values at its solution; `on_control`: what their
      tests said. `mark_used`: of all marks, those that agree with the others of their point.
    - `mark_std_px`: sigma of marks.
    - `common_m`: what measured positions are off in common, as far as control tells it.
    - `bars`: how the block fits its scale bars.
    - `max_memory`: that solving in tiles was allowed; None in one piece.
    - `shape`: of all rounds' plans; None in tiles. `compiled`: ends when what statistics call is compiled for it.
    - `pruned`: edges left out. `lost`: images that had too few observations left. `notes`: what else was decided.
    """

    block: Block
    error_px: Float[np.ndarray, " observations"]
    problem: Problem
    loss: AbstractLoss
    solution: Solution
    std_px: float
    position_scale: Float[np.ndarray, "3"]
    num_judged: int
    limit_px: float
    medians_px: tuple[float, ...]
    converged: bool
    pruned: tuple[PrunedEdge, ...]
    lost: tuple[LeftOut, ...]
    notes: tuple[str, ...]
    mark_used: Bool[np.ndarray, " marks"]
    mark_std_px: float
    common_m: Float[np.ndarray, "3"]
    control: ControlPart | None = None
    on_control: OnControl | None = None
    bars: BarFit = dataclasses.field(default_factory=BarFit.nothing)
    max_memory: float | str | None = None
    shape: PlanShape | None = None
    compiled: Future[None] | None = None

    @functools.cached_property
    def spread(self) -> float:
        """Times `std_px` that the errors of observations bear on the result."""
        return spread(self.block, self.error_px, self.std_px, self.loss).scatter

    @property
    def common(self) -> CommonOffset | None:
        """What positions have in common as an unknown, where the last solve put it; None where it was none."""
        common = None if self.on_control is None else self.on_control.standing.common
        return None if common is None else CommonOffset(self.common_m, common.std_m)

    @property
    def num_rejected(self) -> int:
        return self.num_judged - self.block.num_observations


def adjust(
    block: Block,
    tracks: Tracks,
    view_graph: ViewGraph,
    reference: Reference,
    photos: Sequence[Photo],
    settings: Settings,
    features: Mapping[int, Features] | None = None,
    control: Control | None = None,
    tiling: Tiling | None = None,
    bars: ScaleBars | None = None,
    *,
    with_statistics: bool = False,
) -> Adjusted:
    """Return the adjusted block; `block` holds the start values, with points or without.

    - `features`: of every image, by index, to complete tracks from; without them tracks stay as they are.
    - `control`: surveyed points; its check points take no part. `tiling`: of large blocks. `bars`: known distances.
    - `with_statistics`: that `uncertainty` will be asked for them: what they call is compiled beside the rounds.

    Raises `JaxbaError` where the block has fewer than two images, or no point of it is left.
    """
    if block.num_images < 2:
        raise JaxbaError(f"The block has {block.num_images} images with start values; an adjustment needs two or more.")
    control = Control.nothing() if control is None else control
    rounds = Rounds(
        anchor=block,
        reference=reference,
        photos=photos,
        settings=settings,
        control=control,
        tiling=Tiling() if tiling is None else tiling,
    )
    bars = ScaleBars.nothing() if bars is None else bars
    stop = threading.Event()
    try:
        return _in_rounds(rounds, block, tracks, view_graph, features, bars, stop if with_statistics else None)
    except BaseException:
        stop.set()
        raise


def _in_rounds(
    rounds: Rounds,
    block: Block,
    tracks: Tracks,
    view_graph: ViewGraph,
    features: Mapping[int, Features] | None,
    bars: ScaleBars,
    stop: threading.Event | None,
) -> Adjusted:
    """Return what `adjust` does; `stop`: of what is compiled for statistics, None where it is not."""
    reference, photos, settings, control = rounds.reference, rounds.photos, rounds.settings, rounds.control
    if not block.num_points:
        limit = 4 * settings.track_threshold
        block = apply_points(block, tracks, triangulate_tracks(block, tracks, settings.min_angle_rad, limit))
    given, gone = tracks, np.zeros(len(view_graph.pairs), bool)
    tracks = _completed(given, block, photos, settings, features)
    if tracks is not given:
        longer = max(max(photos[i].width_px, photos[i].height_px) for i in block.image_index)
        limit = max(4 * settings.track_threshold, _START_ERROR * longer)
        block = apply_points(block, tracks, triangulate_tracks(block, tracks, settings.min_angle_rad, limit))
    matches = match_rows(view_graph, tracks)
    pruned, lost, notes, medians = [], [], [], []
    std_px, converged, settled, num_judged = 1.0, False, False, block.num_observations
    limit_px, (shape, compiled) = None, _compiled(rounds, block, tracks, stop)
    mark_used = np.ones(len(control.mark_point), bool)
    small, every = (
        [name for name in free_parameters(block.camera_model, num_images=num) if name not in settings.held]
        for num in (0, block.num_images)
    )
    while True:
        last = len(medians) + 1 >= settings.max_rounds
        free = every if medians or last else small
        to_the_end = last or settled
        steps = settings.max_nfev if to_the_end else _ROUND_STEPS if medians else _FIRST_STEPS
        solve = functools.partial(
            rounds.solve, std_px=std_px, free=free, mark_used=mark_used, shape=shape, number=len(medians) + 1
        )
        ftol = settings.ftol if to_the_end else max(settings.ftol, _ROUND_FTOL)
        solved = solve(block, max_nfev=min(steps, settings.max_nfev), ftol=ftol)
        medians.append(float(np.median(solved.error_px)))
        settled = len(medians) > 2 and abs(medians[-1] - medians[-2]) <= _CONVERGED * medians[-2]
        if settled and not to_the_end:
            block = solved.block
            del solved
            solved = solve(block, max_nfev=settings.max_nfev, ftol=settings.ftol)
            medians[-1] = float(np.median(solved.error_px))
        block = solved.block
        _log.info("round %d, median %.2f px", len(medians), medians[-1])
        converged = settled and solved.solution.converged
        if converged or last:
            break
        mark_used = agreeing_marks(block, control)
        found, limit_px = judge(block, tracks, solved.error_px, limit_px, settings)
        if len(medians) > 1:  # what the first round's held intrinsics leave is no edge's fault
            edge_px = edge_medians_px(matches, found, block, tracks, len(view_graph.pairs))
            worst, warnings = edges_to_prune(view_graph, edge_px, settings.edge_median_limit, photos)
            notes = warnings
            if worst:
                gone[list(worst)] = True
                pruned += worst.values()
                # what completed the tracks is no match, so it would be gone with the edges: they are completed anew
                tracks, _ = without_edges(given, match_rows(view_graph, given), gone)
                found = triangulate_tracks(block, tracks, settings.min_angle_rad, limit_px, by_redundancy=True)
                tracks = _completed(tracks, apply_points(block, tracks, found), photos, settings, features)
                matches = match_rows(view_graph, tracks)
                matches = matches.select(~gone[matches.edge])
                found = triangulate_tracks(block, tracks, settings.min_angle_rad, limit_px, by_redundancy=True)
        block = apply_points(block, tracks, found)
        del solved  # the next solve has its memory
        judged = found.is_point[found.of_track] | (used_in_track(found) < 2)
        num_judged = int(judged.sum())
        std_px = estimate_std(found, limit_px, block)
        del found, judged
        weak = np.bincount(block.observation_image, minlength=block.num_images) < _LEAST_OBSERVATIONS
        if weak.any():
            lost += [_lost(photos[i].name) for i in block.image_index[weak]]
            block = without_images(block, weak)
            rounds = dataclasses.replace(rounds, anchor=without_images(rounds.anchor, weak))
            shape, compiled = _compiled(rounds, block, tracks, stop)
        if block.num_images < 2 or not block.num_points:
            raise JaxbaError(
                f"No point is left after round {len(medians)} with a median error of {medians[-1]:.1f} px: the start "
                "values are wrong. Check the focal length (--metadata.focal) and that all photos are of one flight."
            )
    control = dataclasses.replace(control, mark_std_px=mark_std(block, control, mark_used))
    mark_used = agreeing_marks(block, control)
    rounds = dataclasses.replace(rounds, control=control)
    max_memory = rounds.tiling.max_memory if shape is None else None

    def stand(block: Block, standing: Standing) -> Solved:
        solve = functools.partial(rounds.solve, free=every, mark_used=mark_used, shape=shape, number=len(medians))
        return solve(block, std_px, max_nfev=settings.max_nfev, ftol=settings.ftol, standing=standing)

    solved, on_control = onto_control(solved, std_px, reference, control, max_memory, stand)
    standing = None if on_control is None else on_control.standing

    def stand_on_bars(block: Block, use: Bool[np.ndarray, " bars"], factor: float) -> Solved:
        scaled = dataclasses.replace(rounds, anchor=transformed(rounds.anchor, scaling(factor)))
        solve = functools.partial(scaled.solve, free=every, mark_used=mark_used, shape=shape, number=len(medians))
        stops: dict[str, Any] = {"max_nfev": settings.max_nfev, "ftol": settings.ftol}
        return solve(block, std_px, standing=standing, bars=(bars, use), **stops)

    solved, bar_fit = onto_bars(solved, bars, std_px, control, max_memory, stand_on_bars)
    block, medians[-1] = solved.block, float(np.median(solved.error_px))
    return Adjusted(
        block=dataclasses.replace(block, unregistered=(*block.unregistered, *lost)),
        error_px=solved.error_px,
        problem=solved.problem,
        loss=solved.loss,
        solution=solved.solution,
        std_px=std_px,
        position_scale=solved.position_scale,
        num_judged=max(num_judged, block.num_observations),
        limit_px=np.nan if limit_px is None else limit_px,
        medians_px=tuple(medians),
        converged=converged and solved.solution.converged,
        pruned=tuple(pruned),
        lost=tuple(lost),
        notes=tuple(notes),
        mark_used=mark_used,
        mark_std_px=control.mark_std_px,
        common_m=solved.common_m,
        control=solved.control,
        on_control=on_control,
        bars=bar_fit,
        max_memory=max_memory,
        shape=shape,
        compiled=compiled,
    )


def _compiled(
    rounds: Rounds, block: Block, tracks: Tracks, stop: threading.Event | None
) -> tuple[PlanShape | None, Future[None] | None]:
    """Return the shape of all rounds, None in tiles, and what ends when statistics are compiled, where asked for."""
    whole = rounds.whole(block, tracks)
    if whole is None:
        return None, None
    shape = make_plan(whole, spare=_SPARE).shape
    if stop is None:
        return shape, None
    pool = ThreadPoolExecutor(1, "compile")
    compiled = pool.submit(statistics_compiler(whole, shape, loss=rounds.loss(1.0), independent="tracks", stop=stop))
    pool.shutdown(wait=False)
    return shape, compiled


def _completed(
    tracks: Tracks, block: Block, photos: Sequence[Photo], settings: Settings, features: Mapping[int, Features] | None
) -> Tracks:
    """Return the tracks completed from the block's points, or as they are where that is not wanted."""
    if features is None or not settings.complete_radius or not block.num_points:
        return tracks
    return complete_tracks(block, tracks, features, tuple(photos), radius_px=settings.complete_radius)


def _lost(name: str) -> LeftOut:
    return LeftOut(
        name=name,
        reason=f"fewer than {_LEAST_OBSERVATIONS} of its features fit the adjusted block; its matches may be wrong, or "
        "lie on something that moves",
    )
