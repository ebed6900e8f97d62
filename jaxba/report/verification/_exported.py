"""The exports as they lie on the disk, read anew and held against the form that each file must have."""

import csv
import dataclasses
import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from jaxba._errors import JaxbaError
from jaxba.report.verification._check import Check, failed, ok
from jaxba.scene import LocalFrame

CLOUDS = ("cloud.csv", "cloud.ply", "cloud.laz")
SITES = ("cameras.gpkg", "cameras.geojson")
DESCRIPTION, FRAME, TEXT, BINARY = "cloud.csv.json", "colmap/frame.json", "colmap/text", "colmap/binary"
OPENSFM, TILE, CONTROL = "reconstruction.json", "tile.npz", "control.csv"
_WORDS_OF_CONTROL = ("name", "role", "suspect", "reason")  # the other columns hold numbers
_DESCRIBED = ("points", "EPSG", "code", "crs", "unit", "height_unit", "heights", "columns", "wkt")
_CURE = "it was changed or damaged: run again to export it anew"


@dataclass(frozen=True, kw_only=True, eq=False)
class Binary:
    """What the head of each file of COLMAP's binary model says: how many there are."""

    num_cameras: int
    num_images: int
    num_points: int


@dataclass(frozen=True, kw_only=True, eq=False)
class Exported:
    """- `contents`: of every file or folder that could be read, by its name; of another type each, see `_READERS`."""

    folder: Path
    contents: dict[str, Any]

    def has(self, *names: str) -> bool:
        return all(name in self.contents for name in names)

    def __getitem__(self, name: str) -> Any:
        return self.contents[name]

    @property
    def frame(self) -> LocalFrame | None:
        """The local frame as `frame.json` has it; None where the block has no place on earth, or it is missing."""
        return self.contents.get(FRAME)


def read_export(folder: Path, files: Sequence[str]) -> tuple[Exported, list[Check]]:
    """Return what could be read of the files that were written, and a check of the form of each that is there."""
    contents: dict[str, Any] = {}
    checks = []
    for name, (read, figure) in _READERS.items():
        written = [file for file in files if file == name or file.startswith(f"{name}/")]
        if not written or not all((folder / file).is_file() for file in written):
            continue  # not written, or missing: said by the check of files
        try:
            contents[name] = read(folder / name)
        except JaxbaError as error:
            checks.append(failed(f"schema {name}", str(error).removeprefix(f"{folder}/")))
        else:
            checks.append(ok(f"schema {name}", figure(contents[name])))
    return Exported(folder=folder, contents=contents), checks


def _clouds(name: str) -> Callable[[Path], Any]:
    def read(path: Path) -> Any:
        from jaxba.io import _read_cloud

        return getattr(_read_cloud, name)(path)

    return read


def _sites(path: Path) -> Any:
    from jaxba.io._read_sites import read_sites

    return read_sites(path)


def _num_columns(table: str) -> int:
    """Return how many columns a table of `jaxba.io` describes."""
    from jaxba import io

    return len(getattr(io, table))


def _model(folder: Path) -> Any:
    from jaxba.io import read_colmap_text

    return read_colmap_text(folder)


def _tile(path: Path) -> Any:
    from jaxba.io import read_tile

    return read_tile(path)


def _binary(folder: Path) -> Binary:
    counts = []
    for name in ("cameras", "images", "points3D"):
        head = (folder / f"{name}.bin").read_bytes()[:8]
        if len(head) < 8:
            raise JaxbaError(f"{folder / name}.bin: is cut off after {len(head)} bytes; {_CURE}.")
        counts.append(int(np.frombuffer(head, "<u8")[0]))
    return Binary(num_cameras=counts[0], num_images=counts[1], num_points=counts[2])


def _json(path: Path) -> Any:
    try:
        return json.loads(path.read_text(encoding="utf-8-sig"))
    except (OSError, ValueError) as error:
        raise JaxbaError(f"{path}: is no JSON ({error}); {_CURE}.") from error


def _expect_keys(path: Path, found: Any, expected: Sequence[str], place: str) -> None:
    if not isinstance(found, dict):
        raise JaxbaError(f"{path}: {place} is no object with names; {_CURE}.")
    for names, what in (
        ([key for key in expected if key not in found], "is missing"),
        ([key for key in found if key not in expected], "is not known"),
    ):
        if names:
            raise JaxbaError(f"{path}: {place} {', '.join(names)} {what}; {_CURE}.")


def _description(path: Path) -> dict[str, Any]:
    from jaxba.io import CLOUD_COLUMNS

    content = _json(path)
    _expect_keys(path, content, _DESCRIBED, "field")
    _expect_keys(path, content["columns"], tuple(CLOUD_COLUMNS), "column")
    if type(content["points"]) is not int:
        raise JaxbaError(f"{path}: field points is {content['points']!r}, not a whole number; {_CURE}.")
    return content


