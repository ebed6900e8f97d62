"""A list that replaces positions, held against what the photos' own tags say, or else against its CRS's area of use.

Tags are wrong by metres, sometimes by tens of metres, and now and then a photo's are nonsense; a list that is read
wrongly lies hundreds of kilometres away. So the median of the photos decides, and a kilometre is nothing.
"""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from jaxba._crs_text import horizontal_part
from jaxba._errors import JaxbaError
from jaxba.geo._crs import describe, parse_crs
from jaxba.geo._extent import middle, refuse_wrong_place
from jaxba.geo._heights import list_heights
from jaxba.geo._positions import to_wgs84
from jaxba.geo._readings import FOOT_M, distance_m, rough_places, would_fit
from jaxba.scene import Photo, Position

MIN_PHOTOS = 3
"""Fewer photos with tags do not judge a list of more: one of them may be nonsense."""
MISREAD_M = 100.0
"""From here on a list is refused where a mistake, undone, brings it ten times nearer."""
MISREAD_SHARE = 0.1
HEIGHTS_APART_M = 150.0
"""Two height systems differ by 106 m at most."""


def hold_against_tags(photos: Sequence[Photo], max_distance_m: float) -> list[str]:
    """Return how far lists lie from the photos' own tags, in sentences.

    Raises `JaxbaError` for a list whose median lies over `max_distance_m` away, or nearer where a usual mistake
    explains it; and for one without tags to hold it against whose middle its CRS is not made for.
    """
    notes: list[str] = []
    listed = [photo for photo in photos if photo.position is not None and photo.position.list_name]
    for name, text in sorted({(p.position.list_name, p.position.crs) for p in listed if p.position is not None}):
        of_crs = [photo for photo in listed if photo.position is not None and photo.position.crs == text]
        tagged = [photo for photo in of_crs if _is_place(photo.tag_position)]
        if len(tagged) >= min(MIN_PHOTOS, len(of_crs)):
            notes += _against(tagged, text, name, max_distance_m)
            continue
        if tagged:
            notes.append(
                f"{name}: {len(tagged)} of its {len(of_crs)} photos have a position in their tags, too "
                "few to hold the list against."
            )
        _refuse_outside(of_crs, text, name)
    return notes


def _against(photos: Sequence[Photo], text: str, name: str, max_distance_m: float) -> list[str]:
    listed, tagged = _columns([photo.position for photo in photos]), _columns([photo.tag_position for photo in photos])
    away_m = float(np.median(distance_m(*_places(text, listed[:, :2]), tagged[:, 0], tagged[:, 1])))
    crs = describe(parse_crs(text))
    of = f"the photos' own tags (median of {len(photos)})"
    if away_m > MISREAD_M:
        within_m = max_distance_m if away_m > max_distance_m else MISREAD_SHARE * away_m
        fit = would_fit(text, listed[:, :2], tagged[:, 0], tagged[:, 1], within_m)
        first = photos[0].position
        if fit is not None or away_m > max_distance_m:
            limit = f", over {max_distance_m / 1000:g} km (crs.max_distance_km)" if away_m > max_distance_m else ""
            tried = (
                f"With {fit[0]} it would be {fit[1] / 1000:.2f} km: correct the list."
                if fit is not None
                else "No usual mistake explains it (axes, degrees, feet, zone, hemisphere): correct the list, or raise "
                "crs.max_distance_km if it is the tags that are wrong."
            )
            raise JaxbaError(
                f"{name}: positions lie {_length(away_m)} from {of}{limit}, by {crs}, the CRS of the list; "
                f"{first.source if first else name}, {photos[0].name}: x {listed[0, 0]:.10g}, y "
                f"{listed[0, 1]:.10g}. {tried}"
            )
    return [f"{name}: positions lie {_length(away_m)} from those of {of}.", *_heights_apart(text, listed, tagged, name)]


def _heights_apart(
    text: str, listed: Float[np.ndarray, "rows 3"], tagged: Float[np.ndarray, "rows 3"], name: str
) -> list[str]:
    """Return, where heights are farther apart than height systems are, by how much, and whether a unit explains it."""
    known = np.isfinite(listed[:, 2]) & np.isfinite(tagged[:, 2])
    if not known.any():
        return []
    up_m = float(np.median((listed - tagged)[known, 2]))
    if abs(up_m) <= HEIGHTS_APART_M:
        return []
    unit_m = float(list_heights(text, np.ones(1), name)[0][0])
    other_m, unit = (FOOT_M, "feet") if unit_m == 1 else (1 / unit_m, "metres")
    left_m = float(np.median(other_m * listed[known, 2] - tagged[known, 2]))
    if abs(left_m) <= min(HEIGHTS_APART_M, abs(up_m) / 4):
        why = (
            f"Read as {unit} they would be {abs(left_m):.1f} m off: give the CRS a vertical part in {unit}, or convert "
            "them"
        )
    else:
        why = "Check their unit, and what they are above"
    side = "above" if up_m > 0 else "below"
    return [f"{name}: heights lie {abs(up_m):.1f} m {side} those of the photos' own tags (median). {why}."]


def _refuse_outside(photos: Sequence[Photo], text: str, name: str) -> None:
    """Refuse a list whose middle lies where its CRS is not made for: degrees or swapped axes in a projected one."""
    crs = parse_crs(text)
    if not crs.is_projected:
        return
    xy = _columns([photo.position for photo in photos])[:, :2]
    lon, lat = _places(text, xy)
    known = np.isfinite(lon) & np.isfinite(lat)
    cure = (
        " Swap x and y if they are northing and easting (x is the easting), write EPSG:4326 if they are degrees, or "
        "correct the CRS of the list."
    )
    if 2 * np.count_nonzero(known) < len(photos):
        row = int(np.argmin(known))
        raise JaxbaError(
            f"{name}: {describe(crs)} has no place with x {xy[row, 0]:g}, y {xy[row, 1]:g} ({photos[row].name}).{cure}"
        )
    x, y = middle(lon[known], lat[known])
    refuse_wrong_place(crs, np.array([x]), np.array([y]), f"{name}: {describe(crs)}", cure)


def _places(
    text: str, xy: Float[np.ndarray, "photos 2"]
) -> tuple[Float[np.ndarray, " photos"], Float[np.ndarray, " photos"]]:
    """Return longitude and latitude; of the CRS's own datum where nothing leads from there, far outside, to WGS 84."""
    try:
        return to_wgs84(text, xy[:, 0], xy[:, 1], "CRS", "positions")[:2]
    except JaxbaError:
        return rough_places(horizontal_part(parse_crs(text)), xy)


def _is_place(position: Position | None) -> bool:
    """Whether tags hold a place: (0, 0) is what a receiver without a fix writes."""
    if position is None or (position.x == 0 and position.y == 0):
        return False
    return bool(abs(position.x) <= 180 and abs(position.y) <= 90)


def _columns(positions: Sequence[Position | None]) -> Float[np.ndarray, "rows 3"]:
    return np.array([(p.x, p.y, np.nan if p.z_m is None else p.z_m) for p in positions if p is not None], float)


def _length(metres: float) -> str:
    if not np.isfinite(metres):
        return "infinitely far"
    return f"{metres:.1f} m" if metres < 1000 else f"{metres / 1000:,.1f} km"
