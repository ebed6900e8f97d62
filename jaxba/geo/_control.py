"""Surveyed points on WGS 84 in whatever CRS each was given, with heights above the surface that a frame's are above.

The list's CRS says what its heights are above where it has a vertical part; else they are declared, or taken for the
same as the photos', which is said. Heights above two surfaces are turned into each other or refused, never mixed.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from pyproj import CRS
from pyproj.enums import TransformDirection

from jaxba._crs_text import authority_code, horizontal_part
from jaxba._errors import JaxbaError
from jaxba.geo._crs import describe, parse_crs
from jaxba.geo._extent import refuse_wrong_place
from jaxba.geo._heights import KINDS, height_step, list_heights, vertical_crs
from jaxba.geo._positions import to_wgs84
from jaxba.geo._readings import rough_places, would_fit

AS_PHOTOS = "as_photos"
NEAR_M = 5000.0


@dataclass(frozen=True, kw_only=True, eq=False)
class Surveyed:
    """Points on WGS 84, one row a point.

    - `height_m`: metres above `height_datum`, see `LocalFrame`; NaN where none was measured.
    - `declared`: who says what heights are above. `is_datum_assumed`: nobody does. `crs`: of the first point, named by
      code where it has one.
    - `notes`: what was found and decided.
    """

    longitude_deg: Float[np.ndarray, " points"]
    latitude_deg: Float[np.ndarray, " points"]
    height_m: Float[np.ndarray, " points"]
    height_datum: str
    declared: str
    is_datum_assumed: bool
    crs: str
    notes: tuple[str, ...]


def surveyed_points(
    crs: Sequence[str],
    xyz: Float[np.ndarray, "points 3"],
    *,
    name: str,
    height_datum: str = AS_PHOTOS,
    photos_datum: str | None = None,
    near: tuple[float, float] | None = None,
) -> Surveyed:
    """Return surveyed points on WGS 84; each CRS must hold its points.

    - `crs`: of each point. `xyz`: east or longitude first; z NaN where none was measured. `name`: of the list.
    - `height_datum`: what heights are above where the CRS does not say so; `as_photos`: the same as the photos'.
    - `photos_datum`: None where no photo has a height.
    - `near`: longitude and latitude of the photos, for messages that say what would bring the points there.

    Raises `JaxbaError` for a CRS that is unknown or does not hold the points, and for heights above several surfaces.

    >>> found = surveyed_points(["EPSG:32615"], np.array([[576308.6, 5183424.7, 198.0]]), name="gcp_list.txt")
    >>> [round(float(value), 4) for value in (*found.longitude_deg, *found.latitude_deg)], found.height_datum
    ([-92.0, 46.8], 'unknown')
    """
    if height_datum != AS_PHOTOS:
        vertical_crs(height_datum, "control.height_datum")
    lon, lat, height = np.full(len(xyz), np.nan), np.full(len(xyz), np.nan), np.full(len(xyz), np.nan)
    notes: list[str] = []
    stated: dict[str, str] = {}
    for text in sorted(set(crs)):
        rows = np.array([k for k, own in enumerate(crs) if own == text])
        label = f"{name}: CRS"
        _refuse_elsewhere(text, xyz[rows], name, near)
        lon[rows], lat[rows], found = to_wgs84(text, xyz[rows, 0], xyz[rows, 1], label, "control")
        notes += found
        height[rows], own, found = list_heights(text, xyz[rows, 2], name)
        notes += found
        if own is not None and np.isfinite(height[rows]).any():
            stated[own] = text
    if len(stated) > 1:
        both = " and ".join(f"{_above(datum)} ({text})" for datum, text in stated.items())
        raise JaxbaError(f"{name}: heights are above several surfaces, {both}; give all of them above one.")
    has_heights = bool(np.isfinite(height).any())
    datum, declared = _datum(stated, height_datum, photos_datum, has_heights, name, notes)
    return Surveyed(
        longitude_deg=lon, latitude_deg=lat, height_m=height, height_datum=datum, declared=declared,
        is_datum_assumed=has_heights and height_datum == AS_PHOTOS and not stated,
        crs=(authority_code(parse_crs(crs[0])) or crs[0]) if len(crs) else "", notes=tuple(notes),
    )  # fmt: skip


def heights_above(
    datum: str,
    surveyed: Surveyed,
    name: str,
) -> tuple[Float[np.ndarray, " points"], list[str]]:
    """Return the heights of surveyed points above another surface, and notes.

    Raises `JaxbaError` where the way between the two is not known, or its grid is not installed.
    """
    own, height_m = surveyed.height_datum, surveyed.height_m
    known = np.isfinite(height_m)
    if own == datum or not known.any():
        return height_m, []
    differ = f"{name}: heights are above {_above(own)}, and the photos' above {_above(datum)}"
    for which, parameter in ((own, "control.height_datum"), (datum, "crs.height_datum")):
        if which in KINDS and which != "ellipsoidal":
            other = datum if which == own else own
            raise JaxbaError(
                f"{differ}: what leads from one to the other is not known. Declare both, with {parameter}={other} if "
                "that is what they are above, or a vertical CRS such as EPSG:5773; or leave control's heights out with "
                "control.heights=ignore."
            )
    lon, lat = surveyed.longitude_deg, surveyed.latitude_deg
    place = float(np.median(lon[known])), float(np.median(lat[known])), float(np.median(height_m[known]))
    target = CRS.from_epsg(4979) if own == "ellipsoidal" else CRS(f"EPSG:4326+{own.partition(':')[2]}")
    try:
        step = height_step(target, datum, "as declared", *place)
    except JaxbaError as error:
        raise JaxbaError(f"{differ}: {error} Or leave control's heights out with control.heights=ignore.") from error
    if step.operation is None:
        return height_m, []
    z = np.where(known, height_m, 0.0) / step.unit_m
    turned = step.operation.transformer.transform(lon, lat, z, direction=TransformDirection.INVERSE)[2]
    turned = np.where(known, turned * step.source_unit_m, np.nan)
    change = float(np.median(turned[known] - height_m[known]))
    return turned, [f"{differ}: control's are turned into the photos' by '{step.operation.name}' ({change:+.3f} m)."]


def _refuse_elsewhere(
    text: str, xyz: Float[np.ndarray, "points 3"], name: str, near: tuple[float, float] | None
) -> None:
    crs = parse_crs(text, f"{name}: CRS")
    if not (crs.is_projected or crs.is_geographic) or crs.geodetic_crs is None:
        return  # refused with the transformation
    lon, lat = rough_places(horizontal_part(crs), xyz[:, :2])
    try:
        if not (np.isfinite(lon) & np.isfinite(lat)).all():
            row = int(np.argmin(np.isfinite(lon) & np.isfinite(lat)))
            raise JaxbaError(
                f"{name}: {describe(crs)} has no place with x {xyz[row, 0]:g}, y {xyz[row, 1]:g}; x is the easting or "
                "longitude. Swap x and y if they are northing and easting, or correct the CRS."
            )
        if crs.is_projected:
            cure = " Swap x and y if they are northing and easting (x is the easting), or correct the CRS of the list."
            refuse_wrong_place(crs, lon, lat, f"{name}: {describe(crs)}", cure)
    except JaxbaError as error:
        fit = None
        if near is not None:
            fit = would_fit(text, xyz[:, :2], np.full(len(xyz), near[0]), np.full(len(xyz), near[1]), NEAR_M)
        if fit is None:
            raise
        raise JaxbaError(f"{error} With {fit[0]} it would be {fit[1] / 1000:.2f} km from the photos.") from None


def _datum(
    stated: dict[str, str], asked: str, photos: str | None, has_heights: bool, name: str, notes: list[str]
) -> tuple[str, str]:
    """Return what heights are above and who says so; notes are added to."""
    own = next(iter(stated), None)
    if not has_heights:
        return photos or "unknown", "by the photos' tags"
    if asked != AS_PHOTOS:
        if own is not None and own != asked:
            notes.append(f"{name}: heights are declared as above {_above(asked)}, its CRS says {_above(own)}.")
        return asked, "as declared"
    if own is not None:
        return own, f"by the CRS of {name}"
    if photos is None:
        notes.append(
            f"{name}: nothing says what heights are above, nor what those of the results are (control.height_datum)."
        )
        return "unknown", f"by {name}"
    notes.append(
        f"{name}: nothing says what heights are above: they are taken for the same as the photos', above "
        f"{_above(photos)}. If they are not, declare them with control.height_datum."
    )
    return photos, "by the photos' tags"


def _above(datum: str) -> str:
    own = vertical_crs(datum, "height datum")
    return KINDS[datum] if own is None else f"{own.name} ({datum})"
