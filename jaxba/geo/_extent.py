"""Whether a projected CRS is made for the place of a survey.

The area of use decides, of the CRS itself, or of the codes that have its projection where it states none, as PROJ
strings do. A projection that no code has is judged by how far the survey lies from its central meridian, and by how
long a metre is in it.
"""

from collections.abc import Iterator

import numpy as np
from jaxtyping import Float
from pyproj import CRS, Proj
from pyproj.aoi import AreaOfInterest
from pyproj.database import query_crs_info
from pyproj.enums import PJType

from jaxba._crs_text import horizontal_part, likely_codes, unbound, utm_code
from jaxba._errors import JaxbaError

Bounds = tuple[float, float, float, float]
"""Of an area of use: west, south, east, north, degrees."""
MIDDLE_TOLERANCE_DEG = 0.05
"""The survey's middle may lie this far outside the area of use: its bounds are those of a rectangle, and rounded."""
EDGE_TOLERANCE_DEG = 0.5
"""Single positions may lie this far outside: UTM zones overlap by about 40 km on each side."""
MAX_SCALE_ERROR = 0.02
"""Without a stated area of use, lengths may be wrong by this share: 5 times what the edge of a UTM zone has."""
MAX_FROM_MERIDIAN_DEG = {"transverse mercator": 3.5, "lambert conic": 30.0, "albers": 30.0}
"""By method: half a zone of six degrees and what zones overlap; the widest countries that have one cone."""


def refuse_wrong_place(
    crs: CRS, lon: Float[np.ndarray, " positions"], lat: Float[np.ndarray, " positions"], named: str, fitting: str
) -> None:
    """Raise where a CRS is not made for the place of a survey; `named` and `fitting` begin and end the message."""
    x, y = middle(lon, lat)
    survey = f"the survey lies around longitude {x:.4f}, latitude {y:.4f}"
    own = horizontal_part(crs).area_of_use or crs.area_of_use
    zone = utm_code(crs)
    areas = [own.bounds] if own is not None else _areas_of((*likely_codes(crs), *([zone] if zone else [])))
    if not areas:
        why = _beyond_projection(crs, x, y)
        if why:
            raise JaxbaError(f"{named} does not contain the survey: {survey}, {why}; a wrong zone?{fitting}")
        return
    if any(_holds(area, lon, lat) for area in areas):
        return
    if own is None and any(_holds(area, lon, lat) for area in _areas_of(_same_grids_around(crs, x, y))):
        return
    west, south, east, north = areas[0]
    outside = np.count_nonzero(_outside_deg(areas[0], lon, lat) > 0)
    raise JaxbaError(
        f"{named} does not contain the survey: it is for longitude {west:g} to {east:g}, latitude {south:g} to "
        f"{north:g}, and {survey}, {outside} of {len(lon)} positions outside; a wrong zone?{fitting}"
    )


def middle(
    longitude_deg: Float[np.ndarray, " positions"], latitude_deg: Float[np.ndarray, " positions"]
) -> tuple[float, float]:
    """Return the median longitude and latitude, also of a survey that crosses the 180th meridian."""
    first = longitude_deg[0]
    lon = first + np.median(wrapped(longitude_deg - first))
    return float(wrapped(lon)), float(np.median(latitude_deg))


def wrapped(degrees):
    """Return angles in -180 to 180."""
    return (np.asarray(degrees) + 180) % 360 - 180


def grid_scale(crs: CRS, longitude_deg: float, latitude_deg: float) -> float:
    """Return how long a metre on the ellipsoid is in the projection, as a ratio; NaN where it does not reach."""
    factors = Proj(horizontal_part(crs)).get_factors(longitude_deg, latitude_deg, errcheck=False)
    areal = float(np.asarray(factors.areal_scale))
    return float(np.sqrt(areal)) if np.isfinite(areal) and areal > 0 else float("nan")


def _areas_of(codes: tuple[str, ...]) -> list[Bounds]:
    return [area.bounds for code in codes if (area := CRS(code).area_of_use) is not None]


def _holds(area: Bounds, lon: Float[np.ndarray, " n"], lat: Float[np.ndarray, " n"]) -> bool:
    at_middle = _outside_deg(area, *(np.array([value]) for value in middle(lon, lat)))[0]
    return bool(at_middle <= MIDDLE_TOLERANCE_DEG and _outside_deg(area, lon, lat).max() <= EDGE_TOLERANCE_DEG)


def _outside_deg(area: Bounds, lon: Float[np.ndarray, " n"], lat: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
    """Return how far outside the bounds positions are, in degrees; their west lies east of the 180th meridian."""
    west, south, east, north = area
    half = ((east - west) % 360 or 360) / 2
    return np.maximum(np.abs(wrapped(lon - (west + half))) - half, np.maximum(south - lat, lat - north))


def _beyond_projection(crs: CRS, lon: float, lat: float) -> str:
    """Return why a projection of its own is not for a place; empty where it may be."""
    operation = unbound(crs).coordinate_operation
    method = "" if operation is None else operation.method_name.lower()
    limit = next((deg for name, deg in MAX_FROM_MERIDIAN_DEG.items() if method.startswith(name)), None)
    meridian = next((value for name, value in _numbers(crs) if name.startswith("longitude of")), None)
    if limit is not None and meridian is not None:
        away = abs(float(wrapped(lon - np.degrees(meridian))))
        if away > limit:
            return f"{away:.1f} degrees from its central meridian of {np.degrees(meridian):g}, over {limit:g}"
    scale = grid_scale(crs, lon, lat)
    if abs(scale - 1) < MAX_SCALE_ERROR:
        return ""
    return "and " + (f"a metre there is {scale:.3g} m long in it" if np.isfinite(scale) else "it does not reach there")


def _same_grids_around(crs: CRS, lon: float, lat: float) -> tuple[str, ...]:
    """Return EPSG's codes for a place that have the projection of a CRS: PROJ's search does not find all of them.

    SWEREF 99 TM has the numbers of UTM zone 33 and is for all of Sweden, ten degrees wide.
    """
    around = AreaOfInterest(lon, lat, lon, lat)
    found = query_crs_info("EPSG", PJType.PROJECTED_CRS, around, contains=True)
    own = list(_numbers(crs))
    codes = (f"EPSG:{entry.code}" for entry in found)
    return tuple(code for code in codes if own and _is_same(own, list(_numbers(CRS(code)))))


def _numbers(crs: CRS) -> Iterator[tuple[str, float]]:
    """Yield method, parameters (radians, metres) and ellipsoid of a projection."""
    flat = unbound(crs)
    if flat.coordinate_operation is None or flat.ellipsoid is None:
        return
    yield flat.coordinate_operation.method_name.lower(), 0.0
    for parameter in flat.coordinate_operation.params:
        yield parameter.name.lower(), float(parameter.value) * parameter.unit_conversion_factor
    yield "semi-major axis", flat.ellipsoid.semi_major_metre


def _is_same(one: list[tuple[str, float]], other: list[tuple[str, float]]) -> bool:
    """Whether numbers agree to a millionth: half a metre of UTM's false easting, six of the earth's radius."""
    return [name for name, _ in one] == [name for name, _ in other] and np.allclose(
        [value for _, value in one], [value for _, value in other], rtol=1e-6, atol=1e-6
    )
