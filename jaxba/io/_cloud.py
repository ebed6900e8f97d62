"""A point cloud as every cloud format takes it: one row a point, all columns of one length."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int, UInt8

from jaxba._errors import JaxbaError

STD_COLUMNS = ("std_x_m", "std_y_m", "std_z_m")
"""Names of a point's sigmas in all formats: along local east, north, up."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Cloud:
    """Points with what is known of each.

    - `xyz`: in the CRS and the units that the file is for. `rgb`: colours from the images.
    - `point_id`: the same point has the same number in all files. `track_length`: images that show it.
    - `error_px`: mean reprojection error. `std_m`: sigma along local east, north, up, metres; NaN where unknown.
    """

    xyz: Float[np.ndarray, "points 3"]
    rgb: UInt8[np.ndarray, "points 3"]
    point_id: Int[np.ndarray, " points"]
    track_length: Int[np.ndarray, " points"]
    error_px: Float[np.ndarray, " points"]
    std_m: Float[np.ndarray, "points 3"]

    @property
    def num_points(self) -> int:
        return self.xyz.shape[0]

    def check(self, label: str) -> None:
        """Raise `JaxbaError` where there is no point, or a coordinate is not finite."""
        if self.num_points == 0:
            raise JaxbaError(f"{label}: not written, the cloud has no points; look at why the adjustment left none.")
        bad = np.flatnonzero(~np.isfinite(self.xyz).all(axis=1))
        if bad.size:
            raise JaxbaError(
                f"{label}: not written, point {self.point_id[bad[0]]} holds NaN or infinity ({bad.size} such points); "
                "remove them."
            )
