"""The position that a photo's tags state, with its accuracy, and what its height is above.

Latitude and longitude come from EXIF; DJI and Autel write them once more in XMP, with more digits, which are taken
where both agree to within EXIF's own rounding (5e-7 degrees, 5 cm; more where its seconds have few decimals, such as
15 m of whole seconds): after post-processing EXIF is the newer one. Some
editors leave nothing but XMP's own copy of the EXIF tags (`exif:GPSLatitude`), which is read last.

In EXIF the hemisphere is a tag of its own, which gets lost; in XMP it is part of the number. So a hemisphere that EXIF
leaves out comes from XMP, and where both give one angle with opposite signs, XMP's written sign is taken. Each such
photo is named, and so is every other disagreement beyond rounding.

RtkFlag (DJI's manuals of P1, M3E, M4): 0 failed, 16 single, 32 to 49 float, 50 fixed; RtkStdLon, RtkStdLat, RtkStdHgt
are sigmas in metres.
"""

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from PIL import ExifTags

from jaxba.scene import Fix, Position
from jaxba.vision._exif import GPS, Tags, drone_names, number, text
from jaxba.vision._height_tags import find_height

_EXIF_ROUNDING_DEG = 5e-7
_DISAGREEMENT_DEG = 1e-4
_EXIF, _DRONE, _PLAIN = "EXIF", "XMP", "XMP's exif tags"
_LETTERS = ("NS", "EW")
_PART = re.compile(r"[-+]?\d+(?:\.\d*)?(?:/\d+)?")
_UNITS = re.compile(r"\s*(?:DEG(?:REES?)?|MIN(?:UTES?)?|SEC(?:ONDS?)?|[°º˚'\"\u2032\u2033\u2019\u201d,;:\s])\s*")


@dataclass(frozen=True)
class _Angle:
    """Degrees, south and west negative.

    - `is_signed`: the source states the hemisphere. `rounding_deg`: half its last digit.
    """

    deg: float
    is_signed: bool
    rounding_deg: float = _DISAGREEMENT_DEG


_Place = tuple[_Angle, _Angle]  # latitude, longitude


def find_position(tags: Tags, notes: list[str]) -> Position | None:
    """Return the position of a photo, or None; what is odd is added to `notes`."""
    place = _latitude_longitude(tags, notes)
    relative_m = tags.drone_number("RelativeAltitude")
    if place is None:
        if relative_m is not None:
            notes.append("height above take-off is stated, a position is not.")
        return None
    latitude, longitude, source = place
    fix, flag = _fix(tags)
    if flag == 0:
        notes.append("RTK failed to give a position (RtkFlag 0).")
    z_m, kind = find_height(tags, flag, notes)
    std_h_m, std_v_m = _accuracy(tags, notes)
    return Position(
        x=longitude,
        y=latitude,
        z_m=z_m,
        height_kind=kind,
        relative_altitude_m=relative_m,
        std_h_m=std_h_m,
        std_v_m=std_v_m,
        fix=fix,
        source=source,
    )


def _number(tags: Tags, tag: ExifTags.GPS) -> float | None:
    """Return a number of the GPS directory, or of its copy in XMP."""
    value = number(tags.gps.get(tag))
    return tags.xmp_number(f"exif:{tag.name}") if value is None else value


def _latitude_longitude(tags: Tags, notes: list[str]) -> tuple[float, float, str] | None:
    """Return degrees, and the source that gives them."""
    stated = {
        _EXIF: (
            _angle(tags.gps, GPS.GPSLatitude, GPS.GPSLatitudeRef, notes),
            _angle(tags.gps, GPS.GPSLongitude, GPS.GPSLongitudeRef, notes),
        ),
        _DRONE: (
            _drone_angle(tags, "GpsLatitude", "Latitude"),
            _drone_angle(tags, "GpsLongitude", "GpsLongtitude", "Longitude"),  # DJI's and Autel's misspelling
        ),
        _PLAIN: (_plain_angle(tags, "GPSLatitude", "NS", notes), _plain_angle(tags, "GPSLongitude", "EW", notes)),
    }
    found = {source: place for source, pair in stated.items() if (place := _checked(pair, source, notes)) is not None}
    if not found:
        return None
    first = next(iter(found))
    latitude, longitude = (_with_hemisphere(axis, found, notes) for axis in (0, 1))
    for source in list(found)[1:]:
        other = found[source]
        apart = max(_apart(latitude, other[0]), _apart(longitude, other[1]))
        digits_deg = min(angle.rounding_deg for angle in found[first])
        rounding_deg = max(_EXIF_ROUNDING_DEG, digits_deg) if first == _EXIF else _DISAGREEMENT_DEG
        if (first, source) == (_EXIF, _DRONE) and apart <= rounding_deg:
            latitude, longitude = (
                math.copysign(angle.deg, ours) for angle, ours in zip(other, (latitude, longitude), strict=True)
            )
            first = _DRONE
        elif apart > max(rounding_deg, min(angle.rounding_deg for angle in other)):
            notes.append(
                f"{first} says {latitude:.7f}, {longitude:.7f} and {source} {other[0].deg:.7f}, {other[1].deg:.7f}; "
                f"{first} is used."
            )
    return latitude, longitude, "XMP" if first == _PLAIN else first


