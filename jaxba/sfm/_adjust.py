"""The adjustment in rounds: solve, judge every observation anew, prune edges, triangulate anew, solve again.

How observations are judged stands in `_judge.py`, how edges are in `_edges.py`.

Tracks are completed before the first round (see `_complete.py`), so that all rounds have one shape: a radius of 2 to
6 px finds as much at the start values as at adjusted ones (points seen three times or more: +17% and +37% in two
blocks, 1% more from adjusted poses).

The first round frees the focal length and k1 alone and takes a few steps; all rounds share compiled code. The sigma of
an observation is estimated from the errors themselves, so that pixels and GNSS are weighed against each other rightly.
Convergence is judged by the median of the errors: it changes by less than 1%.
"""

import dataclasses
import logging
from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Bool, Float

from jaxba._errors import JaxbaError
from jaxba.ba import Problem, Solution, make_plan, reprojection_errors, solve
from jaxba.ba._plan import Shape
from jaxba.geometry import CAMERAS, LOSSES, AbstractLoss, Linear
from jaxba.scene import Block, Control, Features, Left, Photo, Reference, Tracks, ViewGraph
from jaxba.sfm._complete import complete_tracks
from jaxba.sfm._control import (
    LEAST_TO_PLACE,
    PLAIN_M,
    ControlPart,
    agreeing_marks,
    control_part,
    control_scale,
    gnss_offset,
    with_offset,
)
from jaxba.sfm._edges import edge_medians_px, match_rows, without_edges
from jaxba.sfm._judge import estimate_std, judge, used_in_track
from jaxba.sfm._points import apply_points, track_rows, triangulate_tracks
from jaxba.sfm._problem import free_parameters, to_problem, used_positions, with_solution
from jaxba.sfm._settings import Settings

_log = logging.getLogger(__name__)

_SPARE = 0.03  # room for tracks that pruning cuts in two
_START_ERROR = 0.005  # of the longer side: what start values are good to
_FIRST_STEPS, _ROUND_STEPS = 12, 40  # before the median has settled
_CONVERGED = 0.01
_LEAST_POSITIONS = 6
_MAX_PRUNED = 0.3  # of the edges: more of them over the limit speak of the block, not of the edges
_FAR = 10.0  # times the limit of an edge: no bent block explains it
_LEAST_OBSERVATIONS = 3  # of an image: fewer do not fix a pose


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class Adjusted:
    """Result of the rounds.

    - `block`: adjusted; its observations are those of the last solve. `error_px`: of each.
    - `problem`, `loss`: of the last solve, at its solution. `solution`: of the last solve.
    - `std_px`: sigma of an observation's coordinates. `position_scale`: factor on the sigmas of positions.
    - `num_judged`: observations that were judged by their error; those not in the block were rejected.
    - `medians_px`: of each round's observations after its solve. `converged`: the median no longer changed.
    - `control`: the control points of the last solve, their start values at its solution. `mark_used`: of all marks,
      those that agree with the others of their point. `gnss_offset_m`: added to measured positions, an axis.
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
    medians_px: tuple[float, ...]
    converged: bool
    pruned: tuple[Left, ...]
    lost: tuple[Left, ...]
    notes: tuple[str, ...]
    mark_used: Bool[np.ndarray, " marks"]
    gnss_offset_m: Float[np.ndarray, "3"]
    control: ControlPart | None = None

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
) -> Adjusted:
    """Return the adjusted block; `block` holds the start values, with points or without.

    - `features`: of every image, by index, to complete tracks from; without them tracks stay as they are.
    - `control`: surveyed points; its check points take no part.

    Raises `JaxbaError` where the block has fewer than two images, or no point of it is left.
    """
    if block.num_images < 2:
        raise JaxbaError(f"The block has {block.num_images} images with start values; an adjustment needs two or more.")
    control = Control.nothing() if control is None else control
    rounds = _Rounds(anchor=block, reference=reference, photos=photos, settings=settings, control=control)
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
    limit_px, shape = None, rounds.shape(block, tracks)
    mark_used = np.ones(len(control.mark_point), bool)
    small = free_parameters(block.camera_model, num_images=0)
    every = free_parameters(block.camera_model, num_images=block.num_images)
    while True:
        last = len(medians) + 1 >= settings.max_rounds
        free = every if medians or last else small
        steps = settings.max_nfev if last or settled else _ROUND_STEPS if medians else _FIRST_STEPS
        solved = rounds.solve(
            block, std_px, free, mark_used, shape, max_nfev=min(steps, settings.max_nfev), is_later=bool(medians)
        )
        block = solved.block
        medians.append(float(np.median(solved.error_px)))
        _log.info("round %d, median %.2f px", len(medians), medians[-1])
        settled = len(medians) > 2 and abs(medians[-1] - medians[-2]) <= _CONVERGED * medians[-2]
        converged = settled and solved.solution.converged
        if converged or last:
            break
        mark_used = agreeing_marks(block, control)
        found, limit_px = judge(block, tracks, solved.error_px, limit_px, settings)
        if len(medians) > 1:  # what the first round's held intrinsics leave is no edge's fault
            edge_px = edge_medians_px(matches, found, len(view_graph.pairs), tracks.num_observations)
            worst, warnings = _edges_to_prune(view_graph, edge_px, settings.edge_median_limit, photos)
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
        judged = found.is_point[found.of_track] | (used_in_track(found) < 2)
        num_judged = int(judged.sum())
        std_px = estimate_std(found, limit_px, block)
        weak = np.bincount(block.observation_image, minlength=block.num_images) < _LEAST_OBSERVATIONS
        if weak.any():
            lost += [_lost(photos[i].name) for i in block.image_index[weak]]
            block = without_images(block, weak)
            rounds = dataclasses.replace(rounds, anchor=without_images(rounds.anchor, weak))
            shape = rounds.shape(block, tracks)
        if block.num_images < 2 or not block.num_points:
            raise JaxbaError(
                f"No point is left after round {len(medians)} with a median error of {medians[-1]:.1f} px: the start "
                "values are wrong. Check the focal length (--metadata.focal) and that all photos are of one flight."
            )
    return Adjusted(
        block=dataclasses.replace(block, unregistered=(*block.unregistered, *lost)),
        error_px=solved.error_px,
        problem=solved.problem,
        loss=solved.loss,
        solution=solved.solution,
        std_px=std_px,
        position_scale=solved.position_scale,
        num_judged=max(num_judged, block.num_observations),
        medians_px=tuple(medians),
        converged=converged,
        pruned=tuple(pruned),
        lost=tuple(lost),
        notes=tuple(notes),
        mark_used=mark_used,
        gnss_offset_m=solved.gnss_offset_m,
        control=solved.control,
    )


def _completed(
    tracks: Tracks, block: Block, photos: Sequence[Photo], settings: Settings, features: Mapping[int, Features] | None
) -> Tracks:
    """Return the tracks completed from the block's points, or as they are where that is not wanted."""
    if features is None or not settings.complete_radius or not block.num_points:
        return tracks
    return complete_tracks(block, tracks, features, tuple(photos), radius_px=settings.complete_radius)


