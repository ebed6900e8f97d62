"""Focal length in pixels of the stored grid, and where it was found.

Of these the first that the tags hold is taken, unless the user gives one:

1. `calibrated`: DJI's CalibratedFocalLength or DewarpData, or the Pix4D tag PerspectiveFocalLength.
2. `focal_plane`: the focal length in millimetres and the pixels per unit of the focal plane.
3. `sensor_table`: the focal length in millimetres and the width of the sensor, see `_sensors.py`.
4. `equivalent_35mm`: f = f35 d / 43.27 with d the diagonal in pixels (CIPA DCG-001); a photo wider than 3:2 is
   taken for one cropped from 3:2.

All but the last belong to some original pixel grid, which a resize leaves behind: the stored grid is compared with
EXIF's size, the calibrated centre and the largest photo of the sensor, as a photo that was scaled, cropped to another
format, or both. Where EXIF's size was rewritten and the focal plane's resolution was not, the sensor's own size tells
the scale. A crop that keeps the format and is not scaled cannot be told from a resize.

What is found must agree with the sensor's specification (its width, and the lens's focal length where it is fixed).
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from jaxba._errors import JaxbaError
from jaxba.scene import FocalSource
from jaxba.vision._exif import BASE, Tags, number
from jaxba.vision._sensors import Sensor, find_sensor, scale_of

_FILM_DIAGONAL_MM = 43.2666
_MM_PER_UNIT = {2: 25.4, 3: 10.0, 4: 1.0, 5: 0.001}
_SAME_SIZE = 0.05  # two statements of the original width are of one photo
_SENSOR_WIDTHS_MM = (2.0, 70.0)


@dataclass(frozen=True, kw_only=True)
class Focal:
    """- `focal_px`, `source`: both None where nothing tells it. `focal_mm`: of the lens. `notes`: what was odd."""

    focal_px: float | None = None
    source: FocalSource | None = None
    focal_mm: float | None = None
    notes: tuple[str, ...] = ()


def find_focal(
    tags: Tags, make: str, model: str, *, given_px: float | None = None, max_deviation: float = 0.15
) -> Focal:
    """Return the focal length of a photo.

    - `given_px`: the user's, which wins; what the tags say is noted where it is further off than `max_deviation`.

    Raises `JaxbaError` where the tags' focal length is off the sensor's specification by more than `max_deviation`.
    """
    focal_mm = _positive(tags.number(BASE.FocalLength))
    sensor = find_sensor(make, model, focal_mm)
    notes: list[str] = []
    specified_px = _specified(tags, sensor, focal_mm)
    focal_px, source = next(_candidates(tags, sensor, focal_mm, specified_px, notes), (None, None))
    if given_px is not None:
        if focal_px is not None and abs(focal_px / given_px - 1) > max_deviation:
            notes.append(f"the given focal length, {given_px:.0f} px, is used; the tags say {focal_px:.0f} px.")
        return Focal(focal_px=given_px, source="given", focal_mm=focal_mm, notes=tuple(notes))
    if focal_px is None or source is None:
        notes.append("no tag tells the focal length; give --focal if the adjustment does not find it.")
        return Focal(focal_mm=focal_mm, notes=tuple(notes))
    if sensor and specified_px and abs(focal_px / specified_px - 1) > max_deviation:
        stated = f"focal length {focal_mm:g} mm" if focal_mm else "focal length"
        lens = f", {sensor.focal_mm:g} mm lens" if sensor.focal_mm else ""
        raise JaxbaError(
            f"{stated} gives {focal_px:.0f} px ({_WORDS[source]}), the sensor of {make} {model} ({sensor.width_mm:g} mm"
            f" wide{lens}) says {specified_px:.0f} px: {focal_px / specified_px - 1:+.0%} where {max_deviation:.0%} is "
            "allowed; pass --focal or fix the tag."
        )
    return Focal(focal_px=focal_px, source=source, focal_mm=focal_mm, notes=tuple(notes))


_WORDS = {
    "calibrated": "calibrated",
    "focal_plane": "focal-plane resolution",
    "sensor_table": "sensor table",
    "equivalent_35mm": "35 mm equivalent",
}


def _candidates(
    tags: Tags, sensor: Sensor | None, focal_mm: float | None, specified_px: float | None, notes: list[str]
) -> Iterator[tuple[float, FocalSource]]:
    """Yield focal lengths in pixels by falling precedence; each is worked out only if those before it are missing."""
    for calibrated in (_dji_calibrated, _dji_dewarp, _pix4d_calibrated):
        if focal_px := calibrated(tags, sensor, specified_px, notes):
            yield focal_px, "calibrated"
    if focal_mm and (scale := _focal_plane_pixels_per_mm(tags, sensor, focal_mm, notes)):
        yield focal_mm * scale * _zoom(tags), "focal_plane"
    if focal_mm and sensor:
        yield focal_mm * sensor.pixels_per_mm(tags.width_px, tags.height_px) * _zoom(tags), "sensor_table"
    if focal_px := _equivalent(tags):
        yield focal_px, "equivalent_35mm"


def _specified(tags: Tags, sensor: Sensor | None, focal_mm: float | None) -> float | None:
    """Return the focal length in pixels that the sensor's specification asks for, of the lens's data sheet if fixed."""
    focal_mm = (sensor.focal_mm if sensor else None) or focal_mm
    if sensor is None or focal_mm is None:
        return None
    return focal_mm * sensor.pixels_per_mm(tags.width_px, tags.height_px) * _zoom(tags)


def _scale(tags: Tags, width_px: int | float, height_px: int | float) -> float:
    return scale_of(tags.width_px, tags.height_px, width_px, height_px)


def _zoom(tags: Tags) -> float:
    zoom = tags.number(BASE.DigitalZoomRatio)
    return zoom if zoom and zoom > 1 else 1.0


def _positive(value: float | None) -> float | None:
    return value if value and value > 0 else None


def _dji_calibrated(tags: Tags, sensor: Sensor | None, specified_px: float | None, notes: list[str]) -> float | None:
    focal_px = _positive(tags.xmp_number("drone-dji:CalibratedFocalLength"))
    if not focal_px:
        return None
    center_x, center_y = (_positive(tags.xmp_number(f"drone-dji:CalibratedOpticalCenter{axis}")) for axis in "XY")
    if not center_x or not center_y:
        return _of_unknown_grid(tags, sensor, focal_px, specified_px, "CalibratedFocalLength", notes)
    for width, height in _original_sizes(tags, sensor):
        if abs(2 * center_x / width - 1) < _SAME_SIZE and abs(2 * center_y / height - 1) < _SAME_SIZE:
            return focal_px * _scale(tags, width, height)
    return focal_px * _scale(tags, 2 * center_x, 2 * center_y)


def _dji_dewarp(tags: Tags, sensor: Sensor | None, specified_px: float | None, notes: list[str]) -> float | None:
    """Return fx of DewarpData, `date;fx,fy,cx,cy,k1,k2,p1,p2,k3` with the centre counted from the photo's middle."""
    focal_px = _positive(number(tags.xmp.get("drone-dji:DewarpData", "").rpartition(";")[2].partition(",")[0]))
    return _of_unknown_grid(tags, sensor, focal_px, specified_px, "DewarpData", notes) if focal_px else None