def _frame(path: Path) -> LocalFrame | None:
    content = _json(path)
    names = [field.name for field in dataclasses.fields(LocalFrame)]
    if not isinstance(content, dict) or "origin" not in content:
        _expect_keys(path, content, ("world",), "field")
        return None
    _expect_keys(path, content, ("world", "origin"), "field")
    _expect_keys(path, content["origin"], names, "field of the origin")
    return LocalFrame(**content["origin"])


def _opensfm(path: Path) -> dict[str, Any]:
    content = _json(path)
    if not isinstance(content, list) or len(content) != 1 or not isinstance(content[0], dict):
        raise JaxbaError(f"{path}: is no list of one reconstruction; {_CURE}.")
    parts = content[0]
    extra = ("reference_lla",) if "reference_lla" in parts else ()
    _expect_keys(path, parts, ("cameras", "shots", "points", *extra), "field")
    for name, shot in parts["shots"].items():
        if len(shot.get("rotation", ())) != 3 or len(shot.get("translation", ())) != 3:
            raise JaxbaError(f"{path}: shot {name} has no rotation and translation of three numbers each; {_CURE}.")
        if shot.get("camera") not in parts["cameras"]:
            raise JaxbaError(f"{path}: shot {name} has camera {shot.get('camera')!r}, which cameras lacks; {_CURE}.")
    for key, point in parts["points"].items():
        if len(point.get("coordinates", ())) != 3:
            raise JaxbaError(f"{path}: point {key} has no three coordinates; {_CURE}.")
    return parts


def _control(path: Path) -> list[dict[str, str]]:
    """Return the rows of the surveyed points; a cell is a number, or empty where nothing is known."""
    from jaxba.io import CONTROL_COLUMNS

    with open(path, encoding="utf-8-sig", newline="") as file:
        header, *rows = list(csv.reader(file)) or [[]]
    _expect_keys(path, dict.fromkeys(header), tuple(CONTROL_COLUMNS), "column")
    table = []
    for number, row in enumerate(rows, 2):
        if len(row) != len(header):
            raise JaxbaError(f"{path}, line {number}: {len(row)} values in {len(header)} columns; {_CURE}.")
        cells = dict(zip(header, row, strict=True))
        if cells["role"] not in ("control", "check"):
            raise JaxbaError(f"{path}, line {number}: role is {cells['role']!r}, not control or check; {_CURE}.")
        for name, text in cells.items():
            if name not in _WORDS_OF_CONTROL:
                _number(path, number, name, text)
        table.append(cells)
    return table


def _number(path: Path, line: int, column: str, text: str) -> None:
    must = column in ("marks", "surveyed_x", "surveyed_y")
    try:
        is_good = not (must and not text) and (not text or bool(np.isfinite(float(text))))
    except ValueError:
        is_good = False
    if not is_good:
        raise JaxbaError(f"{path}, line {line}: {column} is {text!r}, which is no finite number; {_CURE}.")


def _cloud_figure(columns: str) -> Callable[[Any], str]:
    return lambda found: f"{columns}, {found.cloud.num_points:,} points"


def _model_figure(found: Any) -> str:
    block = found.block
    return (
        f"{block.num_images:,} images, {block.num_points:,} points, {block.num_observations:,} observations, "
        f"{len(block.camera_parameters)} cameras {block.camera_model}"
    )


_READERS: dict[str, tuple[Callable[[Path], Any], Callable[[Any], str]]] = {
    "cloud.csv": (
        _clouds("read_csv_cloud"),
        lambda found: f"{_num_columns('CLOUD_COLUMNS')} columns, {found.cloud.num_points:,} points",
    ),
    DESCRIPTION: (_description, lambda found: f"{len(found['columns'])} columns described, {found['points']:,} points"),
    "cloud.ply": (_clouds("read_ply"), _cloud_figure("9 properties")),
    "cloud.laz": (_clouds("read_las"), _cloud_figure("LAS 1.4, point format 7, 3 extra dimensions")),
    "cameras.gpkg": (
        _sites,
        lambda found: f"layer cameras, {_num_columns('SITE_COLUMNS')} columns, {len(found.name):,} photos",
    ),
    "cameras.geojson": (_sites, lambda found: f"{_num_columns('SITE_COLUMNS')} columns, {len(found.name):,} photos"),
    TEXT: (_model, _model_figure),
    BINARY: (_binary, lambda found: f"{found.num_images:,} images, {found.num_points:,} points"),
    FRAME: (_frame, lambda found: "no place on earth" if found is None else f"origin and {found.crs}"),
    OPENSFM: (_opensfm, lambda found: f"{len(found['shots']):,} shots, {len(found['points']):,} points"),
    CONTROL: (
        _control,
        lambda found: f"{len(found[0]) if found else 0} columns, {len(found):,} control and check points",
    ),
    TILE: (_tile, lambda found: f"{found.num_images:,} images, {found.num_points:,} points"),
}
"""How each file, or folder of files, is read, and its figure."""
