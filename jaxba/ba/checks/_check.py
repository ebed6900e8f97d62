"""Check: the problem that can be solved, and what of the given one was left out for it.

What contradicts itself is an error (`_validate.py`). What an adjustment can do without is left out, counted and named:

- observations of points behind their camera, or without a pixel, at the start values;
- points seen fewer than twice: nothing fixes their depth. Control points with finite sigmas and fixed points stay;
- images whose pose is not determined by what they see and their priors (fewer than three points, or all on one line):
  held fixed with their priors without effect, their observations left out, and what is seen once after that as well;
- images that have no observation left, and cameras of no image that has one: held fixed, their priors without effect;
- intrinsics of a camera that what it sees and its priors leave open: held fixed.

Cost: 500k observations take 0.2 s; more where images are left out, since the first three are then looked at again.
"""

import dataclasses
import enum
from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from jaxba._errors import JaxbaError
from jaxba.ba._problem import AbstractPrior, Free, Observations, Problem
from jaxba.ba._projection import points_in_cam, project
from jaxba.ba.checks._local_rank import pose_ranks, undetermined_intrinsics
from jaxba.ba.checks._validate import validate

_GRAZING = 1e-6  # depth over distance: above it the formula of every model is finite, and need not be computed


class Reason(enum.IntEnum):
    """Why an observation was left out."""

    KEPT = 0
    BEHIND = 1
    NO_PIXEL = 2
    SEEN_ONCE = 3
    WEAK_IMAGE = 4


@dataclasses.dataclass(frozen=True)
class Dropped:
    """What was left out of a problem; indices are those of the problem as it was given.

    - `reason`: a `Reason` for each observation.
    - `points`: free points seen fewer than twice, now held fixed. `times_measured`: how often each was measured.
    - `images`, `cameras`: free ones without an observation that counts, now held fixed.
    - `ranks`: of each of these images, how many of the six directions of its pose its own observations and priors
      determined; 0 without any.
    - `intrinsics`: those of cameras with observations that nothing determines, now held fixed.
    """

    reason: UInt8[np.ndarray, " observations"]
    points: Int[np.ndarray, " dropped_points"]
    times_measured: Int[np.ndarray, " dropped_points"]
    images: Int[np.ndarray, " dropped_images"]
    cameras: Int[np.ndarray, " dropped_cameras"]
    ranks: Int[np.ndarray, " dropped_images"]
    intrinsics: Bool[np.ndarray, "cameras parameters"]
    parameter_names: tuple[str, ...]
    image_names: tuple[str, ...] = ()

    @property
    def observations(self) -> Bool[np.ndarray, " observations"]:
        """True for each observation that was left out."""
        return self.reason != Reason.KEPT

    def any(self) -> bool:
        """Whether anything was left out or held fixed."""
        held = len(self.points) or len(self.images) or len(self.cameras) or self.intrinsics.any()
        return bool(self.observations.any() or held)

    def count(self, reason: Reason) -> int:
        """Return how many observations were left out for this reason."""
        return int(np.count_nonzero(self.reason == reason))

    def summary(self) -> list[str]:
        """Return a sentence about each kind of thing that was left out; empty if nothing was."""
        lines = []
        behind, no_pixel = self.count(Reason.BEHIND), self.count(Reason.NO_PIXEL)
        if behind:
            lines.append(
                f"{_many(behind, 'observation')} of points behind the camera left out ({self._first(Reason.BEHIND)})"
            )
        if no_pixel:
            lines.append(
                f"{_many(no_pixel, 'observation')} of points without a pixel left out ({self._first(Reason.NO_PIXEL)})"
            )
        never = self.times_measured == 0
        for points, seen in (
            (self.points[self.times_measured == 1], "seen once"),
            (self.points[self.times_measured > 1], "seen fewer than twice after that"),
        ):
            if len(points):
                lines.append(f"{_many(len(points), 'point')} {seen} left out ({_first(points)})")
        if never.any():
            points = self.points[never]
            lines.append(f"{_many(len(points), 'point')} seen in no image held fixed ({_first(points)})")
        idle, weak = self.images[self.ranks == 0], self.images[self.ranks > 0]
        if len(weak):
            few = " or ".join(str(rank) for rank in np.unique(self.ranks[self.ranks > 0]))
            seen = _many(self.count(Reason.WEAK_IMAGE), "observation")
            lines.append(
                f"{_many(len(weak), 'image')} with too few points held fixed, {seen} left out "
                f"({self._first_images(weak)}): what they see and their priors determine {few} of a pose's 6 unknowns"
            )
        if len(idle):
            lines.append(f"{_many(len(idle), 'image')} without observations held fixed ({self._first_images(idle)})")
        if len(self.cameras):
            lines.append(
                f"{_many(len(self.cameras), 'camera')} without observations held fixed ({_first(self.cameras)})"
            )
        weak = np.flatnonzero(self.intrinsics.any(axis=1))
        if len(weak):
            labels = [
                f"{camera} {', '.join(np.array(self.parameter_names)[self.intrinsics[camera]])}" for camera in weak[:3]
            ]
            lines.append(
                f"{_many(len(weak), 'camera')} with intrinsics held fixed that its observations and priors do not "
                f"determine ({_first(weak, labels)})"
            )
        return lines

    def _first_images(self, images: Int[np.ndarray, " n"]) -> str:
        return _first(images, [f"{i} {self.image_names[i]}" if self.image_names else str(i) for i in images[:3]])

    def _first(self, reason: Reason) -> str:
        return _first(np.flatnonzero(self.reason == reason))