@dataclasses.dataclass(frozen=True)
class _Solved:
    block: Block
    error_px: Float[np.ndarray, " observations"]
    problem: Problem
    loss: AbstractLoss
    solution: Solution
    position_scale: Float[np.ndarray, "3"]
    gnss_offset_m: Float[np.ndarray, "3"]
    control: ControlPart | None


@dataclasses.dataclass(frozen=True)
class _Rounds:
    """What all rounds share; `anchor` is the block at the start."""

    anchor: Block
    reference: Reference
    photos: Sequence[Photo]
    settings: Settings
    control: Control

    def solve(
        self,
        block: Block,
        std_px: float,
        free: Sequence[str],
        mark_used: Bool[np.ndarray, " marks"],
        shape: Shape | None,
        *,
        max_nfev: int,
        is_later: bool,
    ) -> _Solved:
        """Solve a block; `free` are the camera's parameters that may change, `shape` has the least sizes.

        - `mark_used`: of all marks of control. `is_later`: than the first round.
        """
        settings = self.settings
        model = LOSSES[settings.loss]
        loss = Linear() if model is Linear else model(f_scale=settings.f_scale / std_px)  # type: ignore[call-arg]
        scale = position_scale(block, self.reference)
        scale_of_control = None
        if is_later and self.control.num_points:
            is_free = int(used_positions(block, self.reference).sum()) < LEAST_TO_PLACE
            scale_of_control = control_scale(block, self.control, mark_used, is_free=is_free)
        control = control_part(block, self.control, mark_used, scale_of_control)
        offset_m = gnss_offset(block, self.reference, control, is_later=is_later)
        reference = with_offset(self.reference, offset_m)
        held = [name for name in CAMERAS[block.camera_model].parameter_names() if name not in free]

        def problem_of(block: Block, control: ControlPart | None) -> Problem:
            return to_problem(
                block,
                reference,
                self.photos,
                anchor=self.anchor,
                std_px=std_px,
                position_scale=scale,
                held=held,
                control=control,
            )

        problem = problem_of(block, control)
        plan = make_plan(problem, like=shape)
        solution = solve(
            problem,
            loss=loss,
            plan=plan,
            max_nfev=max_nfev,
            ftol=settings.ftol,
            xtol=settings.xtol,
        )
        num_points, num_own = block.num_points, block.num_observations
        block = with_solution(block, solution)
        if control is not None:
            control = dataclasses.replace(control, start_m=np.asarray(solution.points)[num_points:])
        problem = solution.apply(problem)
        error_px = reprojection_errors(problem)
        fits = np.isfinite(error_px)
        if solution.report is not None:
            fits &= ~solution.report.dropped.observations
        if not fits[:num_own].all():
            block = _with_observations(block, fits[:num_own])
            problem = problem_of(block, control)
            error_px = reprojection_errors(problem)
        error_px = error_px[: block.num_observations]
        return _Solved(block, error_px, problem, loss, solution, scale, offset_m, control)

    def shape(self, block: Block, tracks: Tracks) -> Shape:
        """Return the shape of the block with every observation that may ever join it: all rounds share it."""
        row, image_row, of_track, index = track_rows(block, tracks)
        full = dataclasses.replace(
            block,
            points_m=np.zeros((len(index), 3)),
            track_index=index,
            rgb=tracks.rgb[index],
            observation_image=image_row,
            observation_point=of_track,
            observation_xy_px=tracks.xy_px[row],
        )
        control = control_part(block, self.control, np.ones(len(self.control.mark_point), bool))
        problem = to_problem(full, self.reference, self.photos, anchor=self.anchor, control=control)
        return make_plan(problem, spare=_SPARE).shape