def _apart(value: float, angle: _Angle) -> float:
    """Return degrees between a signed value and an angle, whose sign counts only where it is stated."""
    return abs(value - angle.deg) if angle.is_signed else abs(abs(value) - abs(angle.deg))


def _with_hemisphere(axis: int, found: Mapping[str, _Place], notes: list[str]) -> float:
    """Return the first source's degrees, with the sign that is stated."""
    source, *others = found
    letters, name = _LETTERS[axis], ("GPSLatitudeRef", "GPSLongitudeRef")[axis]
    own = found[source][axis]
    for other in others:
        theirs = found[other][axis]
        states_it = theirs.is_signed or (other == _DRONE and not own.is_signed)  # a number without a sign is positive
        if not states_it or (own.is_signed and (theirs.deg < 0) == (own.deg < 0)):
            continue
        letter = letters[theirs.deg < 0]
        if not own.is_signed:
            notes.append(f"{source} has no {name}: {letter} is taken from {other}.")
        elif abs(abs(theirs.deg) - abs(own.deg)) <= _DISAGREEMENT_DEG:
            notes.append(f"{source} says {letters[own.deg < 0]} ({name}) and {other} says {letter}, which is taken.")
        else:
            continue
        return math.copysign(own.deg, theirs.deg)
    if not own.is_signed and source != _DRONE:
        notes.append(f"{source} has no {name}, and nothing else states it: {letters[0]} is assumed.")
    return own.deg


def _checked(pair: tuple[_Angle | None, _Angle | None], source: str, notes: list[str]) -> _Place | None:
    """Return both if they are a place on earth that a receiver with a fix can be at."""
    latitude, longitude = pair
    if latitude is None or longitude is None:
        return None
    where = f"{source} position {latitude.deg:g}, {longitude.deg:g}"
    if abs(latitude.deg) > 90 or abs(longitude.deg) > 180:
        notes.append(f"{where} is out of range and counts as absent.")
        return None
    if latitude.deg == 0 and longitude.deg == 0:
        notes.append(f"{where} is what a receiver without a fix writes and counts as absent.")
        return None
    return latitude, longitude


def _angle(gps: Any, tag: ExifTags.GPS, ref_tag: ExifTags.GPS, notes: list[str]) -> _Angle | None:
    """Return EXIF's degrees, minutes, seconds with the hemisphere of its own tag."""
    raw = gps.get(tag)
    if raw is None:
        return None
    parts = [number(part) for part in (raw if isinstance(raw, tuple | list) else (raw,))]
    deg = _degrees(parts)
    if deg is None:
        notes.append(f"{tag.name} {raw} is no angle and counts as absent.")
        return None
    letter = text(gps.get(ref_tag)).upper()[:1]
    letters = "NS" if tag == GPS.GPSLatitude else "EW"
    if letter and letter not in letters:
        notes.append(f"{ref_tag.name} {gps.get(ref_tag)!r} is neither {letters[0]} nor {letters[1]}.")
    is_signed = bool(letter) and letter in letters
    is_south_or_west = is_signed and letter == letters[1]
    return _Angle(-deg if is_south_or_west else deg, is_signed or deg < 0, _rounding_deg(parts))


def _degrees(parts: list[float | None]) -> float | None:
    """Return degrees of up to three parts: degrees, minutes, seconds."""
    known = [part for part in parts if part is not None]
    if not 1 <= len(parts) <= 3 or len(known) < len(parts):
        return None
    return sum(part / 60**power for power, part in enumerate(known))


