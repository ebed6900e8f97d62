"""Control points beside a block's own points: intersected from their marks, wrong marks told, put into the problem.

A control point's marks are observations with a sigma of their own, whatever that of the tie points is, and the median
and MAD of the tie points' errors reject none of them. Its surveyed coordinates are a prior with Huber's loss: what a
test has not found pulls no harder than one that is off by `CONTROL_LOSS` sigmas. Check points are intersected from
their marks only. `Standing` says which coordinates hold the block: none at first (see `_onto_control.py`).

A mark is wrong where the others of its point agree without it and miss it by more than `_WRONG` sigmas, and where no
other mark can be blamed; two rays cannot tell which of them is wrong. Where nobody states the sigma of marks, their
scatter about the points that they place tells it (`mark_std`).
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxba.geometry import Huber
from jaxba.scene import Block, CommonOffset, Control, Reference
from jaxba.sfm._measured import common_std
from jaxba.sfm._rays import Rays, make_rays

CONTROL_LOSS = Huber(3.0)
LEAST_TO_PLACE = 3
"""Control points that place a block."""
_WRONG = 5.0  # sigmas of a mark
_MARK_STD_PX = 0.2, 3.0  # that marks are believed to have at least, and at most
_ASSUMED = 4  # degrees of freedom that the sigma counts for that marks are taken to have before they tell
_UNKNOWN_M = 1e4  # sigma of what positions have in common, where control tells it


@dataclass(frozen=True, kw_only=True, eq=False)
class ControlPart:
    """Control points that a block's images show twice or more, ready to stand behind its own points in a problem.

    - `rows`: of the points in `Control`. `start_m`: start values. `xyz_m`: as surveyed. `std_m`: sigmas that hold them,
      infinite where a coordinate does not.
    - `observation_image`: row in the block's `image_index`. `observation_point`: row here.
    """

    rows: Int[np.ndarray, " points"]
    start_m: Float[np.ndarray, "points 3"]
    xyz_m: Float[np.ndarray, "points 3"]
    std_m: Float[np.ndarray, "points 3"]
    observation_image: Int[np.ndarray, " observations"]
    observation_point: Int[np.ndarray, " observations"]
    observation_xy_px: Float[np.ndarray, "observations 2"]
    std_px: float

    @property
    def determined(self) -> Bool[np.ndarray, "3"]:
        """Which axes the points fix by themselves."""
        return np.isfinite(self.std_m).sum(axis=0) >= LEAST_TO_PLACE


@dataclass(frozen=True, eq=False)
class Standing:
    """What control and positions may say in a solve.

    - `std_m`: of every point of `Control`, infinite where a coordinate does not hold the block.
    - `common`: of the positions; None where there are none, or no control point takes part.
    """

    std_m: Float[np.ndarray, "points 3"]
    common: CommonOffset | None


@dataclass(frozen=True, kw_only=True, eq=False)
class Intersected:
    """Points from their marks and a block's poses.

    - `point_m`: NaN where fewer than two marks, or rays without an angle, fix none.
    - `variance_m2`: poses taken as known.
    - `num_marks`: used. `error_px`: of every mark, used or not; NaN where there is no point or the image has no pose.
    """

    point_m: Float[np.ndarray, "points 3"]
    variance_m2: Float[np.ndarray, "points 3"]
    num_marks: Int[np.ndarray, " points"]
    error_px: Float[np.ndarray, " marks"]


def image_rows(block: Block, control: Control) -> Int[np.ndarray, " marks"]:
    """Return the row of each mark's image in the block; -1 where the image has no pose."""
    size = max(block.image_index.max(initial=-1), control.mark_image.max(initial=-1)) + 1
    row_of_image = np.full(size, -1, np.int64)
    row_of_image[block.image_index] = np.arange(block.num_images)
    return row_of_image[control.mark_image]


def intersect(block: Block, control: Control, use: Bool[np.ndarray, " marks"]) -> Intersected:
    """Return all points, intersected from the marks used."""
    point = np.full((control.num_points, 3), np.nan)
    variance = np.full((control.num_points, 3), np.nan)
    error = np.full(len(control.mark_point), np.nan)
    row = image_rows(block, control)
    known = np.flatnonzero(row >= 0)
    rays = make_rays(block, row[known], control.mark_xy_px[known])
    count = np.bincount(control.mark_point[known][use[known]], minlength=control.num_points)
    for k in range(control.num_points):
        mine = np.flatnonzero(control.mark_point[known] == k)
        used = mine[use[known[mine]]]
        if len(used) < 2:
            continue
        found, covariance = _point(rays.take(used))
        if found is None:
            continue
        point[k], variance[k] = found, control.mark_std_px**2 * np.diagonal(covariance)
        error[known[mine]] = rays.take(mine).errors_px(np.repeat(found[:, None], len(mine), axis=1))[0]
    return Intersected(point_m=point, variance_m2=variance, num_marks=count, error_px=error)


