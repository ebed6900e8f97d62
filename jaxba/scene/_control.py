"""Control and check points in the local frame, and where photos show them."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int


@dataclass(frozen=True, kw_only=True, eq=False)
class Control:
    """Surveyed points, one row a point, and their marks.

    - `xyz_m`, `std_m`: local frame, metres; an infinite sigma where a coordinate was not measured, whose value then is
      only a stand-in.
    - `is_check`: the point is compared with the result and takes no part in it.
    - `mark_point`: row of the point. `mark_image`: index of the image. `mark_xy_px`: on the file's pixel grid.
    - `mark_std_px`: sigma of a mark an axis.
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

    @property
    def num_points(self) -> int:
        return len(self.names)