def _rounding_deg(parts: list[float | None]) -> float:
    """Return half the last digit of degrees, minutes, seconds, in degrees; zeros behind a fraction are no digits.

    >>> [round(3600 * _rounding_deg([47.0, *rest]), 6) for rest in ((30.0, 36.0), (30.0, 36.25), (30.5, 0.0))]
    [0.5, 0.005, 3.0]
    """
    known = [part for part in parts if part is not None]
    while len(known) > 1 and known[-1] == 0 and known[-2] % 1:
        known.pop()
    places = next((places for places in range(9) if abs(known[-1] - round(known[-1], places)) < 1e-9), 9)
    return 0.5 * 10.0**-places / 60 ** (len(known) - 1)


def _drone_angle(tags: Tags, *names: str) -> _Angle | None:
    """Return a drone's decimal degrees; the sign of a number without one is not stated."""
    for name in drone_names(*names):
        deg = number(tags.xmp.get(name))
        if deg is not None:
            words = tags.xmp[name].strip()
            return _Angle(deg, words[:1] in "+-", 0.5 * 10.0 ** -len(words.partition(".")[2]))
    return None


def _plain_angle(tags: Tags, name: str, letters: str, notes: list[str]) -> _Angle | None:
    """Return an angle of XMP's own copy of the EXIF tags, see `parse_angle`."""
    raw = tags.xmp.get(f"exif:{name}")
    if raw is None:
        return None
    found = parse_angle(raw, letters)
    if found is None:
        notes.append(f"exif:{name} {raw!r} is no angle and counts as absent.")
        return None
    deg, is_signed = found
    letter = tags.xmp.get(f"exif:{name}Ref", "").strip().upper()[:1]
    if not is_signed and letter and letter in letters:
        deg, is_signed = (-deg if letter == letters[1] else deg), True
    return _Angle(deg, is_signed)


def parse_angle(words: str, letters: str) -> tuple[float, bool] | None:
    """Return degrees of a text and whether it states the hemisphere; None for what is no angle.

    XMP's own form has commas, `DDD,MM,SSk` or `DDD,MM.mmk` (XMP specification, part 2, GPSCoordinate); decimal degrees,
    ratios, and degrees with their signs are read too. `letters`: of the axis, `NS` or `EW`.

    >>> parse_angle("44,53.99553332N", "NS"), parse_angle("93,11,59.2W", "EW"), parse_angle("-93.1998", "EW")
    ((44.899925555333336, True), (-93.1997777777778, True), (-93.1998, True))
    """
    body = words.strip(" \x00").upper()
    letter = next((a for a in (body[-1:], body[:1]) if a and a in letters), "")
    body = body.removesuffix(letter) if body.endswith(letter) else body.removeprefix(letter)
    pieces = [piece for piece in _UNITS.split(body.strip()) if piece]
    if not pieces or not all(_PART.fullmatch(piece) for piece in pieces):
        return None
    parts = [number(piece) for piece in pieces]
    deg = _degrees([None if part is None else abs(part) for part in parts])
    # seconds that are rounded may be 60
    if deg is None or any(part is None or not 0 <= part <= 60 for part in parts[1:]):
        return None
    sign = pieces[0][0]
    if letter and sign == "-":
        return None  # twice a hemisphere, and not the same way in every program
    is_negative = letter == letters[1] if letter else sign == "-"
    return -deg if is_negative else deg, bool(letter) or sign in "+-"


def _fix(tags: Tags) -> tuple[Fix, float | None]:
    flag = tags.drone_number("RtkFlag")
    if flag is not None and flag >= 16:
        return ("rtk_fixed" if flag >= 50 else "rtk_float" if flag >= 32 else "single"), flag
    if _number(tags, GPS.GPSDifferential) == 1:
        return "differential", flag
    return "unknown", flag


def _accuracy(tags: Tags, notes: list[str]) -> tuple[float | None, float | None]:
    """Return stated sigmas, horizontal (an axis) and vertical; RTK's two horizontal ones as their mean square."""
    lon, lat = (_positive(tags.drone_number(f"RtkStd{axis}")) for axis in ("Lon", "Lat"))
    if lon and lat:
        return math.sqrt((lon**2 + lat**2) / 2), _positive(tags.drone_number("RtkStdHgt"))
    horizontal = _positive(tags.xmp_number("Camera:GPSXYAccuracy"))
    vertical = _positive(tags.xmp_number("Camera:GPSZAccuracy"))
    if horizontal is None:
        horizontal = _positive(_number(tags, GPS.GPSHPositioningError))
    dop = _number(tags, GPS.GPSDOP)
    if horizontal is None and dop is not None and dop > 5:
        notes.append(f"GPSDOP {dop:g}: the satellites stood badly when this position was measured.")
    return horizontal, vertical


def _positive(value: float | None) -> float | None:
    return value if value and value > 0 else None