def _original_sizes(tags: Tags, sensor: Sensor | None) -> list[tuple[float, float]]:
    """Return what the photo's original size may have been: as EXIF says, and as the sensor's largest photo."""
    own = (float(sensor.width_px), float(sensor.height_px)) if sensor else None
    return [size for size in (tags.original_size_px, own) if size]


def _of_unknown_grid(
    tags: Tags, sensor: Sensor | None, focal_px: float, specified_px: float | None, label: str, notes: list[str]
) -> float | None:
    """Return a calibrated focal length of some original grid in the stored one.

    The grid is EXIF's; where the sensor is known, EXIF's or the sensor's, whichever suits its specification better.
    """
    scaled = [focal_px * _scale(tags, *size) for size in _original_sizes(tags, sensor)]
    if not scaled:
        notes.append(f"{label} is passed over: nothing tells which pixel grid it belongs to.")
        return None
    return scaled[0] if specified_px is None else min(scaled, key=lambda value: abs(np.log(value / specified_px)))


def _pix4d_calibrated(tags: Tags, sensor: Sensor | None, specified_px: float | None, notes: list[str]) -> float | None:
    """Return PerspectiveFocalLength in pixels; it is in millimetres, as is PrincipalPoint, half the sensor's width."""
    focal = _positive(tags.xmp_number("Camera:PerspectiveFocalLength"))
    if not focal:
        return None
    if tags.xmp.get("Camera:PerspectiveFocalLengthUnits", "mm").lower().startswith("pix"):
        return _of_unknown_grid(tags, sensor, focal, specified_px, "PerspectiveFocalLength", notes)
    if sensor:
        return focal * sensor.pixels_per_mm(tags.width_px, tags.height_px)
    if scale := _focal_plane_pixels_per_mm(tags, sensor, focal, notes):
        return focal * scale
    center = [_positive(number(word)) for word in tags.xmp.get("Camera:PrincipalPoint", "").split(",")]
    if len(center) == 2 and center[0] and center[1]:
        return focal * _scale(tags, 2 * center[0], 2 * center[1])
    notes.append("PerspectiveFocalLength is passed over: nothing tells the sensor's width.")
    return None


