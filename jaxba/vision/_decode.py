"""Decode a photo to 8-bit pixels on its stored grid; what is cut short or unreadable is an error that names the file.

Pillow decodes, since it raises on a file that ends too early, where OpenCV prints a line and returns grey rows. Both
take 6 ms for a JPEG of 1600 x 1067 pixels, so nothing is decoded twice. OpenCV reads TIFF, for its bands of 16 bits.
EXIF's orientation is never applied.
"""

import warnings
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import UInt8

from jaxba._errors import JaxbaError
from jaxba.scene import lacks_memory

_TIFF = (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+")  # the last two for files over 4 GB

_JPEG, _BLACK_IN_JPEG = b"\xff\xd8", 16


@dataclass(frozen=True, kw_only=True, eq=False)
class Pixels:
    """An image as 8-bit values: `gray` for detection, `rgb` for colours."""

    gray: UInt8[np.ndarray, "height width"]
    rgb: UInt8[np.ndarray, "height width 3"]


def decode(path: Path) -> Pixels:
    """Return the pixels of an image file.

    Bands of more than 8 bits, and of floats, are stretched between their 0.1 and 99.9 percentiles, which belong to the
    whole image and not to a band. Raises `JaxbaError` for a file that is missing, cut short, damaged or of an unknown
    format.
    """
    import cv2

    values = _read(path)
    if values.dtype != np.uint8:
        values = _stretch(values)
    rgb = values if values.ndim == 3 else np.repeat(values[:, :, None], 3, axis=2)
    gray = cv2.cvtColor(values, cv2.COLOR_RGB2GRAY) if values.ndim == 3 else values
    return Pixels(gray=np.ascontiguousarray(gray), rgb=np.ascontiguousarray(rgb))


def read_mask(path: Path, width_px: int, height_px: int) -> UInt8[np.ndarray, "height width"]:
    """Return a mask on the grid of its photo: 255 where features may be taken, 0 where it is black.

    JPEG blurs edges, so that there values under 16 of 255 are black. Raises `JaxbaError` as `decode` does.
    """
    import cv2

    values = _read(path)
    values = values if values.ndim == 2 else values.max(axis=2)
    with path.open("rb") as file:
        is_jpeg = file.read(2) == _JPEG
    mask = np.where(values >= _BLACK_IN_JPEG if is_jpeg else values > 0, np.uint8(255), np.uint8(0))
    if mask.shape != (height_px, width_px):
        mask = cv2.resize(mask, (width_px, height_px), interpolation=cv2.INTER_NEAREST)
    return np.ascontiguousarray(mask)


def _read(path: Path) -> np.ndarray:
    """Return the values of an image file as they are, (height, width) or (height, width, 3); raises as `decode`."""
    from PIL import Image

    try:
        with path.open("rb") as file:
            is_tiff = file.read(4) in _TIFF
        return _read_tiff(path) if is_tiff else _read_with_pillow(path)
    except FileNotFoundError:
        raise JaxbaError(f"{path} does not exist; restore the photo or take it off the list.") from None
    except Image.DecompressionBombError as error:
        raise JaxbaError(f"{path} is too large to decode ({error}); scale it down or cut it into parts.") from None
    except JaxbaError:
        raise
    except Exception as error:  # Pillow and OpenCV raise whatever the damaged bytes lead to
        if lacks_memory(error) and not isinstance(error, OSError):
            raise
        raise JaxbaError(f"{path} cannot be decoded ({error}); copy it from the card again, or remove it.") from None


def _read_with_pillow(path: Path) -> np.ndarray:
    """Return the values of an image file, (height, width) or (height, width, 3)."""
    from PIL import Image

    with warnings.catch_warnings():
        warnings.simplefilter("ignore", Image.DecompressionBombWarning)  # aerial cameras have 100 MP and more
        with Image.open(path) as image:
            deep_or_gray = image.mode == "L" or image.mode.startswith(("I", "F"))
            return np.asarray(image if deep_or_gray else image.convert("RGB"))


def _read_tiff(path: Path) -> np.ndarray:
    """Return the values of a TIFF of any depth, (height, width) or (height, width, 3)."""
    import cv2

    flags = cv2.IMREAD_ANYDEPTH | cv2.IMREAD_ANYCOLOR | cv2.IMREAD_IGNORE_ORIENTATION
    values = cv2.imread(str(path), flags)
    if values is None:
        raise JaxbaError(
            f"{path} cannot be decoded: it is damaged, or no TIFF of 1, 3 or 4 bands; "
            "copy it from the card again, export it as RGB, or remove it."
        )
    return values if values.ndim == 2 else values[:, :, 2::-1]


def _stretch(values: np.ndarray) -> UInt8[np.ndarray, "..."]:
    """Return values of any type and range as 8-bit ones; noise in a black frame stays below a gray level."""
    finite = np.isfinite(values)
    if not finite.any():
        return np.zeros(values.shape, np.uint8)
    low, high = np.percentile(values[finite], [0.1, 99.9])
    span = max(high - low, 255.0 if values.dtype.kind in "iu" else np.finfo(np.float32).tiny)
    scaled = (np.where(finite, values, low).astype(np.float64) - low) * (255.0 / span)
    return np.clip(np.rint(scaled), 0, 255).astype(np.uint8)
