"""Heights: declared or refused, never changed, nor left unchanged, in silence.

A photo's height stands above the ellipsoid, above some mean sea level, or above something that nobody wrote down; the
first two differ by up to 106 m. The local frame keeps the photos' own heights. Results keep them too where the target
CRS has no vertical part. Where it has one, it must be the declared datum, or PROJ must hold the geoid grid between the
two. PROJ alone would hand the height through unchanged where a grid is missing, even when asked for the best only, so
the step is built from a three-dimensional source, without ballpark operations, and must change a height to be believed.
"""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Float
from pyproj import CRS
from pyproj.database import get_units_map

from jaxba._crs_text import authority_code
from jaxba._errors import JaxbaError
from jaxba.geo._crs import describe, parse_crs
from jaxba.geo._operation import Operation, grid_cure, operations

KINDS = {
    "ellipsoidal": "the WGS 84 ellipsoid",
    "mean_sea_level": "mean sea level (no geoid named)",
    "unknown": "an unknown surface",
}


@dataclass(frozen=True, kw_only=True, eq=False)
class HeightStep:
    """How a height of the local frame becomes z of the results.

    - `operation`: between two datums; None where both are the same, or the target has no vertical part.
    - `source_unit_m`: metres in a unit of the operation's source. `unit`, `unit_m`: of z of the results.
    - `note`: in a sentence, what z is above and how that is known.
    """

    operation: Operation | None
    source_unit_m: float
    unit: str
    unit_m: float
    note: str


def vertical_crs(datum: str, label: str = "crs.height_datum") -> CRS | None:
    """Return the vertical CRS that a height datum such as `EPSG:5773` names; None of one of `KINDS`.

    Raises `JaxbaError` where the text is neither.
    """
    if datum in KINDS:
        return None
    crs = parse_crs(datum, label)
    if not crs.is_vertical or crs.is_compound:
        raise JaxbaError(
            f"{label}={datum}, {describe(crs)}, is no vertical CRS; give as_tagged, ellipsoidal, mean_sea_level, or "
            "the code of a vertical CRS, such as EPSG:5773 (EGM96 height)."
        )
    _up_unit(crs, f"{label}={datum}")
    return crs


def list_heights(
    text: str, z: Float[np.ndarray, " rows"], name: str
) -> tuple[Float[np.ndarray, " rows"], str | None, list[str]]:
    """Return heights of a list in metres, the surface that their CRS says they are above, and notes on their unit.

    Heights are in the unit of the CRS's vertical part; where it has none, in that of x and y, or in metres beside
    degrees. The surface is None where the CRS does not say it.

    - `text`: the CRS. `z`: as written, NaN where none was measured. `name`: of the list.

    Raises `JaxbaError` for a vertical axis that does not point up or has an unknown unit.

    >>> height_m, above, notes = list_heights("EPSG:26851", np.array([1050.0]), "geo.txt")
    >>> height_m.round(2).tolist(), above
    ([320.04], None)
    >>> notes[0].split(": ")[1]
    'EPSG:26851 (NAD83 / Minnesota South (ftUS)) does not say the unit of z, so z is in that of x and y'
    """
    crs = parse_crs(text, f"{name}: CRS")
    vertical, kind = _vertical_part(crs)
    above = None
    if vertical is not None:
        unit, unit_m = _up_unit(vertical, f"{name}: {describe(crs)}")
        above = (authority_code(vertical) or "mean_sea_level") if kind == "gravity" else "ellipsoidal"
        why = f"{describe(crs)} has heights in {unit}"
    else:
        axis = crs.axis_info[0]
        unit, unit_m = (axis.unit_name, axis.unit_conversion_factor) if crs.is_projected else ("metre", 1.0)
        why = f"{describe(crs)} does not say the unit of z, so z is in that of x and y"
    height_m = unit_m * z
    known = np.isfinite(z)
    if unit_m == 1 or not known.any():
        return height_m, above, []
    median, median_m = float(np.median(z[known])), float(np.median(height_m[known]))
    return height_m, above, [f"{name}: {why}: the median height, {median:.2f} {unit}, is {median_m:.2f} m."]


