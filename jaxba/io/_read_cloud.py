"""Clouds from the files that jaxba writes: CSV, PLY and LAZ, each held against the columns that it must have.

Numbers are taken as they stand, NaN too: what they mean is for the caller to judge.
"""

import csv
import io
import os
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from jaxba._errors import JaxbaError
from jaxba.io._cloud import STD_COLUMNS, Cloud
from jaxba.io._csv_cloud import CLOUD_COLUMNS
from jaxba.io._ply import PLY_TYPES, VERTEX
from jaxba.io._read import read_bytes, text_of

_FORMAT = b"ply\nformat binary_little_endian 1.0\n"
_END = b"end_header\n"
_LAS_FORMAT = (1, 4, 7)
_LAS_EXTRA = ("error_px", "track_length", "point_id", *STD_COLUMNS)
_COLOURS = {"R": "red", "G": "green", "B": "blue"}
_CURE = "it was changed or damaged; export it again"


@dataclass(frozen=True, kw_only=True, eq=False)
class CloudFile:
    """- `cloud`: as it was written. `crs`: a code or WKT, as the file says; empty: none."""

    cloud: Cloud
    crs: str


def read_csv_cloud(path: str | os.PathLike[str]) -> CloudFile:
    """Return the cloud that `write_csv_cloud` wrote.

    Raises:
        JaxbaError: a column is missing or not known, a row is damaged, or rows have codes of several CRSs.
    """
    label = os.fspath(path)
    lines = csv.reader(text_of(read_bytes(path), "replace").splitlines(), quoting=csv.QUOTE_NONE)
    try:
        header, *cells = lines
    except csv.Error as error:
        raise JaxbaError(f"{label}, line {lines.line_num}: {error}; {_CURE}.") from error
    _expect_columns(label, header, tuple(CLOUD_COLUMNS))
    for number, row in enumerate(cells, 2):
        if len(row) != len(CLOUD_COLUMNS):
            raise JaxbaError(f"{label}, line {number}: {len(row)} values in {len(CLOUD_COLUMNS)} columns; {_CURE}.")
    columns = (
        dict(zip(CLOUD_COLUMNS, zip(*cells, strict=True), strict=True))
        if cells
        else {name: () for name in CLOUD_COLUMNS}
    )
    codes = sorted(set(columns.pop("EPSG")))
    if len(codes) > 1:
        raise JaxbaError(f"{label}: column EPSG holds several codes, {', '.join(codes[:3])}; {_CURE}.")
    numbers = {name: _numbers(label, name, texts) for name, texts in columns.items()}
    return CloudFile(cloud=_cloud(label, numbers), crs=f"EPSG:{codes[0]}" if codes and codes[0] else "")


def read_ply(path: str | os.PathLike[str]) -> CloudFile:
    """Return the cloud that `write_ply` wrote; its CRS is a comment for people, and not returned.

    Raises:
        JaxbaError: another kind of PLY, a property that is missing or not known, or a file that is cut off.
    """
    label, data = os.fspath(path), read_bytes(path)
    header, end, body = data.partition(_END)
    if not data.startswith(_FORMAT) or not end:
        raise JaxbaError(f"{label}: does not begin as a binary PLY of jaxba does; {_CURE}.")
    lines = header.decode("ascii", "replace").splitlines()
    properties = [line.split()[1:] for line in lines if line.startswith("property ")]
    odd = next((words for words in properties if len(words) != 2), None)
    if odd is not None:
        raise JaxbaError(f"{label}: property '{' '.join(odd)}' is no type and name; {_CURE}.")
    _expect_columns(label, [name for _, name in properties], VERTEX.names or ())
    for kind, name in properties:
        expected = PLY_TYPES[VERTEX[name].str]
        if kind != expected:
            raise JaxbaError(f"{label}: property {name} is {kind}, not {expected}; {_CURE}.")
    counts = [line.split()[-1] for line in lines if line.startswith("element vertex ")]
    if len(counts) != 1 or not counts[0].isdigit() or len(body) != int(counts[0]) * VERTEX.itemsize:
        said = ", ".join(counts) or "no number of"
        raise JaxbaError(f"{label}: holds {len(body) / VERTEX.itemsize:g} points, its header says {said}; {_CURE}.")
    vertices = np.frombuffer(body, VERTEX)
    numbers = {name: vertices[name].astype(float) for name in VERTEX.names or ()}
    for name, ply_name in {**_COLOURS, "X": "x", "Y": "y", "Z": "z", "PointID": "point_id"}.items():
        numbers[name] = numbers.pop(ply_name)
    return CloudFile(cloud=_cloud(label, numbers), crs="")


