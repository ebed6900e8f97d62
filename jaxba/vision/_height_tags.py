"""The height that a photo's tags state, and what it is above.

EXIF's GPSAltitude is above mean sea level by its definition (GPSAltitudeRef 0 or 1; 2 and 3, since EXIF 3.0, are above
the ellipsoid). A DJI writes its height above the ellipsoid there if RTK positions it (an RtkFlag of 16 and more;
without a flag, AltitudeType RtkAlt); without RTK it writes a mixture of GNSS and barometer, above nothing known.

DJI and Autel write the height once more in XMP (AbsoluteAltitude), with its sign, which in EXIF is a tag of its own. So
both are compared: where only the signs differ, XMP's is taken; any other difference beyond rounding is named and EXIF's
stays, since heights above two surfaces differ by tens of metres and neither is wrong. The height above the take-off
point (RelativeAltitude) is another thing, and is kept apart.
"""

import math
from typing import Any

from jaxba.scene import HeightKind
from jaxba.vision._exif import GPS, Tags, number

_PLAIN = "XMP's exif:GPSAltitude"
_MOST_GEOID_M = 110.0  # no geoid is farther from the ellipsoid: so far may heights above the two differ


def find_height(tags: Tags, rtk_flag: float | None, notes: list[str]) -> tuple[float | None, HeightKind]:
    """Return the height of a photo in metres and what it is above; what is odd is added to `notes`."""
    z_m, ref = _altitude(tags.gps.get(GPS.GPSAltitude), tags.gps.get(GPS.GPSAltitudeRef), "GPSAltitude", notes)
    plain = tags.xmp.get("exif:GPSAltitude"), tags.xmp.get("exif:GPSAltitudeRef")
    plain_m, plain_ref = _altitude(*plain, "exif:GPSAltitude", notes)
    source = "EXIF"
    if z_m is None:
        z_m, ref, source = plain_m, plain_ref, _PLAIN
    elif plain_m is not None:
        z_m = _compared(z_m, ref, source, plain_m, _PLAIN, notes, is_signed=plain_ref is not None)
        ref = plain_ref if ref is None else ref
    kind: HeightKind = "unknown" if ref is None else "ellipsoidal" if ref in (2, 3) else "mean_sea_level"
    absolute_m = tags.drone_number("AbsoluteAltitude")
    if absolute_m is None:
        return z_m, kind
    is_rtk = tags.xmp.get("drone-dji:AltitudeType") == "RtkAlt" if rtk_flag is None else rtk_flag >= 16
    if z_m == 0 and abs(absolute_m) > _MOST_GEOID_M:
        notes.append(
            f"the height of {source} is 0, that of XMP's AbsoluteAltitude {absolute_m:g} m; the latter is taken."
        )
        z_m = None
    if z_m is None:
        z_m = absolute_m
    else:
        z_m = _compared(z_m, ref, source, absolute_m, "XMP's AbsoluteAltitude", notes)
        if abs(z_m - absolute_m) < _rounding_m(z_m):  # the same height with more digits
            z_m = absolute_m
    return z_m, "ellipsoidal" if is_rtk else kind if ref in (2, 3) else "unknown"


def _altitude(raw: Any, raw_ref: Any, name: str, notes: list[str]) -> tuple[float | None, float | None]:
    """Return a height, negative below its surface, and GPSAltitudeRef."""
    z_m, ref = number(raw), number(raw_ref)
    if raw is not None and z_m is None:
        notes.append(f"{name} {raw} is no number and counts as absent.")
    return (-abs(z_m) if z_m is not None and ref in (1, 3) else z_m), ref


def _compared(
    z_m: float,
    ref: float | None,
    source: str,
    other_m: float,
    other: str,
    notes: list[str],
    *,
    is_signed: bool = True,
) -> float:
    """Return a height with the sign of another source where its own cannot be right; what disagrees is noted.

    - `is_signed`: the other source states a sign.
    """
    sizes_apart_m = abs(abs(z_m) - abs(other_m))
    is_one_size = sizes_apart_m < _rounding_m(z_m)
    is_high = min(abs(z_m), abs(other_m)) > _MOST_GEOID_M and sizes_apart_m < _MOST_GEOID_M
    if (z_m < 0) != (other_m < 0) and (is_one_size or is_high):
        if not is_signed:
            other_m = math.copysign(other_m, z_m)
        elif ref is None:
            notes.append(f"{source} has no GPSAltitudeRef: the sign of its height is taken from {other}.")
        else:
            side, other_side = ("below", "above") if z_m < 0 else ("above", "below")
            notes.append(
                f"{source} puts the camera {side} sea level (GPSAltitudeRef {ref:g}), {other} puts it {other_side}; "
                "the latter is taken."
            )
        z_m = math.copysign(z_m, other_m)
    if abs(z_m - other_m) >= _rounding_m(z_m):
        cause = "they are above two surfaces, or one is wrong" if abs(z_m - other_m) < _MOST_GEOID_M else "one is wrong"
        notes.append(
            f"the height of {source} lies {abs(z_m - other_m):.2f} m {'above' if z_m > other_m else 'below'} that of "
            f"{other}: {cause}; that of {source} is used."
        )
    return z_m


def _rounding_m(z_m: float) -> float:
    """Return what a height is rounded to, by its decimals: 1, 0.1 or 0.01 m."""
    return next((10.0**-places for places in (0, 1) if abs(z_m - round(z_m, places)) < 1e-9), 0.01)
