"""Where a plan lies: its coordinates, and metres east and north about its middle."""

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float

from jaxba._errors import JaxbaError
from jaxba.scene import LocalFrame

if TYPE_CHECKING:
    from pyproj import CRS


@dataclass(frozen=True)
class Place:
    """- `frame`: of the metres; None where the plan names no CRS, and its coordinates are metres themselves.

    - `origin`: of metres without a CRS. `is_geographic`: coordinates are longitude and latitude.
    """

    frame: LocalFrame | None = None
    origin: tuple[float, float] = (0.0, 0.0)
    is_geographic: bool = False

    @staticmethod
    def of(xy: Float[np.ndarray, "n 2"], crs: str | None) -> tuple["Place", Float[np.ndarray, "n 2"]]:
        """Return the place of some coordinates, and these in metres about their middle.

        Raises `JaxbaError` for a CRS that is none, or does not reach there.
        """
        if crs is None:
            middle = np.round((xy.min(axis=0) + xy.max(axis=0)) / 2)
            place = Place(origin=(float(middle[0]), float(middle[1])))
            return place, place.local(xy)
        from jaxba import geo

        known = geo.parse_crs(crs, "area.crs")
        if known.is_geographic:
            _refuse_degrees(xy)
            longitude, latitude = _from_geographic(known, xy)
            target = geo.utm_zone(float(longitude.mean()), float(latitude.mean()))
        else:
            target = geo.target_crs(crs, np.zeros(0), np.zeros(0), "area.crs")
            longitude, latitude = _from_projected(target, xy)
            geo.target_crs(crs, longitude, latitude, "area.crs")  # refuses what does not lie in it
        frame = geo.local_frame(target, longitude, latitude, np.zeros(len(xy)), "ellipsoidal", "by the plan")
        place = Place(frame, is_geographic=known.is_geographic)
        return place, place.local(xy)

    @property
    def unit(self) -> str:
        """Of the coordinates, in words."""
        if self.frame is None:
            return "metres"
        return "degrees of longitude and latitude" if self.is_geographic else f"x and y in {self.frame.crs}"

    def local(self, xy: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 2"]:
        """Return coordinates of the plan in metres about its middle."""
        if self.frame is None:
            return xy - np.array(self.origin)
        if not len(xy):
            return xy
        from jaxba import geo

        level = np.full((len(xy), 1), self.frame.height_m)
        if self.is_geographic:
            return geo.local_from_geodetic(self.frame, xy[:, 0], xy[:, 1], level[:, 0])[:, :2]
        return geo.local_from_projected(self.frame, np.hstack([xy, level]))[:, :2]

    def coordinates(self, local_m: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 2"]:
        """Return metres about the middle in coordinates of the plan."""
        if self.frame is None:
            return local_m + np.array(self.origin)
        from jaxba import geo

        back = geo.geodetic_from_local if self.is_geographic else geo.projected_from_local
        return back(self.frame, np.column_stack([local_m, np.zeros(len(local_m))]))[:, :2]


def _refuse_degrees(xy: Float[np.ndarray, "n 2"]) -> None:
    far = np.flatnonzero((np.abs(xy[:, 0]) > 180) | (np.abs(xy[:, 1]) > 90))
    if len(far):
        x, y = xy[far[0]]
        raise JaxbaError(
            f"area.polygon: entry {far[0] + 1} is [{x:g}, {y:g}], which is no longitude and latitude; give the CRS "
            "that it is in as area.crs, or longitude before latitude."
        )


def _from_geographic(
    crs: "CRS", xy: Float[np.ndarray, "n 2"]
) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"]]:
    from pyproj import Transformer

    return Transformer.from_crs(crs, "EPSG:4326", always_xy=True).transform(*xy.T)


def _from_projected(
    crs: "CRS", xy: Float[np.ndarray, "n 2"]
) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"]]:
    """Return longitude and latitude, roughly where PROJ knows several ways: this only finds the middle."""
    from pyproj import Transformer

    longitude, latitude = Transformer.from_crs(crs, "EPSG:4326", always_xy=True).transform(*xy.T)
    if not np.isfinite(longitude + latitude).all():
        raise JaxbaError("area.polygon: its coordinates do not lie in area.crs; check which is which, x comes first.")
    return longitude, latitude