def read_las(path: str | os.PathLike[str]) -> CloudFile:
    """Return the cloud that `write_las` wrote, LAS or LAZ.

    Raises:
        JaxbaError: another version or point format, a dimension that is missing, or a damaged file.
    """
    import laspy
    from laspy.errors import LaspyException

    label = os.fspath(path)
    try:
        las = laspy.read(io.BytesIO(read_bytes(path)))
        crs = las.header.parse_crs()
    except (LaspyException, RuntimeError, ValueError) as error:  # RuntimeError: of the decompressor
        raise JaxbaError(f"{label}: cannot be read as LAS ({error}); {_CURE}.") from error
    version = las.header.version.major, las.header.version.minor, las.header.point_format.id
    if version != _LAS_FORMAT:
        found, wanted = ("LAS {}.{} with point format {}".format(*numbers) for numbers in (version, _LAS_FORMAT))
        raise JaxbaError(f"{label}: is {found}, not {wanted}; {_CURE}.")
    _expect_columns(label, list(las.point_format.extra_dimension_names), _LAS_EXTRA, "extra dimension")
    numbers = {name: np.asarray(las[name.lower()], float) for name in ("X", "Y", "Z")}
    numbers |= {name: np.asarray(las[field], float) / 257 for name, field in _COLOURS.items()}
    numbers |= {name: np.asarray(las[name], float) for name in _LAS_EXTRA}
    numbers["PointID"] = numbers.pop("point_id")
    return CloudFile(cloud=_cloud(label, numbers), crs="" if crs is None else crs.to_wkt())


def _expect_columns(label: str, found: Sequence[str], expected: Sequence[str], kind: str = "column") -> None:
    missing = [name for name in expected if name not in found]
    unknown = [name for name in found if name not in expected]
    for names, what in ((missing, "is missing"), (unknown, "is not known")):
        if names:
            raise JaxbaError(
                f"{label}: {kind} {', '.join(names)} {what}; expected are {', '.join(expected)}. Export it again."
            )
    if list(found) != list(expected):
        raise JaxbaError(f"{label}: {kind}s are {', '.join(found)}, in place of {', '.join(expected)}; {_CURE}.")


def _numbers(label: str, name: str, texts: Sequence[str]) -> np.ndarray:
    """Return a column as numbers; an empty sigma is one that was not computed."""
    may_be_empty = name.startswith("std_")
    try:
        return np.array([np.nan if may_be_empty and not text else float(text) for text in texts])
    except ValueError as error:
        raise JaxbaError(f"{label}: column {name}: {error}; {_CURE}.") from error


def _cloud(label: str, numbers: dict[str, np.ndarray]) -> Cloud:
    """Return the cloud of columns named as those of the CSV; whole numbers are checked to be some."""
    whole = {}
    if not len(numbers["X"]):
        raise JaxbaError(f"{label}: holds no point; {_CURE}.")
    for name, most in (("PointID", 2**32), ("track_length", 2**32), ("R", 255), ("G", 255), ("B", 255)):
        values = numbers[name]
        with np.errstate(invalid="ignore"):
            bad = np.flatnonzero(~((values >= 0) & (values <= most) & (values == np.round(values))))
        if bad.size:
            raise JaxbaError(
                f"{label}: {name} of point {bad[0] + 1} is {values[bad[0]]:g}, not a whole number from 0 to {most}; "
                f"{_CURE}."
            )
        whole[name] = values.astype(np.int64)
    stds = [numbers[name] for name in STD_COLUMNS]
    return Cloud(
        xyz=np.stack([numbers[axis] for axis in "XYZ"], axis=1),
        rgb=np.stack([whole[colour] for colour in "RGB"], axis=1).astype(np.uint8),
        point_id=whole["PointID"],
        track_length=whole["track_length"],
        error_px=numbers["error_px"],
        std_m=np.stack(stds, axis=1),
    )
