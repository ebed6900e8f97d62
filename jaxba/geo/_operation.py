"""One transformation from WGS 84 for a whole survey, chosen once, named, with its accuracy.

PROJ would choose anew for each point, fall back to less accurate operations in silence where a grid is not installed,
and, where it knows none, take one datum for the other ("ballpark"). Here one operation serves all points, ballpark is
refused, and a fall-back is said. The choice looks at the surroundings of one place, so it does not depend on a point.
"""

import warnings
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from jaxtyping import Float
from pyproj import CRS, Transformer
from pyproj.aoi import AreaOfInterest  # the same class as the one that TransformerGroup's signature names
from pyproj.enums import TransformDirection
from pyproj.transformer import TransformerGroup

from jaxba._crs_text import horizontal_part
from jaxba._errors import JaxbaError
from jaxba.geo._crs import describe

AROUND_DEG = 0.01


@dataclass(frozen=True, kw_only=True, eq=False)
class Operation:
    """A transformation between two CRSs, always in x, y order.

    - `transformer`: of pyproj. `name`: PROJ's. `accuracy_m`: None where it is not known.
    - `missing_grid`: a file that the most accurate operation needs and that is not installed; None where none is.
    """

    transformer: Transformer
    name: str
    accuracy_m: float | None
    missing_grid: str | None

    def inverse(
        self, x: Float[np.ndarray, " points"], y: Float[np.ndarray, " points"]
    ) -> tuple[Float[np.ndarray, " points"], Float[np.ndarray, " points"]]:
        """Return the longitude and latitude that the operation turns into x, y.

        PROJ's inverse of a Helmert step is one of small angles, up to millimetres off; two corrections mend that.
        """
        back = TransformDirection.INVERSE
        x_aim, y_aim = np.array(x), np.array(y)
        lon, lat = self.transformer.transform(x_aim, y_aim, direction=back)
        for _ in range(2):
            x_found, y_found = self.transformer.transform(lon, lat)
            x_aim, y_aim = x_aim + (x - x_found), y_aim + (y - y_found)
            lon, lat = self.transformer.transform(x_aim, y_aim, direction=back)
        return lon, lat


def horizontal_operation(crs: CRS, longitude_deg: float, latitude_deg: float) -> Operation:
    """Return the best installed operation from WGS 84 longitude, latitude to x, y of a CRS around a place.

    Raises `JaxbaError` where PROJ knows none, as for a CRS that names no datum.

    >>> operation = horizontal_operation(CRS("EPSG:31467"), 9.0, 50.0)  # its own order is northing, easting
    >>> x, y = operation.transformer.transform(9.0, 50.0)
    >>> round(x), round(y)
    (3500075, 5540407)
    """
    found, missing = operations(CRS.from_epsg(4326), horizontal_part(crs), longitude_deg, latitude_deg)
    if found:
        return found[0]
    cure = f"install {grid_cure(missing)}" if missing else "give a CRS that names its datum, such as an EPSG code"
    raise JaxbaError(f"{describe(crs)}: PROJ knows no transformation from WGS 84 to it; {cure}.")


def operations(
    source: CRS, target: CRS, longitude_deg: float, latitude_deg: float
) -> tuple[tuple[Operation, ...], str | None]:
    """Return the installed operations around a place, best first, and the grid that the best of all lacks."""
    return _operations(source.to_wkt(), target.to_wkt(), round(longitude_deg, 6), round(latitude_deg, 6))


def grid_cure(grid: str) -> str:
    """Return how a missing grid is had."""
    return f"the grid {grid} (`pyproj sync --file {grid}`, or PROJ_NETWORK=ON)"


@lru_cache(maxsize=64)
def _operations(source: str, target: str, lon: float, lat: float) -> tuple[tuple[Operation, ...], str | None]:
    around = AreaOfInterest(lon - AROUND_DEG, max(lat - AROUND_DEG, -90), lon + AROUND_DEG, min(lat + AROUND_DEG, 90))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # "best transformation is not available", which is told below
        group = TransformerGroup(
            CRS(source),
            CRS(target),
            always_xy=True,
            allow_ballpark=False,
            area_of_interest=around,  # pyright: ignore[reportArgumentType]
        )
    missing = None
    if not group.best_available:
        lacking = [[grid for grid in found.grids if not grid.available] for found in group.unavailable_operations]
        lacking = [grids for grids in lacking if grids]
        if lacking:
            missing = min(lacking, key=len)[0].short_name
    found = tuple(
        Operation(
            transformer=transformer,
            name=transformer.description.removeprefix("axis order change (2D) + "),
            accuracy_m=transformer.accuracy if transformer.accuracy >= 0 else None,
            missing_grid=missing,
        )
        for transformer in group.transformers
    )
    return found, missing
