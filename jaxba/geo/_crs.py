"""The CRS of the results: read from the user's text, or proposed, and refused where it cannot hold the survey.

A wrong CRS shows late and looks plausible: a neighbouring UTM zone warps a block, swapped axes put it on another
continent, degrees taken as metres flatten it. So what is refused here is refused with the zone that would fit.
"""

import re

import numpy as np
from jaxtyping import Float
from pyproj import CRS, Proj
from pyproj.database import get_units_map
from pyproj.exceptions import CRSError

from jaxba._errors import JaxbaError

MIDDLE_TOLERANCE_DEG = 0.05
"""The survey's middle may lie this far outside the area of use: its bounds are those of a rectangle, and rounded."""
EDGE_TOLERANCE_DEG = 0.5
"""Single positions may lie this far outside: UTM zones overlap by about 40 km on each side."""
MAX_SCALE_ERROR = 0.02
"""Without a stated area of use, lengths may be wrong by this share: 5 times what the edge of a UTM zone has."""


def parse_crs(text: str, label: str = "CRS") -> CRS:
    """Return the CRS that a text means: `EPSG:32615`, `EPSG:26915+5703`, `WGS84 UTM 15N`, WKT or a PROJ string.

    Raises `JaxbaError` with `label` where it means none.

    >>> parse_crs("WGS84 UTM 15N").name
    'WGS 84 / UTM zone 15N'
    """
    stripped = text.strip()
    utm = re.fullmatch(r"WGS[ _]?84\s*/?\s*UTM\s*(?:zone\s*)?(\d{1,2})\s*([NS])", stripped, re.IGNORECASE)
    if utm and 1 <= int(utm[1]) <= 60:
        stripped = f"EPSG:{(32600 if utm[2].upper() == 'N' else 32700) + int(utm[1])}"
    try:
        return CRS.from_user_input(stripped)
    except CRSError as error:
        raise JaxbaError(
            f"{label}={text!r} is no CRS that PROJ knows; give an EPSG code such as EPSG:32615, a compound one such as "
            "EPSG:32615+5773, WKT or a PROJ string."
        ) from error


def describe(crs: CRS) -> str:
    """Return the code and the name of a CRS, for messages.

    >>> describe(CRS("EPSG:2225"))
    'EPSG:2225 (NAD83 / California zone 1 (ftUS))'
    """
    code = authority_code(crs)
    name = crs.name if crs.name not in ("unknown", "undefined") else "a CRS without a name"
    return f"{code} ({name})" if code else name


def authority_code(crs: CRS) -> str | None:
    """Return `EPSG:32615`, or `EPSG:32615+5773` of a compound CRS, or None where no authority has it."""
    if authority := crs.to_authority(min_confidence=100):
        return ":".join(authority)
    if crs.is_compound:
        parts = [part.to_authority(min_confidence=100) for part in crs.sub_crs_list]
        if all(part is not None and part[0] == "EPSG" for part in parts):
            return "EPSG:" + "+".join(part[1] for part in parts if part)
    return None