@dataclasses.dataclass(frozen=True)
class Prepared:
    """A problem that can be solved, what was left out for it, and the way back.

    - `problem`: the given one if nothing was left out. Images, points and cameras keep their indices.
    - `kept`: the index, in the problem as it was given, of each of its observations.
    """

    problem: Problem
    dropped: Dropped
    kept: Int[np.ndarray, " kept"]


def prepare(problem: Problem) -> Prepared:
    """Return the problem that can be solved, on the host, and what of the given one was left out for it.

    `solve` and `covariance` begin with it. Raises `JaxbaError` where the problem contradicts itself, or where nothing
    of it can be solved.

    >>> import jaxba
    >>> survey = jaxba.synthetic.uav_block(8)
    >>> prepared = jaxba.ba.prepare(survey.problem)
    >>> prepared.dropped.summary(), prepared.problem is survey.problem
    ([], True)
    """
    validate(problem)
    seen, free = problem.observations, problem.free
    image, point = np.asarray(seen.image_index), np.asarray(seen.point_index)
    free_poses, free_points = np.array(free.poses), np.array(free.points)
    free_intrinsics = np.array(free.intrinsics)

    point_in_cam = points_in_cam(problem)
    reason = _reason_at_start(problem, point_in_cam)
    given = np.bincount(point, minlength=problem.num_points)
    controlled, ranks = _controlled(problem), np.zeros(problem.num_images, int)
    while True:
        visible = reason == Reason.KEPT
        counts = given if visible.all() else np.bincount(point[visible], minlength=problem.num_points)
        loose = free_points & (counts < 2) & ~controlled
        reason[visible & loose[point]] = Reason.SEEN_ONCE
        kept = np.flatnonzero(reason == Reason.KEPT)
        if not len(kept):
            raise JaxbaError(_nothing_left(reason))
        seen_now = np.bincount(image[kept], minlength=problem.num_images) > 0
        found = pose_ranks(problem, kept, point_in_cam)
        weak = free_poses & seen_now & (found < 6)
        if not weak.any():
            break
        ranks[weak] = found[weak]
        reason[kept[weak[image[kept]]]] = Reason.WEAK_IMAGE

    has_observation = np.zeros(problem.num_images, bool)
    has_observation[image[kept]] = True
    has_image = np.zeros(problem.num_cameras, bool)
    has_image[np.asarray(problem.camera_index)[has_observation]] = True
    idle_images = free_poses & ~has_observation
    idle_cameras = free_intrinsics.any(axis=1) & ~has_image
    open_intrinsics = undetermined_intrinsics(problem, kept, point_in_cam)
    dropped = Dropped(
        reason=reason,
        points=np.flatnonzero(loose),
        times_measured=given[loose],
        images=np.flatnonzero(idle_images),
        cameras=np.flatnonzero(idle_cameras),
        ranks=ranks[idle_images],
        intrinsics=open_intrinsics,
        parameter_names=type(problem.cameras).parameter_names(),
        image_names=problem.image_names,
    )
    if not dropped.any():
        return Prepared(problem, dropped, kept)

    _require_bars(problem, loose)
    free_points[loose], free_poses[idle_images], free_intrinsics[idle_cameras] = False, False, False
    free_intrinsics[open_intrinsics] = False
    if not (free_points.any() or free_poses.any() or free_intrinsics.any() or problem.free_antenna.any()):
        summary = "; ".join(dropped.summary())
        raise JaxbaError(f"Nothing that is free is measured: {summary}. Free more, or measure more.")
    held = {"image_index": idle_images, "point_index": loose, "camera_index": idle_cameras}
    observations = Observations(np.asarray(seen.xy_px)[kept], np.asarray(seen.std_px)[kept], image[kept], point[kept])
    changed = dataclasses.replace(
        problem,
        observations=observations,
        free=Free(free_poses, free_points, free_intrinsics, free.lever_arm, free.position_offset),
        priors=tuple(_without_effect(prior, held) for prior in problem.priors),
    )
    return Prepared(changed, dropped, kept)


