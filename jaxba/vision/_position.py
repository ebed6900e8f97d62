"""The position that a photo's tags state, with its accuracy, and what its height is above.

Latitude and longitude come from EXIF; DJI and Autel write them once more in XMP, with more digits, which are taken
where both agree to within EXIF's own rounding (5e-7 degrees, 5 cm): after post-processing EXIF is the newer one.

Height. EXIF's GPSAltitude is above mean sea level by its definition (GPSAltitudeRef 0 or 1; 2 and 3, since EXIF 3.0,
are above the ellipsoid). A DJI writes its height above the ellipsoid there if RTK positions it (an RtkFlag of 16 and
more; without a flag, AltitudeType RtkAlt); without RTK it writes a mixture of GNSS and barometer, above nothing that is
known. The height above the take-off point is kept apart.

RtkFlag (DJI's manuals of P1, M3E, M4): 0 failed, 16 single, 32 to 49 float, 50 fixed; RtkStdLon, RtkStdLat, RtkStdHgt
are sigmas in metres.
"""

import math
from typing import Any

from PIL import ExifTags

from jaxba.scene import Fix, HeightKind, Position
from jaxba.vision._exif import GPS, Tags, number, text

_EXIF_ROUNDING_DEG = 5e-7
_DISAGREEMENT_DEG = 1e-4
_DRONES = ("drone-dji", "drone", "drone-parrot")  # Autel writes DJI's names under `drone`


def find_position(tags: Tags, notes: list[str]) -> Position | None:
    """Return the position of a photo, or None; what is odd is added to `notes`."""
    place = _latitude_longitude(tags, notes)
    relative_m = _drone_number(tags, "RelativeAltitude")
    if place is None:
        if relative_m is not None:
            notes.append("height above take-off is stated, a position is not.")
        return None
    latitude, longitude, source = place
    fix, flag = _fix(tags)
    if flag == 0:
        notes.append("RTK failed to give a position (RtkFlag 0).")
    z_m, kind = _height(tags, flag, notes)
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


def _drone_number(tags: Tags, *names: str) -> float | None:
    return tags.xmp_number(*(f"{drone}:{name}" for name in names for drone in _DRONES))


def _latitude_longitude(tags: Tags, notes: list[str]) -> tuple[float, float, str] | None:
    in_exif = _checked(
        _angle(tags.gps, GPS.GPSLatitude, GPS.GPSLatitudeRef, "NS", notes),
        _angle(tags.gps, GPS.GPSLongitude, GPS.GPSLongitudeRef, "EW", notes),
        "EXIF",
        notes,
    )
    in_xmp = _checked(
        _drone_number(tags, "GpsLatitude", "Latitude"),
        _drone_number(tags, "GpsLongitude", "GpsLongtitude", "Longitude"),  # DJI's and Autel's misspelling
        "XMP",
        notes,
    )
    if in_exif is None or in_xmp is None:
        return (*in_exif, "EXIF") if in_exif else (*in_xmp, "XMP") if in_xmp else None
    apart = max(abs(a - b) for a, b in zip(in_exif, in_xmp, strict=True))
    if apart <= _EXIF_ROUNDING_DEG:
        return (*in_xmp, "XMP")
    if apart > _DISAGREEMENT_DEG:
        notes.append(
            f"EXIF says {in_exif[0]:.7f}, {in_exif[1]:.7f} and XMP {in_xmp[0]:.7f}, {in_xmp[1]:.7f}; EXIF is used."
        )
    return (*in_exif, "EXIF")


def _checked(
    latitude: float | None, longitude: float | None, source: str, notes: list[str]
) -> tuple[float, float] | None:
    """Return both if they are a place on earth that a receiver with a fix can be at."""
    if latitude is None or longitude is None:
        return None
    if abs(latitude) > 90 or abs(longitude) > 180:
        notes.append(f"{source} position {latitude:g}, {longitude:g} is out of range and counts as absent.")
        return None
    if latitude == 0 and longitude == 0:
        notes.append(f"{source} position 0, 0 is what a receiver without a fix writes and counts as absent.")
        return None
    return latitude, longitude


