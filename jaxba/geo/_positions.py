"""Measured positions of photos as arrays on WGS 84, in whatever CRS each was given, and what heights are above."""

from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime

import numpy as np
from jaxtyping import Float
from pyproj import Transformer

from jaxba._crs_text import authority_code, horizontal_part
from jaxba._errors import JaxbaError
from jaxba.geo._crs import describe, parse_crs
from jaxba.geo._heights import KINDS, vertical_crs
from jaxba.geo._operation import Operation, horizontal_operation
from jaxba.scene import Photo, Position

FIX_STD_M = {"rtk_fixed": (0.03, 0.06), "rtk_float": (0.5, 1.0), "differential": (1.0, 2.0)}
"""Horizontal and vertical sigma by fix, where none is stated; the first is also the least that a stated one is taken
for, since the shutter's timing and the antenna's offset from the camera add to the receiver's own error."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Measured:
    """Positions of photos, one row a photo, NaN where there is none.

    - `longitude_deg`, `latitude_deg`: WGS 84. `height_m`: above `height_datum`, see `LocalFrame`.
    - `relative_altitude_m`: above the take-off point.
    - `stated_std_h_m`: as the photo or list states it. `std_m`: sigma east, north, up to weigh the position with.
    - `is_vouched`: the receiver stands behind its height: an RTK or differential fix, or a stated sigma up to 1 m.
    - `time_s`: of exposure; the photo's place in the order where a photo has none. `has_time`: all photos have one.
    - `height_datum`, `declared`: what heights are above, and who says so. `is_datum_assumed`: some do not say it.
    - `notes`: what was found and decided.
    """

    names: tuple[str, ...]
    longitude_deg: Float[np.ndarray, " photos"]
    latitude_deg: Float[np.ndarray, " photos"]
    height_m: Float[np.ndarray, " photos"]
    relative_altitude_m: Float[np.ndarray, " photos"]
    stated_std_h_m: Float[np.ndarray, " photos"]
    std_m: Float[np.ndarray, "photos 3"]
    is_vouched: np.ndarray
    time_s: Float[np.ndarray, " photos"]
    has_time: bool
    height_datum: str
    declared: str
    is_datum_assumed: bool
    notes: tuple[str, ...]


def measured_positions(
    photos: Sequence[Photo], *, height_datum: str = "as_tagged", std_h_m: float = 3.0, std_v_m: float = 5.0
) -> Measured:
    """Return the positions of photos on WGS 84, each transformed by itself, with their sigmas and height system.

    - `height_datum`: what the heights are above; `as_tagged` takes what the photos say, and refuses contradictions.
    - `std_h_m`, `std_v_m`: sigma of a position that states none and has no better fix than a single one.

    Raises `JaxbaError` for a CRS that is unknown, and for heights above different surfaces.
    """
    positions = [photo.position for photo in photos]
    numbers = np.array([_numbers(position) for position in positions], dtype=float).reshape(len(photos), 6)
    lon, lat, height, relative, std_h, std_v = numbers.T.copy()
    notes: list[str] = []
    for text in sorted({position.crs for position in positions if position} - {"EPSG:4326", "EPSG:4979"}):
        rows = [k for k, position in enumerate(positions) if position and position.crs == text]
        first = photos[rows[0]]
        label = f"{first.name} ({first.position.source if first.position else ''}): position's CRS"
        lon[rows], lat[rows], found = to_wgs84(text, numbers[rows, 0], numbers[rows, 1], label, "positions")
        notes += found
    missing = ~(np.isfinite(lon) & np.isfinite(lat)) | (np.abs(lat) > 90) | (np.abs(lon) > 180)
    missing |= (lon == 0) & (lat == 0)  # what a receiver without a fix writes
    lon[missing] = lat[missing] = np.nan
    datum, declared, found = _height_datum(photos, height_datum)
    times = [_seconds(photo.time) for photo in photos]
    has_time = len(photos) > 0 and all(time is not None for time in times)
    return Measured(
        names=tuple(photo.name for photo in photos),
        longitude_deg=lon,
        latitude_deg=lat,
        height_m=np.where(missing, np.nan, height),
        relative_altitude_m=relative,
        stated_std_h_m=std_h,
        std_m=_sigmas(positions, std_h, std_v, np.isfinite(height), (std_h_m, std_v_m)),
        is_vouched=np.array([_is_vouched(position) for position in positions], dtype=bool),
        time_s=np.array(times if has_time else range(len(photos)), dtype=float),
        has_time=has_time,
        height_datum=datum,
        declared=declared,
        is_datum_assumed=height_datum == "as_tagged" and _say_no_datum(photos),
        notes=(*notes, *found),
    )


def _numbers(position: Position | None) -> list[float | None]:
    if position is None:
        return [None] * 6
    return [position.x, position.y, position.z_m, position.relative_altitude_m, position.std_h_m, position.std_v_m]


def _is_vouched(position: Position | None) -> bool:
    return position is not None and (position.fix in FIX_STD_M or 0 < (position.std_v_m or np.inf) <= 1)


def _sigmas(
    positions: Sequence[Position | None],
    stated_h: Float[np.ndarray, " photos"],
    stated_v: Float[np.ndarray, " photos"],
    has_height: np.ndarray,
    otherwise: tuple[float, float],
) -> Float[np.ndarray, "photos 3"]:
    """Return sigmas: stated, else by fix; a vertical one that is not stated is twice a stated horizontal one."""
    by_fix = np.array([FIX_STD_M.get(p.fix, otherwise) if p else (np.nan, np.nan) for p in positions]).reshape(-1, 2)
    least_h, least_v = FIX_STD_M["rtk_fixed"]
    is_stated_h, is_stated_v = stated_h > 0, stated_v > 0
    std_h = np.where(is_stated_h, np.maximum(stated_h, least_h), by_fix[:, 0])
    std_v = np.where(is_stated_h, 2 * std_h, by_fix[:, 1])
    std_v = np.where(is_stated_v, np.maximum(stated_v, least_v), std_v)
    std_v = np.where(has_height | np.isnan(std_v), std_v, np.inf)
    return np.stack([std_h, std_h, std_v], axis=1)


def to_wgs84(
    text: str, x: Float[np.ndarray, " rows"], y: Float[np.ndarray, " rows"], label: str, what: str
) -> tuple[Float[np.ndarray, " rows"], Float[np.ndarray, " rows"], list[str]]:
    """Return longitude and latitude of x, y in a CRS, and how well the step is known.

    - `label`: where the CRS stands; `what`: is transformed; both for messages.
    """
    crs = parse_crs(text, label)
    flat = horizontal_part(crs)
    if not (flat.is_projected or flat.is_geographic) or flat.geodetic_crs is None:
        raise JaxbaError(f"{label}={text}, {describe(crs)}, is neither projected nor geographic; give one that is.")
    # roughly, to choose the operation: the datum's own longitude and latitude
    rough = Transformer.from_crs(flat, flat.geodetic_crs, always_xy=True).transform(x, y)
    known = np.isfinite(rough).all(axis=0)
    if not known.any():
        return np.full(len(x), np.nan), np.full(len(x), np.nan), []
    place = float(np.median(rough[0][known])), float(np.median(rough[1][known]))
    operation = horizontal_operation(crs, *place)
    lon, lat = operation.inverse(x, y)
    return lon, lat, operation_notes(f"{what} in {describe(crs)}", operation)


def operation_notes(what: str, operation: Operation) -> list[str]:
    """Return, where the step between a CRS and WGS 84 is not exact, how well it is known."""
    if operation.accuracy_m == 0 and operation.missing_grid is None:
        return []
    accuracy = f"{operation.accuracy_m:g} m" if operation.accuracy_m is not None else "unknown"
    text = f"{what}: between WGS 84 and its datum by '{operation.name}', accuracy {accuracy}"
    if operation.missing_grid:
        text += f"; the best operation needs the grid {operation.missing_grid}, which is not installed"
    return [f"{text}."]


def _height_datum(photos: Sequence[Photo], asked: str) -> tuple[str, str, list[str]]:
    """Return what the photos' heights are above, who says so, and notes."""
    tagged: dict[str, list[str]] = {}
    for photo in photos:
        if photo.position is not None and photo.position.z_m is not None:
            tagged.setdefault(_tagged_datum(photo.position), []).append(photo.name)
    counts = ", ".join(f"{KINDS.get(kind, kind)}: {len(names)} ({names[0]}, ...)" for kind, names in tagged.items())
    if asked != "as_tagged":
        vertical_crs(asked)
        others = [kind for kind in tagged if kind not in (asked, "unknown")]
        contradicts = [f"Heights are declared as {asked}, though the photos' tags say {counts}."] if others else []
        return asked, "as declared", contradicts
    kinds = [kind for kind in tagged if kind != "unknown"]
    if len(kinds) > 1:
        raise JaxbaError(
            f"the photos' heights are above different surfaces, which lie tens of metres apart: {counts}. Declare what "
            "all are above with crs.height_datum if the tags are wrong, or adjust the sets apart."
        )
    if not kinds:
        return "unknown", "by the photos' tags", []
    mixed = [f"Some heights do not say what they are above; all are taken as {kinds[0]}: {counts}."]
    return kinds[0], "by the photos' tags", mixed if "unknown" in tagged else []


def _say_no_datum(photos: Sequence[Photo]) -> bool:
    """Return whether some heights of the photos do not say what they are above."""
    positions = [photo.position for photo in photos if photo.position is not None]
    return any(_tagged_datum(position) == "unknown" for position in positions if position.z_m is not None)


def _tagged_datum(position: Position) -> str:
    """Return the height system that a position states, by its CRS where that has a vertical part."""
    if position.crs == "EPSG:4326":
        return position.height_kind
    crs = parse_crs(position.crs, f"{position.source}: position's CRS")
    if crs.is_compound:
        return authority_code(crs.sub_crs_list[-1]) or position.height_kind
    return "ellipsoidal" if len(crs.axis_info) == 3 else position.height_kind


def _seconds(text: str | None) -> float | None:
    """Return a time such as `2016:06:23 16:31:59` or `2016-06-23T16:31:59.5` in seconds from any fixed day, or None."""
    if not text:
        return None
    date, time = text.strip()[:10].replace(":", "-"), text.strip()[11:]
    try:
        moment = datetime.fromisoformat(f"{date}T{time}" if time else date)
    except ValueError:
        return None
    return (moment.replace(tzinfo=None) - datetime(2000, 1, 1)).total_seconds()