def position_scale(block: Block, reference: Reference) -> Float[np.ndarray, "3"]:
    """Return what the sigmas of positions are multiplied by, an axis, from how the positions scatter about the block.

    The median of |residual| over 0.6745 sigma (its value for a normal distribution), and not below 1: positions may be
    worse than they claim. Sigmas of more than `PLAIN_M` are those of a single receiver, mostly an offset that all
    positions of a flight have in common; their scatter alone tells their weight against each other, down to a tenth.
    Under six positions it is 1.
    """
    used = used_positions(block, reference)
    index = block.image_index[used]
    scale = np.ones(3)
    for axis in range(3):
        std = reference.std_m[index, axis]
        known = np.isfinite(std)
        if known.sum() < _LEAST_POSITIONS:
            continue
        residual = block.centers_m[used, axis] - reference.xyz_m[index, axis]
        ratio = np.median(np.abs(residual - np.median(residual))[known] / std[known]) / 0.6745
        ratio *= np.sqrt(known.sum() / (known.sum() - 7 / 3))  # a similarity has fitted the block to them
        scale[axis] = max(ratio, 0.1 if np.median(std[known]) > PLAIN_M else 1.0)
    return scale


def without_images(block: Block, gone: Bool[np.ndarray, " images"]) -> Block:
    """Return the block without some images, without their observations, and without points left with fewer than two."""
    keep = ~gone
    number = np.cumsum(keep) - 1
    seen = keep[block.observation_image]
    block = _with_observations(block, seen)
    return dataclasses.replace(
        block,
        image_index=block.image_index[keep],
        quaternion=block.quaternion[keep],
        translation_m=block.translation_m[keep],
        camera_index=block.camera_index[keep],
        observation_image=number[block.observation_image],
    )


def _edges_to_prune(
    view_graph: ViewGraph, median_px: Float[np.ndarray, " edges"], limit_px: float, photos: Sequence[Photo]
) -> tuple[dict[int, Left], list[str]]:
    """Return the edges over the limit with the reason, or none of them and a warning where they are too many.

    A wrong edge pulls its two images off, and right edges of theirs go over the limit with it: of those near the limit
    only the worst one at each image is pruned in a round.
    """
    over = np.flatnonzero(median_px > limit_px)
    judged = int(np.isfinite(median_px).sum())
    if len(over) > max(_MAX_PRUNED * judged, 1):
        return {}, [
            f"{len(over)} of {judged} edges are off by more than {limit_px:g} px in their median: the "
            "block does not fit together, so none was left out. Check the focal length against the sensor's "
            "specification, and that photos of different cameras or zooms are not mixed."
        ]
    pruned, touched = {}, set[int]()
    for k in over[np.argsort(-median_px[over], kind="stable")]:
        images = {int(i) for i in view_graph.pairs[k]}
        if touched & images and median_px[k] < _FAR * limit_px:
            continue
        touched |= images
        first, second = (photos[i].name for i in view_graph.pairs[k])
        pruned[int(k)] = Left(
            name=f"{first}, {second}",
            reason=f"their {view_graph.num_inliers[k]} matches are off by {_px(float(median_px[k]))} in the median "
            f"(limit {limit_px:g} px) and were left out; look at both photos for repeated patterns or movement",
        )
    return pruned, []


def _px(error: float) -> str:
    return f"{error:.1f} px" if error < 100 else "over 100 px"


def _lost(name: str) -> Left:
    return Left(
        name=name,
        reason=f"fewer than {_LEAST_OBSERVATIONS} of its features fit the adjusted block; its matches may be wrong, or "
        "lie on something that moves",
    )


def _with_observations(block: Block, keep: Bool[np.ndarray, " observations"]) -> Block:
    """Return the block with some of its observations, and the points that two or more of these see."""
    keep = keep & (np.bincount(block.observation_point[keep], minlength=block.num_points)[block.observation_point] >= 2)
    seen = np.bincount(block.observation_point[keep], minlength=block.num_points) > 0
    number = np.cumsum(seen) - 1
    return dataclasses.replace(
        block,
        points_m=block.points_m[seen],
        track_index=block.track_index[seen],
        rgb=block.rgb[seen],
        observation_image=block.observation_image[keep],
        observation_point=number[block.observation_point[keep]],
        observation_xy_px=block.observation_xy_px[keep],
    )