def utm_zone(longitude_deg: float, latitude_deg: float) -> CRS:
    """Return the WGS 84 / UTM zone of a place; beyond 84 north and 80 south, universal polar stereographic (E, N).

    >>> utm_zone(-92.0, 46.8).to_authority()
    ('EPSG', '32615')
    """
    if latitude_deg > 84 or latitude_deg < -80:
        return CRS.from_epsg(5041 if latitude_deg > 0 else 5042)
    zone = int((longitude_deg + 180) // 6) % 60 + 1
    return CRS.from_epsg((32600 if latitude_deg >= 0 else 32700) + zone)


def target_crs(
    text: str | None,
    longitude_deg: Float[np.ndarray, " positions"],
    latitude_deg: Float[np.ndarray, " positions"],
    label: str = "crs.target_crs",
) -> CRS:
    """Return the CRS of the results: the one of `text`, checked, or for None the UTM zone of the survey's middle.

    It is projected, its axes point east and north in units that are known, and it holds the survey, which is given on
    WGS 84; without positions that last check falls away. It may be compound: heights are `height_step`'s business.
    Raises `JaxbaError`, which names the zone that fits.

    >>> target_crs(None, np.array([-92.0]), np.array([46.8])).name
    'WGS 84 / UTM zone 15N'
    """
    known = np.isfinite(longitude_deg) & np.isfinite(latitude_deg)
    lon, lat = longitude_deg[known], latitude_deg[known]
    if text is None:
        if not len(lon):
            raise JaxbaError(f"{label}: no position proposes a CRS; give one, such as EPSG:32615.")
        return utm_zone(*middle(lon, lat))
    crs = parse_crs(text, label)
    fitting = f" {describe(utm_zone(*middle(lon, lat)))} fits the survey." if len(lon) else ""
    named = f"{label}={text if len(text) < 60 else text[:57] + '...'}, {describe(crs)},"
    _refuse_wrong_kind(crs, named, fitting)
    if len(lon):
        refuse_wrong_place(crs, lon, lat, named, fitting)
    return crs


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


def horizontal_part(crs: CRS) -> CRS:
    """Return the CRS of x and y alone."""
    return crs.sub_crs_list[0].to_2d() if crs.is_compound else crs.to_2d()


def _refuse_wrong_kind(crs: CRS, named: str, fitting: str) -> None:
    cure = f"Give a projected CRS.{fitting}"
    if crs.is_geographic:
        raise JaxbaError(f"{named} is geographic: its axes are degrees, not lengths. {cure}")
    if crs.is_geocentric:
        raise JaxbaError(f"{named} is geocentric: its axes point through the earth's middle. {cure}")
    if not crs.is_projected:
        raise JaxbaError(f"{named} is not projected, but {crs.type_name.lower()}. {cure}")
    axes = horizontal_part(crs).axis_info
    directions = [axis.direction for axis in axes]
    is_polar = directions in (["south", "south"], ["north", "north"])  # both axes point away from the pole, or to it
    if set(directions) != {"east", "north"} and not is_polar:
        raise JaxbaError(f"{named} has axes that point {' and '.join(directions)}, not east and north. {cure}")
    linear = get_units_map(category="linear")
    for axis in axes:
        unit = linear.get(axis.unit_name)
        # 1e-9: an international and a US foot differ by 2e-6
        if unit is None or not np.isclose(unit.conv_factor, axis.unit_conversion_factor, rtol=1e-9, atol=0):
            raise JaxbaError(
                f"{named} has an axis in an unknown unit ({axis.unit_name}, {axis.unit_conversion_factor:g} m)."
                f" Give a CRS in metres, feet or US survey feet.{fitting}"
            )
    if axes[0].unit_name != axes[1].unit_name:
        raise JaxbaError(f"{named} has axes in two units, {axes[0].unit_name} and {axes[1].unit_name}. {cure}")


def refuse_wrong_place(
    crs: CRS, lon: Float[np.ndarray, " positions"], lat: Float[np.ndarray, " positions"], named: str, fitting: str
) -> None:
    """Raise where a CRS is not made for the place of a survey; `named` and `fitting` begin and end the message."""
    survey = f"the survey lies around longitude {middle(lon, lat)[0]:.4f}, latitude {middle(lon, lat)[1]:.4f}"
    area = horizontal_part(crs).area_of_use or crs.area_of_use
    if area is None:
        scale = grid_scale(crs, *middle(lon, lat))
        if not abs(scale - 1) < MAX_SCALE_ERROR:
            length = f"a metre there is {scale:.3g} m long in it" if np.isfinite(scale) else "it does not reach there"
            raise JaxbaError(f"{named} does not contain the survey: {survey}, and {length}; a wrong zone?{fitting}")
        return
    west, south, east, north = area.bounds

    def outside_deg(lon, lat):
        """Return how far outside the bounds positions are, in degrees; their west lies east of the 180th meridian."""
        half = ((east - west) % 360 or 360) / 2
        return np.maximum(np.abs(wrapped(lon - (west + half))) - half, np.maximum(south - lat, lat - north))

    far = outside_deg(lon, lat)
    if outside_deg(*middle(lon, lat)) <= MIDDLE_TOLERANCE_DEG and far.max() <= EDGE_TOLERANCE_DEG:
        return
    raise JaxbaError(
        f"{named} does not contain the survey: it is for longitude {west:g} to {east:g}, latitude {south:g} to "
        f"{north:g}, and {survey}, {np.count_nonzero(far > 0)} of {len(lon)} positions outside; a wrong zone?{fitting}"
    )


def grid_scale(crs: CRS, longitude_deg: float, latitude_deg: float) -> float:
    """Return how long a metre on the ellipsoid is in the projection, as a ratio; NaN where it does not reach."""
    factors = Proj(horizontal_part(crs)).get_factors(longitude_deg, latitude_deg, errcheck=False)
    areal = float(np.asarray(factors.areal_scale))
    return float(np.sqrt(areal)) if np.isfinite(areal) and areal > 0 else float("nan")
