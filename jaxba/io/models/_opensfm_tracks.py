"""OpenSfM's tracks: a row an observation, parted by tabs, in image coordinates of the longer side.

    image  track  feature  x  y  [scale]  r  g  b  [segmentation  instance]

the columns in brackets since versions 1 and 2, which a first line names.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int

from jaxba._errors import JaxbaError
from jaxba.io._read import read_bytes, text_of

_HEADER = "OPENSFM_TRACKS_VERSION_v"
_FARTHEST = 1e6  # longer sides from the middle: no pixel of an image
_COLUMNS = {0: 8, 1: 9, 2: 11}  # by version


@dataclass(frozen=True, eq=False)
class TrackRows:
    """Observations in rows of images and points, with coordinates in longer sides from the middle of the image."""

    image: Int[np.ndarray, " rows"]
    point: Int[np.ndarray, " rows"]
    xy: Float[np.ndarray, "rows 2"]


def read_tracks(path: Path, file: Path, row_of_shot: Mapping[str, int], row_of_point: Mapping[str, int]) -> TrackRows:
    """Return the rows whose image is a shot and whose track is a point, as OpenSfM takes them.

    - `file`: the reconstruction, for messages. `row_of_shot`, `row_of_point`: by name.

    Raises:
        JaxbaError: a row is damaged or stands twice, or points have no row.
    """
    lines = text_of(read_bytes(path), "replace").split("\n")
    version, first = 0, 0
    if lines[0].startswith(_HEADER):
        text, first = lines[0].removeprefix(_HEADER).strip(), 1
        if not text.isdigit() or int(text) not in _COLUMNS:
            raise JaxbaError(f"{path}, line 1: tracks of version {text!r}; jaxba reads 0, 1 and 2: export them again.")
        version = int(text)
    rows: dict[tuple[int, int], tuple[int, float, float]] = {}
    for number, line in enumerate(lines[first:], start=first + 1):
        words = line.rstrip("\r").split("\t")
        if words == [""]:
            continue
        if len(words) != _COLUMNS[version]:
            raise JaxbaError(
                f"{path}, line {number}: {len(words)} fields, where version {version} of the tracks has "
                f"{_COLUMNS[version]}, parted by tabs; copy or export them again."
            )
        image, point = row_of_shot.get(words[0]), row_of_point.get(words[1])
        if image is None or point is None:
            continue
        x, y = _coordinate(path, number, "x", words[3]), _coordinate(path, number, "y", words[4])
        before = rows.setdefault((image, point), (number, x, y))
        if before[0] != number:
            raise JaxbaError(
                f"{path}, line {number}: track {words[1]} has {words[0]} in line {before[0]} already; export it again."
            )
    missing = sorted(set(row_of_point.values()) - {point for _, point in rows})
    if missing:
        names = list(row_of_point)
        raise JaxbaError(
            f"{path}: no row of point {names[missing[0]]} in the shots of {file.name} ({len(missing):,} of "
            f"{len(names):,} points have none): it was not made from these tracks. Give the two of one run."
        )
    pairs = np.array(sorted(rows), dtype=np.int64).reshape(-1, 2)
    xy = np.array([rows[image, point][1:] for image, point in pairs.tolist()], float).reshape(-1, 2)
    return TrackRows(pairs[:, 0], pairs[:, 1], xy)


def _coordinate(path: Path, number: int, name: str, word: str) -> float:
    try:
        value = float(word)
    except ValueError:
        value = math.nan
    if not abs(value) < _FARTHEST:
        raise JaxbaError(f"{path}, line {number}: {name} is {word!r}, no image coordinate; correct or delete the line.")
    return value
