"""Tags of a photo: EXIF and XMP as plain values, read from the header alone.

Files in the field have broken tags: segments cut short, ratios with a zero denominator, texts padded with zeros. A
value that cannot be read counts as absent, what is broken is said in `problems`, and the photo stays.
"""

import math
import warnings
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from PIL import ExifTags, Image, UnidentifiedImageError

from jaxba._errors import JaxbaError
from jaxba.vision._xmp import BrokenXmp, parse_xmp

BASE, GPS = ExifTags.Base, ExifTags.GPS
_XMP_IN_TIFF = 700


@dataclass(frozen=True, kw_only=True)
class Tags:
    """What a file's header says.

    - `width_px`, `height_px`: of the stored pixel grid. `exif`: the main and the EXIF directory by tag number.
    - `gps`: the GPS directory. `xmp`: by prefixed name. `problems`: what is broken, in sentences.
    """

    width_px: int
    height_px: int
    exif: Mapping[int, Any]
    gps: Mapping[int, Any]
    xmp: Mapping[str, str]
    problems: tuple[str, ...] = ()

    def number(self, tag: int) -> float | None:
        """Return a finite number of the EXIF directories, or None."""
        return number(self.exif.get(tag))

    def text(self, tag: int) -> str:
        """Return a text of the EXIF directories, empty where there is none."""
        return text(self.exif.get(tag))

    def xmp_number(self, *names: str) -> float | None:
        """Return the first of these XMP values that is a finite number, or None."""
        found = (number(self.xmp.get(name)) for name in names)
        return next((value for value in found if value is not None), None)

    def drone_number(self, *names: str) -> float | None:
        """Return the first of these XMP values that is a finite number, under whichever maker's prefix, or None."""
        return self.xmp_number(*drone_names(*names))

    @property
    def original_size_px(self) -> tuple[float, float] | None:
        """Width and height that EXIF states, which a resize may have left stale."""
        width, height = self.number(BASE.ExifImageWidth), self.number(BASE.ExifImageHeight)
        return (width, height) if width and height and width > 0 and height > 0 else None


def read_tags(path: Path) -> Tags:
    """Return the tags of an image file; no pixel is decoded.

    Raises `JaxbaError` for a file that is missing, no image, or larger than can be decoded.
    """
    problems: list[str] = []
    try:
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            with Image.open(path) as image:
                width, height = image.size
                base, exif, gps = _directories(image, problems)
                packet = _packet(image, base)
    except FileNotFoundError:
        raise JaxbaError(f"{path} does not exist; restore the photo or take it off the list.") from None
    except UnidentifiedImageError:
        raise JaxbaError(
            f"{path} is no image that can be read ({_beginning(path)}); copy it again or remove it."
        ) from None
    except Image.DecompressionBombError as error:
        raise JaxbaError(f"{path} is too large to decode ({error}); scale it down or cut it into parts.") from None
    except MemoryError:
        raise
    except Exception as error:  # Pillow raises whatever the damaged bytes lead to
        raise JaxbaError(f"{path}: its header cannot be read ({error}); copy it again or remove it.") from None
    for warning in caught:
        if not issubclass(warning.category, Image.DecompressionBombWarning | ResourceWarning):
            problems.append(f"tags are damaged ({' '.join(str(warning.message).split())}); what can be read is used.")
    xmp: dict[str, str] = {}
    if packet:
        try:
            xmp = parse_xmp(packet)
        except BrokenXmp as error:
            xmp = error.found
            problems.append(f"XMP is damaged ({error}); {len(xmp)} values found by text search are used.")
    return Tags(
        width_px=width,
        height_px=height,
        exif={**base, **exif},
        gps=gps,
        xmp=xmp,
        problems=tuple(dict.fromkeys(problems)),
    )


def image_size(path: Path) -> tuple[int, int]:
    """Return width and height of an image file in pixels; raises `JaxbaError` as `read_tags`."""
    tags = read_tags(path)
    return tags.width_px, tags.height_px


def drone_names(*names: str) -> tuple[str, ...]:
    """Return names with the prefix of each maker of drones; Autel writes DJI's names under `drone`."""
    return tuple(f"{drone}:{name}" for name in names for drone in ("drone-dji", "drone", "drone-parrot"))


def number(value: Any) -> float | None:
    """Return a finite float of a tag's value (number, ratio, `+12.5`, `3/4`, one-element tuple or byte), or None.

    >>> number("+39.80"), number("1/4"), number("n/a"), number(float("nan"))
    (39.8, 0.25, None, None)
    """
    value = value[0] if isinstance(value, tuple) and len(value) == 1 else value
    if isinstance(value, bytes):
        value = value[0] if len(value) == 1 else value.decode("latin-1")
    try:
        if isinstance(value, str):
            top, _, bottom = value.strip(" \x00").partition("/")
            result = float(top) / (float(bottom) if bottom else 1.0)
        else:
            result = float(value)  # pyright: ignore[reportArgumentType]
    except (TypeError, ValueError, ZeroDivisionError, OverflowError):
        return None
    return result if math.isfinite(result) else None


def text(value: Any) -> str:
    """Return a tag's text without padding; empty for what is none."""
    if isinstance(value, bytes):
        value = value.decode("utf-8", "replace")
    return " ".join(value.replace("\x00", " ").split()) if isinstance(value, str) else ""


def _directories(image: Image.Image, problems: list[str]) -> tuple[dict[int, Any], dict[int, Any], dict[int, Any]]:
    found: list[dict[int, Any]] = []
    try:
        tags = image.getexif()
        found.append(dict(tags))
    except Exception as error:  # Pillow raises whatever the damaged bytes lead to
        problems.append(f"EXIF cannot be read ({type(error).__name__}: {error}).")
        return {}, {}, {}
    for ifd in (ExifTags.IFD.Exif, ExifTags.IFD.GPSInfo):
        try:
            found.append(dict(tags.get_ifd(ifd)))
        except Exception as error:  # as above
            problems.append(f"EXIF's {ifd.name} directory cannot be read ({type(error).__name__}: {error}).")
            found.append({})
    if image.info.get("exif") and not any(found):
        problems.append("EXIF is present but holds nothing that can be read.")
    return found[0], found[1], found[2]


def _packet(image: Image.Image, base: Mapping[int, Any]) -> bytes:
    value = image.info.get("xmp") or image.info.get("XML:com.adobe.xmp") or base.get(_XMP_IN_TIFF) or b""
    if isinstance(value, str):
        return value.encode()
    return bytes(value) if isinstance(value, bytes | bytearray | tuple) else b""


def _beginning(path: Path) -> str:
    size = path.stat().st_size
    return f"{size} bytes" if size else "it is empty"
