"""Control points beside a block's own points: intersected from their marks, wrong marks told, put into the problem.

A control point's marks are observations with a sigma of their own, whatever that of the tie points is, and the median
and MAD of the tie points' errors reject none of them. Its surveyed coordinates are a prior with Huber's loss: a wrong
point pulls no harder than one that is off by `CONTROL_LOSS` sigmas. Check points are intersected from their marks only.

Where most points contradict the block by far more than their sigmas, the survey is worse than it claims: their sigmas
are multiplied by `control_scale`, as those of GNSS positions are. It is asked after a solve with the sigmas as stated,
so that a block that is merely bent has been bent right before.

A mark is wrong where the others of its point agree without it and miss it by more than `_WRONG` sigmas, and where no
other mark can be blamed; two rays cannot tell which of them is wrong.
"""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxba.geometry import Huber
from jaxba.scene import Block, Control, Reference
from jaxba.sfm._rays import Rays, make_rays

CONTROL_LOSS = Huber(3.0)
LEAST_TO_PLACE = 3
"""Control points that place a block, and that tell an offset of GNSS positions from it."""
PLAIN_M = 1.0
"""Sigma of a position beyond which it is that of a single receiver."""
_WRONG = 5.0  # sigmas of a mark
_CONTRADICTS = 3.0  # sigmas: robust, of all control points; of what positions are off in common


@dataclass(frozen=True, kw_only=True, eq=False)
class ControlPart:
    """Control points that a block's images show twice or more, ready to stand behind its own points in a problem.

    - `rows`: of the points in `Control`. `start_m`: start values. `xyz_m`, `std_m`: as surveyed.
    - `scale`: that `std_m` were multiplied by, horizontal and vertical.
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
    scale: Float[np.ndarray, "2"]

    @property
    def determined(self) -> Bool[np.ndarray, "3"]:
        """Which axes the points fix by themselves."""
        return np.isfinite(self.std_m).sum(axis=0) >= LEAST_TO_PLACE


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
    block: Block, control: Control, use: Bool[np.ndarray, " marks"], scale: Float[np.ndarray, "2"] | None = None
) -> ControlPart | None:
    """Return the control points that stand in an adjustment; None where there are none, or the block has no place.

    `scale`: on their sigmas, horizontal and vertical.
    """
    scale = np.ones(2) if scale is None else scale
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
        rows=rows, start_m=found[rows], xyz_m=control.xyz_m[rows], std_m=control.std_m[rows] * scale[[0, 0, 1]],
        scale=scale, observation_image=row[keep],
        observation_point=number[control.mark_point[keep]], observation_xy_px=control.mark_xy_px[keep],
        std_px=control.mark_std_px,
    )  # fmt: skip


def control_scale(
    block: Block, control: Control, use: Bool[np.ndarray, " marks"], *, is_free: bool
) -> Float[np.ndarray, "2"]:
    """Return what the sigmas of control points are multiplied by, horizontal and vertical, 1 but for contradictions.

    The median of the differences between points intersected from their marks and surveyed ones, over 0.6745 of their
    sigmas, where it is over `_CONTRADICTS`. `is_free`: nothing but control places the block, which takes up seven of
    the differences.
    """
    found = intersect(block, control, use)
    mine = ~control.is_check & np.isfinite(found.point_m).all(axis=1)
    known = mine[:, None] & np.isfinite(control.std_m)
    with np.errstate(invalid="ignore"):
        over = np.abs(found.point_m - control.xyz_m) / np.sqrt(control.std_m**2 + found.variance_m2)
    scale = np.ones(2)
    for k, (axes, taken) in enumerate(((slice(0, 2), 4), (slice(2, 3), 3))):
        values = over[:, axes][known[:, axes]]
        left = len(values) - (taken if is_free else 0)
        if left < 2:
            continue
        ratio = float(np.median(values)) / 0.6745 * np.sqrt(len(values) / left)
        scale[k] = ratio if ratio > _CONTRADICTS else 1.0
    return scale


def gnss_offset(
    block: Block, reference: Reference, control: ControlPart | None, *, is_later: bool
) -> Float[np.ndarray, "3"]:
    """Return what measured positions are to be moved by, an axis: zero where control does not fix the block.

    The median of block minus measured position. What all positions have in common (another datum, the antenna's offset)
    contradicts control by itself, and control is right; their scatter is what they tell. Positions of a single receiver
    (a sigma over `PLAIN_M`) always have such an offset. Better ones hold the height and with it the focal length, so
    they are moved only where they contradict a block that was solved with them, by three sigmas: `is_later`. Over flat
    ground, seen straight down, an offset of their heights looks like another focal length and does not show.
    """
    index = block.image_index[reference.is_used[block.image_index]]
    if control is None or not len(index):
        return np.zeros(3)
    off_m, std_m = np.nan_to_num(median_offset(block, reference)), np.median(reference.std_m[index], axis=0)
    free = (std_m > PLAIN_M) | (is_later & (np.abs(off_m) > _CONTRADICTS * std_m))
    return np.where(control.determined & free, off_m, 0.0)


def median_offset(block: Block, reference: Reference) -> Float[np.ndarray, "3"]:
    """Return the median of block minus measured position, an axis; NaN where none is measured."""
    index = block.image_index
    known = reference.is_used[index, None] & np.isfinite(reference.std_m[index]) & np.isfinite(reference.xyz_m[index])
    off = block.centers_m - reference.xyz_m[index]
    return np.array([np.median(column[k]) if k.any() else np.nan for column, k in zip(off.T, known.T, strict=True)])


def with_offset(reference: Reference, offset_m: Float[np.ndarray, "3"]) -> Reference:
    """Return the reference with all measured positions moved."""
    return replace(reference, xyz_m=reference.xyz_m + offset_m)