def _reason_at_start(
    problem: Problem, point: Float[np.ndarray, "3 observations"]
) -> UInt8[np.ndarray, " observations"]:
    """Leave out what the start values put behind a camera or give no pixel."""
    depth = point[2]
    reason = np.zeros(len(depth), np.uint8)
    grazing = np.flatnonzero(depth <= _GRAZING * np.sqrt(point[0] ** 2 + point[1] ** 2 + depth**2))
    if len(grazing):
        finite = np.isfinite(project(problem, point[:, grazing], grazing)).all(axis=0)
        reason[grazing[~finite]] = Reason.NO_PIXEL
        if not type(problem.cameras).sees_behind:
            reason[grazing[depth[grazing] <= 0]] = Reason.BEHIND
    return reason


def _controlled(problem: Problem) -> Bool[np.ndarray, " points"]:
    """True where a prior with finite sigmas on all axes fixes a point, however often it is seen."""
    mask = np.zeros(problem.num_points, bool)
    for prior in problem.priors:
        index = getattr(prior, "point_index", None)
        if index is not None and prior.name != "scale_bar":
            sigmas = [getattr(prior, f.name) for f in dataclasses.fields(prior) if f.name.startswith("std")]
            finite = np.isfinite(np.concatenate([np.asarray(s) for s in sigmas], axis=1)).all(axis=1)
            mask[np.asarray(index)[finite]] = True
    return mask


def _require_bars(problem: Problem, loose: Bool[np.ndarray, " points"]) -> None:
    bars = problem.prior("scale_bar")
    point = np.zeros(0, int) if bars is None else np.asarray(vars(bars)["point_index"])
    for row in np.flatnonzero(loose[point]):
        raise JaxbaError(
            f"prior scale_bar: point {point[row]}, an end of bar {row // 2}, is left with fewer than two observations "
            "in front of the camera; leave the bar out, or correct the start values."
        )


def _without_effect(prior: AbstractPrior, held: dict[str, Bool[np.ndarray, " n"]]) -> AbstractPrior:
    """Return the prior with infinite sigmas for what was held fixed: else its rows would pull at the lever arm."""
    for field, mask in held.items():
        index = getattr(prior, field, None)
        if index is None or not mask[np.asarray(index)].any():
            continue
        rows = mask[np.asarray(index)][:, None]
        sigmas = {f.name: getattr(prior, f.name) for f in dataclasses.fields(prior) if f.name.startswith("std")}
        prior = dataclasses.replace(prior, **{n: np.where(rows, np.inf, np.asarray(s)) for n, s in sigmas.items()})
    return prior


def _nothing_left(reason: UInt8[np.ndarray, " observations"]) -> str:
    behind, no_pixel, once, weak = (np.count_nonzero(reason == r) for r in list(Reason)[1:])
    return (
        f"No observation is left of {len(reason)}: {behind} are of points behind their camera, {no_pixel} have no "
        f"pixel, {once} are of points seen once, {weak} in images that see too few points. If most are behind, poses "
        "may be world_from_cam: give cam_from_world."
    )


def _many(count: int, kind: str) -> str:
    return f"{count} {kind}{'' if count == 1 else 's'}"


def _first(indices: Int[np.ndarray, " n"], labels: Sequence[str] | None = None) -> str:
    labels = [str(i) for i in indices[:3]] if labels is None else labels
    return f"{'first: ' if len(indices) > 1 else 'number '}{', '.join(labels)}{', ...' if len(indices) > 3 else ''}"
