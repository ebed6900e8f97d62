"""Control and check points in the local frame, and where photos show them."""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Int


@dataclass(frozen=True, kw_only=True, eq=False)
class Control:
    """Surveyed points, one row a point, and their marks.

    - `xyz_m`, `std_m`: local frame, metres; an infinite sigma where a coordinate was not measured, whose value then is
      only a stand-in.
    - `is_check`: the point is compared with the result and takes no part in it.
    - `mark_point`: row of the point. `mark_image`: index of the image. `mark_xy_px`: on the file's pixel grid.
    - `mark_std_px`: sigma of a mark an axis; `mark_std_is_assumed`: nobody states it, and marks may tell another.
    - `method`: how the points are used: `adjust`, `helmert`, `affine` or `none`.
    """

    names: tuple[str, ...]
    xyz_m: Float[np.ndarray, "points 3"]
    std_m: Float[np.ndarray, "points 3"]
    is_check: Bool[np.ndarray, " points"]
    mark_point: Int[np.ndarray, " marks"]
    mark_image: Int[np.ndarray, " marks"]
    mark_xy_px: Float[np.ndarray, "marks 2"]
    mark_std_px: float = 1.0
    mark_std_is_assumed: bool = False
    method: str = "adjust"

    @staticmethod
    def nothing() -> "Control":
        """Return no points."""
        return Control(
            names=(),
            xyz_m=np.zeros((0, 3)),
            std_m=np.zeros((0, 3)),
            is_check=np.zeros(0, bool),
            mark_point=np.zeros(0, np.int64),
            mark_image=np.zeros(0, np.int64),
            mark_xy_px=np.zeros((0, 2)),
        )

    def without_check_points(self) -> "Control":
        """Return the control points alone."""
        keep = ~self.is_check
        number = np.cumsum(keep) - 1
        marks = keep[self.mark_point]
        return replace(
            self,
            names=tuple(name for name, kept in zip(self.names, keep, strict=True) if kept),
            xyz_m=self.xyz_m[keep],
            std_m=self.std_m[keep],
            is_check=self.is_check[keep],
            mark_point=number[self.mark_point[marks]],
            mark_image=self.mark_image[marks],
            mark_xy_px=self.mark_xy_px[marks],
        )

    @property
    def num_points(self) -> int:
        return len(self.names)


@dataclass(frozen=True, kw_only=True, eq=False)
class ControlFit:
    """How a result fits its surveyed points, one row a point of `Control`; NaN where a point or axis has no answer.

    - `adjusted_m`: the point in the result, local frame. `residual_m`: adjusted minus surveyed, east, north, up.
    - `std_m`: predicted sigma of the adjusted point; NaN along an axis that nothing measured holds the block along, and
      after a fit of 7 or 12 parameters that of its marks alone. `num_marks`: used. `mark_rms_px`: of their errors.
    - `over_sigma`: the largest of the three differences between survey and what all else says of the point, over its
      predicted sigma. Of a check point what its fellows have in common is no part of it, where that is significant.
    - `detectable_m`: of a control point in the adjustment, the smallest error an axis that a test of 0.1% finds in four
      of five cases; infinite where nothing checks it. `reach_m`: by how much an error of that size moves the point.
    - `check_shift_m`, `check_shift_std_m`: what all check points are off in common, and its sigma; NaN of fewer than 3.
    - `without_m`, `without_std_m`: where all else that stands places a control point, minus the survey, and its sigma:
      the residual of an adjustment without the point.
    - `used_std_m`: the sigmas with which surveyed coordinates held the block, infinite where they did not.
    - `is_suspect`: over the limit of the blunder test. `is_set_aside`: surveyed coordinates that the test took out.
    - `scale`: that sigmas of control were multiplied by, horizontal and vertical, since the points scatter by that.
    - `method`: by which control was used; `none` where it could not be.
    - `control_rms_m`, `check_rms_m`: an axis, over all points that have a residual in it and were not set aside.
    - `gnss_minus_control_m`, `gnss_minus_control_std_m`: what all GNSS positions are off in common, where control fixes
      the block, and its sigma; NaN of the latter after a fit.
    """

    adjusted_m: Float[np.ndarray, "points 3"]
    residual_m: Float[np.ndarray, "points 3"]
    std_m: Float[np.ndarray, "points 3"]
    num_marks: Int[np.ndarray, " points"]
    mark_rms_px: Float[np.ndarray, " points"]
    over_sigma: Float[np.ndarray, " points"]
    detectable_m: Float[np.ndarray, "points 3"]
    reach_m: Float[np.ndarray, "points 3"]
    without_m: Float[np.ndarray, "points 3"]
    without_std_m: Float[np.ndarray, "points 3"]
    used_std_m: Float[np.ndarray, "points 3"]
    check_shift_m: Float[np.ndarray, "3"]
    check_shift_std_m: Float[np.ndarray, "3"]
    is_suspect: Bool[np.ndarray, " points"]
    is_set_aside: Bool[np.ndarray, "points 3"]
    method: str
    control_rms_m: Float[np.ndarray, "3"]
    check_rms_m: Float[np.ndarray, "3"]
    gnss_minus_control_m: Float[np.ndarray, "3"]
    gnss_minus_control_std_m: Float[np.ndarray, "3"]
    scale: Float[np.ndarray, "2"]

    @staticmethod
    def nothing(num_points: int = 0) -> "ControlFit":
        """Return a fit of points that the result says nothing of."""
        unknown = np.full((num_points, 3), np.nan)
        return ControlFit(
            adjusted_m=unknown,
            residual_m=unknown,
            std_m=unknown,
            num_marks=np.zeros(num_points, np.int64),
            mark_rms_px=np.full(num_points, np.nan),
            over_sigma=np.full(num_points, np.nan),
            detectable_m=unknown,
            reach_m=unknown,
            without_m=unknown,
            without_std_m=unknown,
            used_std_m=np.full((num_points, 3), np.inf),
            check_shift_m=np.full(3, np.nan),
            check_shift_std_m=np.full(3, np.nan),
            is_suspect=np.zeros(num_points, bool),
            is_set_aside=np.zeros((num_points, 3), bool),
            method="none",
            control_rms_m=np.full(3, np.nan),
            check_rms_m=np.full(3, np.nan),
            gnss_minus_control_m=np.full(3, np.nan),
            gnss_minus_control_std_m=np.full(3, np.nan),
            scale=np.ones(2),
        )