def _focal_plane_pixels_per_mm(tags: Tags, sensor: Sensor | None, focal_mm: float, notes: list[str]) -> float | None:
    """Return the stored grid's pixels per millimetre of the focal plane, or None."""
    resolution = _positive(tags.number(BASE.FocalPlaneXResolution))
    unit = tags.number(BASE.FocalPlaneResolutionUnit)
    mm_per_unit = _MM_PER_UNIT.get(int(unit)) if unit is not None else _MM_PER_UNIT[2]
    if resolution is None or mm_per_unit is None:
        return None
    per_mm, original = resolution / mm_per_unit, tags.original_size_px
    stored = float(tags.width_px), float(tags.height_px)
    if sensor:
        own = sensor.width_px, sensor.height_px
        stated = sensor.pixels_per_mm(*(original or own))
        if not _close(per_mm, stated) and _close(per_mm, sensor.pixels_per_mm(*own)):
            size = f"{original[0]:.0f} x {original[1]:.0f}" if original else "nothing"
            notes.append(
                f"EXIF's size says {size}, its focal-plane resolution belongs to the sensor's {own[0]} x {own[1]} "
                "pixels; the latter is used."
            )
            original = own
    if original is None:
        notes.append("the focal-plane resolution is passed over: EXIF does not state the size that it belongs to.")
        return None
    width_mm = max(original) / per_mm
    if sensor is None and not _SENSOR_WIDTHS_MM[0] <= width_mm <= _SENSOR_WIDTHS_MM[1]:
        notes.append(f"the focal-plane resolution is passed over: it means a sensor {width_mm:.2g} mm wide.")
        return None
    scale = per_mm * _scale(tags, *original)
    equivalent = _equivalent(tags)
    was_rewritten = np.allclose(sorted(original), sorted(stored), atol=1)
    if sensor is None and equivalent and was_rewritten and not _close(focal_mm * scale, equivalent):
        notes.append(
            f"the focal-plane resolution is passed over: it gives {focal_mm * scale:.0f} px and the 35 mm equivalent "
            f"{equivalent:.0f} px, as after a resize that rewrote EXIF's size alone."
        )
        return None
    return scale


def _close(value: float, other: float) -> bool:
    return abs(value / other - 1) <= 0.15


def _equivalent(tags: Tags) -> float | None:
    film_mm = _positive(tags.number(BASE.FocalLengthIn35mmFilm))
    if not film_mm:
        return None
    long, short = max(tags.width_px, tags.height_px), min(tags.width_px, tags.height_px)
    return film_mm * float(np.hypot(long, max(short, long / 1.5))) / _FILM_DIAGONAL_MM
