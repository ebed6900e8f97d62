"""What stands in the cells of a list: numbers, heights that are none, and names of photos with blanks in them.

Messages name the file, the line, the field and its value.
"""

import math
import re
from collections.abc import Callable, Sequence

from jaxba._errors import JaxbaError

NOT_KNOWN = (
    "", "nan", "+nan", "-nan", "na", "n/a", "#n/a", "null", "none", "nil", "nodata", "no data", "-", "--", "inf",
    "+inf", "-inf", "1.#qnan", "-1.#ind", "1.#inf",
)  # fmt: skip
"""Words of lists for a number that was not measured, in lower case; OpenDroneMap's for a height is NaN."""

HEIGHTS = (-2000.0, 100_000.0)
"""Heights on earth, on the ground or in the air, in metres or feet: what lies beyond is a word such as -9999."""
FILLERS = (0.0, -99.0, -999.0, 999.0, 9999.0, 99999.0)
"""Numbers in that range that stand for no height where no other height is near."""
_FAR, _NEAR, _SPREADS = 10.0, 1.0, 3.0
_LARGEST = 1e12

_IMAGE = re.compile(r"\.(jpe?g|jpe|jp2|tiff?|png|bmp|webp|dng|heic|heif|arw|cr2|cr3|nef|raf|rw2|orf)$", re.IGNORECASE)
_ANGLE = re.compile(r"\d\s*[°º'\"\u2032\u2033\u2019\u201dNSEW]", re.IGNORECASE)
_QUOTED = re.compile(r"""(["'])(.+?)\1(?=\s|$)""")


def read_number(text: str, where: str, label: str) -> float:
    """Return a finite number, of a size that places, pixels, angles and sigmas can have."""
    value = _finite(text, where, label)
    if abs(value) > _LARGEST:
        raise JaxbaError(f"{where}: {label} '{text}' is too large for a place, a pixel or a sigma; correct it.")
    return value


def read_if_known(text: str, where: str, label: str) -> float | None:
    """Return such a number; None where the text is empty or a word such as NaN."""
    return None if text.strip().lower() in NOT_KNOWN else read_number(text, where, label)


def read_height(text: str, where: str) -> float | None:
    """Return a finite number, which `without_fillers` judges; None where the text is empty or a word such as NaN."""
    return None if text.strip().lower() in NOT_KNOWN else _finite(text, where, "z")


def _finite(text: str, where: str, label: str) -> float:
    value = number_or_nan(text)
    if not math.isfinite(value):
        form = "with a point, without unit or thousands marks"
        if label in ("x", "y", "longitude", "latitude") and _ANGLE.search(text):
            form = "in degrees with decimals, south and west negative"
        raise JaxbaError(f"{where}: {label} '{text}' is no number; write it {form}.")
    return value


def number_or_nan(text: str) -> float:
    """Return the number that a text is, NaN where it is none."""
    try:
        return float("nan" if "_" in text else text)  # Python's 1_000
    except ValueError:
        return math.nan


def without_fillers(
    z: Sequence[float | None],
    labels: Sequence[str],
    name: str,
    *,
    kind: str,
    so: str = "",
    cure: str = "",
    keep_zeros: bool = False,
) -> tuple[list[float | None], list[str]]:
    """Return the heights that were measured, None for the others, and notes that count and name those.

    No height is: NaN or an empty cell; what is none on earth (`HEIGHTS`), such as -9999; and a number of `FILLERS`, 0
    among them, that lies apart from all other heights of the list, by more than 10 or by more than 1 and three times
    their range. A list in which all heights are 0 was written without heights.

    - `labels`: whose heights these are. `name`: of the list. `kind`: what they are called, `point` or `photo`.
    - `so`: what follows for them. `cure`: what to do where a height of 0 is right. `keep_zeros`: 0 is a height like any
      other.

    >>> z = [248.1, None, 252.3, -9999.0, 0.0, 247.5]
    >>> without_fillers(z, list("abcdef"), "gcp_list.txt", kind="point")[0]
    [248.1, None, 252.3, None, None, 247.5]
    """
    low, high = HEIGHTS
    fillers = FILLERS[1:] if keep_zeros else FILLERS
    sure = [value for value in z if value is not None and low <= value <= high and value not in fillers]
    reasons: dict[str, list[str]] = {}
    result: list[float | None] = []
    zeros = []
    for value, label in zip(z, labels, strict=True):
        reason = ""
        if value is None:
            reason = "NaN or empty"
        elif not low <= value <= high:
            reason = f"{value:.10g}"
        elif value in fillers and sure and _is_apart(value, sure):
            reason = f"{value:g} where the others are {min(sure):g} to {max(sure):g}"
        elif value in fillers and not sure and value:
            reason = f"{value:g}"
        elif value == 0 and not keep_zeros:
            zeros.append(label)
        if reason:
            reasons.setdefault(reason, []).append(label)
        result.append(None if reason else value)
    notes = []
    if reasons:
        count = sum(map(len, reasons.values()))
        listed = "; ".join(f"{why}: {some(found)}" for why, found in reasons.items())
        has = "has" if count == 1 else "have"
        zero = cure if any(reason.startswith("0 where") for reason in reasons) else ""
        notes.append(f"{name}: {count} of {len(z)} {kind}s {has} no height ({listed}){so}.{zero}")
    if zeros and sure:
        notes.append(
            f"{name}: the height 0 of {some(zeros)} is used, since others are near it ({min(sure):g} to "
            f"{max(sure):g}); write NaN where none was measured."
        )
    elif zeros:
        notes.append(f"{name}: all heights are 0, as in a list without heights: they are taken as not measured.{cure}")
        result = [None] * len(result)
    return result, notes


def _is_apart(value: float, others: Sequence[float]) -> bool:
    """Whether a number lies farther from other heights than their spread explains."""
    gap = min(abs(value - other) for other in others)
    spread = max(others) - min(others) if len(others) > 1 else math.inf
    return gap > min(_FAR, max(_NEAR, _SPREADS * spread))


def split_image(text: str, is_photo: Callable[[str], bool]) -> tuple[str, str]:
    """Return the photo's name that a text begins with, and what follows it, with the separator.

    It is in quotes, or ends at a tab, or is the longest beginning that is a photo's name, or the shortest that ends as
    an image's, such as `.jpg`; else it ends at the first blank.

    >>> split_image("DJI 3 (2).JPG gcp01", lambda name: False), split_image("'a b' c", lambda name: False)
    (('DJI 3 (2).JPG', ' gcp01'), ('a b', ' c'))
    """
    if quoted := _QUOTED.match(text):
        return quoted[2], text[quoted.end() :]
    cell, tab, rest = text.partition("\t")
    if tab and (_IMAGE.search(cell.rstrip()) or is_photo(cell)):
        return cell.rstrip(), tab + rest
    ends = [match.start() for match in re.finditer(r"\s+", text)] + [len(text)]
    for end in reversed(ends):
        if is_photo(text[:end]):
            return text[:end], text[end:]
    first = ends[0] if not tab else len(cell.rstrip())
    end = next((end for end in ends if _IMAGE.search(text[:end])), first)
    return text[:end], text[end:]


def has_image_suffix(name: str) -> bool:
    """Whether a name ends as an image's file does."""
    return _IMAGE.search(name) is not None


def no_photos(name: str) -> bool:
    """Return that a name is none of the photos, where these are not known."""
    return False


def some(names: Sequence[str], most: int = 10) -> str:
    """Return the names, or the first ones and how many more there are."""
    return ", ".join(names[:most]) + (f" and {len(names) - most} more" if len(names) > most else "")