def height_step(
    crs: CRS, datum: str, declared: str, longitude_deg: float, latitude_deg: float, height_m: float = 0.0
) -> HeightStep:
    """Return the step from heights above `datum` to z of the target CRS, around a place.

    - `datum`: `ellipsoidal`, `mean_sea_level`, `unknown` or a vertical CRS such as `EPSG:5773`.
    - `declared`: who says so, for the note: `as declared`, `by the photos' tags`.

    Raises `JaxbaError` where the two are not known to be the same and no installed grid leads from one to the other.

    >>> step = height_step(CRS("EPSG:26915+6360"), "EPSG:5703", "as declared", -92.0, 46.8)
    >>> step.operation is None, step.unit  # NAVD88 in both, in US feet
    (True, 'US survey foot')
    """
    own = vertical_crs(datum)
    above = KINDS[datum] if own is None else f"{own.name} ({datum})"
    vertical, kind = _vertical_part(crs)
    if vertical is None:
        told = ", as the photos have them" if datum == "unknown" else f", {declared}"
        xy_unit = crs.axis_info[0].unit_name
        unlike = "" if xy_unit == "metre" else f" (x and y are in {xy_unit})"
        note = f"Heights are metres{unlike} above {above}{told}; the target CRS has no vertical part to change them."
        return HeightStep(operation=None, source_unit_m=1.0, unit="metre", unit_m=1.0, note=note)
    unit, unit_m = _up_unit(vertical, describe(crs))
    name = f"{vertical.name}" if kind == "gravity" else f"ellipsoidal height of {vertical.name}"
    if own is not None and kind == "gravity" and _same_datum(own, vertical):
        return HeightStep(
            operation=None, source_unit_m=1.0, unit=unit, unit_m=unit_m,
            note=f"Heights are {unit} above {name}, the datum of the photos, {declared}.",
        )  # fmt: skip
    if own is None and datum != "ellipsoidal":
        code = authority_code(vertical) if kind == "gravity" else "ellipsoidal"
        raise JaxbaError(
            f"{describe(crs)} has heights above {name}, and the photos' heights are above {above}: what leads from "
            f"one to the other is not known. Declare them with crs.height_datum={code} if that is what they are above, "
            "or leave the vertical part out of crs.target_crs to keep the photos' heights."
        )
    source = CRS.from_epsg(4979) if own is None else CRS(f"EPSG:4326+{datum.partition(':')[2]}")
    source_unit_m = 1.0 if own is None else _up_unit(own, datum)[1]
    found, missing = operations(source, crs, longitude_deg, latitude_deg)
    cure = "or leave the vertical part out of crs.target_crs to keep the photos' heights"
    between = f"heights above {above} cannot be turned into {name}, as {describe(crs)} asks"
    if not found:
        needs = f"install {grid_cure(missing)}" if missing else "PROJ knows no way between the two"
        raise JaxbaError(f"{between}: {needs}, {cure}.")
    z = found[0].transformer.transform(longitude_deg, latitude_deg, height_m / source_unit_m)[2] * unit_m
    if not abs(z) < 1e6 or ((own is not None or kind == "gravity") and z == height_m):
        raise JaxbaError(
            f"{between}: PROJ's '{found[0].name}' gives {z:g} m for {height_m:g} m at longitude {longitude_deg:.4f}, "
            f"latitude {latitude_deg:.4f}, so no geoid was applied; install its grid, {cure}."
        )
    return HeightStep(
        operation=found[0], source_unit_m=source_unit_m, unit=unit, unit_m=unit_m,
        note=f"Heights are {unit} above {name}, from heights above {above}, {declared}, by '{found[0].name}' "
        f"({z - height_m:+.3f} m at the origin).",
    )  # fmt: skip


def _vertical_part(crs: CRS) -> tuple[CRS | None, Literal["gravity", "ellipsoid"]]:
    if crs.is_compound:
        return crs.sub_crs_list[-1], "gravity"
    return (crs if len(crs.axis_info) == 3 else None), "ellipsoid"


def _up_unit(crs: CRS, named: str) -> tuple[str, float]:
    """Return the name of the unit of a height axis, and its length in metres."""
    axis = crs.axis_info[-1]
    if axis.direction != "up":
        raise JaxbaError(f"{named}: its vertical axis points {axis.direction}; give a CRS with heights.")
    if axis.unit_name not in get_units_map(category="linear"):
        raise JaxbaError(f"{named}: its vertical axis has an unknown unit, {axis.unit_name}; give another CRS.")
    return axis.unit_name, axis.unit_conversion_factor


def _same_datum(one: CRS, other: CRS) -> bool:
    return one.datum is not None and other.datum is not None and one.datum.name == other.datum.name