def _point(rays: Rays) -> tuple[Float[np.ndarray, "3"] | None, Float[np.ndarray, "3 3"]]:
    """Return the point with the least sum of squared errors, and its covariance for a sigma of one pixel."""
    weight = np.ones(rays.center_m.shape[1])
    found, normal = np.zeros(3), np.eye(3)
    for _ in range(4):
        by_point = rays.by_point * weight
        normal = np.einsum("cin,cjn->ij", by_point, by_point)
        right = np.einsum("cin,cjn,jn->i", by_point, by_point, rays.center_m)
        if not np.isfinite(normal).all() or np.linalg.cond(normal) > 1e12:
            return None, normal
        found = np.linalg.solve(normal, right)
        distance = np.einsum("kn,kn->n", rays.direction, found[:, None] - rays.center_m)
        if not (distance > 0).all():
            return None, normal
        weight = 1 / distance
    return found, np.linalg.inv(normal)


def agreeing_marks(block: Block, control: Control) -> Bool[np.ndarray, " marks"]:
    """Return which marks agree with the others of their point; all of a point where it cannot be told which do not."""
    use = image_rows(block, control) >= 0
    limit = _WRONG * control.mark_std_px
    for _ in range(2):  # wrong ones of a point
        error = intersect(block, control, use).error_px
        doubtful = np.unique(control.mark_point[use & ~(error <= limit)])
        for k in doubtful:
            mine = np.flatnonzero(use & (control.mark_point == k))
            if len(mine) < 3:
                continue
            blamed = []
            for mark in mine:
                rest = use.copy()
                rest[mark] = False
                without = intersect(block, control, rest).error_px
                if (without[mine[mine != mark]] <= limit).all() and without[mark] > limit:
                    blamed.append(mark)
            if len(blamed) == 1:
                use[blamed[0]] = False
    return use


def control_part(
    block: Block, control: Control, use: Bool[np.ndarray, " marks"], std_m: Float[np.ndarray, "points 3"] | None = None
) -> ControlPart | None:
    """Return the control points that stand in an adjustment; None where there are none, or the block has no place.

    `std_m`: sigmas that hold them, of every point of `control`; None as surveyed.
    """
    std_m = control.std_m if std_m is None else std_m
    if not block.is_georeferenced or control.method != "adjust":
        return None
    row = image_rows(block, control)
    use = use & (row >= 0) & ~control.is_check[control.mark_point]
    found = intersect(block, control, use).point_m
    rows = np.flatnonzero(np.isfinite(found).all(axis=1) & ~control.is_check)
    if not len(rows):
        return None
    number = np.full(control.num_points, -1)
    number[rows] = np.arange(len(rows))
    keep = use & (number[control.mark_point] >= 0)
    return ControlPart(
        rows=rows, start_m=found[rows], xyz_m=control.xyz_m[rows], std_m=std_m[rows], observation_image=row[keep],
        observation_point=number[control.mark_point[keep]], observation_xy_px=control.mark_xy_px[keep],
        std_px=control.mark_std_px,
    )  # fmt: skip


def mark_std(block: Block, control: Control, use: Bool[np.ndarray, " marks"]) -> float:
    """Return the sigma of a mark, px: as stated, or from how marks scatter about the points that they place.

    The sum of squares of a point's n marks has 2n - 3 degrees of freedom. The sigma that is assumed counts as much as
    `_ASSUMED` degrees; the result stays within `_MARK_STD_PX`.
    """
    if not control.mark_std_is_assumed:
        return control.mark_std_px
    found = intersect(block, control, use)
    known = use & np.isfinite(found.error_px)
    views = np.bincount(control.mark_point[known], minlength=control.num_points)
    freedom = np.sum(np.maximum(2 * views[views >= 2] - 3, 0))
    total = np.sum(found.error_px[known] ** 2) + _ASSUMED * control.mark_std_px**2
    return float(np.clip(np.sqrt(total / (freedom + _ASSUMED)), *_MARK_STD_PX))


def before_control(block: Block, reference: Reference, control: Control) -> Standing:
    """Return how a block stands that control does not hold: its points are intersected, and nothing more."""
    std_m = common_std(block, reference) if _takes_part(control) else None
    common = None if std_m is None else CommonOffset(np.zeros(3), _held(std_m))
    return Standing(np.full_like(control.std_m, np.inf), common)


def _takes_part(control: Control) -> bool:
    return control.method == "adjust" and bool((~control.is_check).any())


def after_tests(
    control: Control,
    wrong: Bool[np.ndarray, "points 3"],
    scale: tuple[float, float],
    common_std_m: Float[np.ndarray, "3"] | None,
    shift_m: Float[np.ndarray, "3"],
    is_shifted: Bool[np.ndarray, "3"],
) -> Standing:
    """Return how a block stands on what tests have left of control."""
    std_m = np.where(wrong | control.is_check[:, None], np.inf, control.std_m * np.array(scale)[[0, 0, 1]])
    if common_std_m is None:
        return Standing(std_m, None)
    return Standing(std_m, CommonOffset(shift_m, np.where(is_shifted, _UNKNOWN_M, _held(common_std_m))))


def _held(std_m: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3"]:
    return np.where(std_m > 0, std_m, 1e-3)  # where no position is measured along an axis it moves nothing