def _angle(gps: Any, tag: ExifTags.GPS, ref_tag: ExifTags.GPS, letters: str, notes: list[str]) -> float | None:
    """Return degrees of degrees, minutes, seconds; south and west are negative."""
    raw = gps.get(tag)
    if raw is None:
        return None
    parts = [number(part) for part in (raw if isinstance(raw, tuple | list) else (raw,))]
    if not 1 <= len(parts) <= 3 or parts[0] is None or any(part is None for part in parts):
        notes.append(f"{tag.name} {raw} is no angle and counts as absent.")
        return None
    known = [part for part in parts if part is not None]
    angle = sum(part / 60**power for power, part in enumerate(known))
    letter = text(gps.get(ref_tag)).upper()[:1]
    if letter not in letters or not letter:
        notes.append(
            f"{ref_tag.name} {gps.get(ref_tag)!r} is neither {letters[0]} nor {letters[1]}: {letters[0]} is assumed."
        )
    return -angle if letter == letters[1] else angle


def _fix(tags: Tags) -> tuple[Fix, float | None]:
    flag = _drone_number(tags, "RtkFlag")
    if flag is not None and flag >= 16:
        return ("rtk_fixed" if flag >= 50 else "rtk_float" if flag >= 32 else "single"), flag
    if number(tags.gps.get(GPS.GPSDifferential)) == 1:
        return "differential", flag
    return "unknown", flag


def _height(tags: Tags, rtk_flag: float | None, notes: list[str]) -> tuple[float | None, HeightKind]:
    raw, ref = tags.gps.get(GPS.GPSAltitude), number(tags.gps.get(GPS.GPSAltitudeRef))
    z_m = number(raw)
    if raw is not None and z_m is None:
        notes.append(f"GPSAltitude {raw} is no number and counts as absent.")
    if z_m is not None and ref in (1, 3):
        z_m = -abs(z_m)
    kind: HeightKind = "unknown" if ref is None else "ellipsoidal" if ref in (2, 3) else "mean_sea_level"
    absolute_m = _drone_number(tags, "AbsoluteAltitude")
    if absolute_m is None:
        return z_m, kind
    is_rtk = tags.xmp.get("drone-dji:AltitudeType") == "RtkAlt" if rtk_flag is None else rtk_flag >= 16
    rounding_m = 1.0 if z_m is None or z_m == round(z_m) else 0.01
    if z_m is None or abs(z_m - absolute_m) < rounding_m:  # the same height with more digits
        z_m = absolute_m
    return z_m, "ellipsoidal" if is_rtk else kind if ref in (2, 3) else "unknown"


def _accuracy(tags: Tags, notes: list[str]) -> tuple[float | None, float | None]:
    """Return stated sigmas, horizontal (an axis) and vertical; RTK's two horizontal ones as their mean square."""
    lon, lat = (_positive(_drone_number(tags, f"RtkStd{axis}")) for axis in ("Lon", "Lat"))
    if lon and lat:
        return math.sqrt((lon**2 + lat**2) / 2), _positive(_drone_number(tags, "RtkStdHgt"))
    horizontal = _positive(tags.xmp_number("Camera:GPSXYAccuracy"))
    vertical = _positive(tags.xmp_number("Camera:GPSZAccuracy"))
    if horizontal is None:
        horizontal = _positive(number(tags.gps.get(GPS.GPSHPositioningError)))
    dop = number(tags.gps.get(GPS.GPSDOP))
    if horizontal is None and dop is not None and dop > 5:
        notes.append(f"GPSDOP {dop:g}: the satellites stood badly when this position was measured.")
    return horizontal, vertical


def _positive(value: float | None) -> float | None:
    return value if value and value > 0 else None
