"""The CRS of the results: read from the user's text, or proposed, and refused where it cannot hold the survey.

A wrong CRS shows late and looks plausible: a neighbouring UTM zone warps a block, swapped axes put it on another
continent, degrees taken as metres flatten it. So what is refused here is refused with the zone that would fit.
"""

import numpy as np
from jaxtyping import Float
from pyproj import CRS
from pyproj.database import get_units_map

from jaxba._crs_text import authority_code, crs_of_text, horizontal_part, likely_codes, shown, utm_code
from jaxba._errors import JaxbaError
from jaxba.geo._extent import middle, refuse_wrong_place


def parse_crs(text: str, label: str = "CRS") -> CRS:
    """Return the CRS that a text means: `EPSG:32615`, `EPSG:26915+5703`, `WGS84 UTM 15N`, WKT or a PROJ string.

    Raises `JaxbaError` with `label` where it means none, or names no datum.

    >>> parse_crs("WGS84 UTM 15N").name
    'WGS 84 / UTM zone 15N'
    """
    no_crs = (
        "is no CRS that PROJ knows; give an EPSG code such as EPSG:32615, a compound one such as EPSG:32615+5773, WKT "
        "or a PROJ string."
    )
    return crs_of_text(text, f"{label}=", no_crs)


def describe(crs: CRS) -> str:
    """Return the code and the name of a CRS, for messages; of one without either, whose projection it has.

    >>> describe(CRS("EPSG:2225"))
    'EPSG:2225 (NAD83 / California zone 1 (ftUS))'
    >>> describe(CRS("+proj=utm +zone=33 +ellps=GRS80 +towgs84=0,0,0"))
    'a CRS without a name, projected as EPSG:25833 (ETRS89 / UTM zone 33N)'
    """
    code = authority_code(crs)
    if code is not None:
        return f"{code} ({CRS(code).name})"
    if crs.name not in ("unknown", "undefined"):
        return crs.name
    code = next(iter(likely_codes(crs)), utm_code(crs)) if crs.is_projected else None
    return "a CRS without a name" + (f", projected as {code} ({CRS(code).name})" if code else "")


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
    code = authority_code(crs)
    crs = crs if code is None else CRS(code)  # a PROJ string that says what a code says is that code
    fitting = f" {describe(utm_zone(*middle(lon, lat)))} fits the survey." if len(lon) else ""
    named = f"{label}={shown(text, 60)}, {describe(crs)},"
    _refuse_wrong_kind(crs, named, fitting)
    if len(lon):
        refuse_wrong_place(crs, lon, lat, named, fitting)
    return crs


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
