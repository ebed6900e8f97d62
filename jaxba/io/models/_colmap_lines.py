"""Lines of COLMAP's text files, their numbers, and errors that name file and line."""

import math
from collections.abc import Iterator, Sequence
from pathlib import Path

from jaxba._errors import JaxbaError
from jaxba.io._read import read_bytes, text_of


def content_lines(path: Path, *, keep_blank: bool = False) -> Iterator[tuple[str, str]]:
    """Yield place and text of each line that is no comment, and not blank unless those are kept."""
    text = text_of(read_bytes(path), "replace")
    for number, line in enumerate(text.splitlines(), start=1):
        if not line.startswith("#") and (keep_blank or line.strip()):
            yield f"{path}, line {number}", line.strip()


def comment_lines(path: Path) -> Iterator[tuple[str, str]]:
    """Yield place and text of each line of the comment that the file begins with."""
    for number, line in enumerate(text_of(read_bytes(path), "replace").splitlines(), start=1):
        if not line.startswith("#"):
            return
        yield f"{path}, line {number}", line.strip()


def finite(words: Sequence[str]) -> list[float]:
    """Return finite numbers; raises `ValueError` for others."""
    numbers = [float(word) for word in words]
    bad = next((word for word, number in zip(words, numbers, strict=True) if not math.isfinite(number)), None)
    if bad is not None:
        raise ValueError(f"{bad} is not a finite number")
    return numbers


def unit(quaternion: Sequence[float]) -> list[float]:
    """Return a quaternion that is not zero as one of unit length, however long or short it is."""
    largest = max(map(abs, quaternion))
    scaled = [value / largest for value in quaternion]
    return [value / math.hypot(*scaled) for value in scaled]


def claim(places: dict[int, str], number: int, place: str, kind: str) -> None:
    """Note where an id stands; raises `JaxbaError` where it stands in two places."""
    before = places.setdefault(number, place)
    if before != place:
        raise JaxbaError(f"{place}: {kind} {number} is in {before} already; export the model again.")


class Damage:
    """Turns what goes wrong with a line into an error that names it; one may serve a loop, its `place` set by line."""

    def __init__(self, place: str) -> None:
        self.place = place

    def __enter__(self) -> "Damage":
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, _: object) -> None:
        if isinstance(error, ValueError | IndexError | OverflowError):
            raise JaxbaError(f"{self.place}: damaged ({error}); export the model again as text.") from error
