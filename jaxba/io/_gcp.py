"""Lists of control and check points with their marks in photos: OpenDroneMap's gcp_list.txt, or CSV with a header line.

gcp_list.txt, a line a mark, by blanks or tabs; all after `image` may be missing:

    EPSG:32615                    (or a PROJ string, or `WGS84 UTM 17N`)
    x y z px py image [name] [anything]

x is the easting or longitude whatever the CRS's own axis order. px and py count from the outer corner of the first
pixel. Points without a name are told apart by their coordinates, and named point1, point2, ... in their order. z may be
NaN, OpenDroneMap's word for no height, and a name that begins with `CHK-` is that of a check point, as it is there.

CSV: columns by name in any order: `name`, `x`, `y`, `z`, `px`, `py`, `image` and common variants; sigmas of the
coordinates in metres as `std_h`, `std_v`; `role`, control or check. The CRS stands in a `crs` column or a comment such
as `# EPSG:32615` on the first line; latitude and longitude are EPSG:4326 without one.
"""

import dataclasses
import itertools
import math
import re
from collections.abc import Callable
from dataclasses import dataclass

from jaxba._errors import JaxbaError
from jaxba.io._list_cells import (
    NOT_KNOWN,
    no_photos,
    number_or_nan,
    read_height,
    read_if_known,
    read_number,
    split_image,
)
from jaxba.io._list_text import (
    PLACE_COLUMNS,
    Line,
    Table,
    columns_by_name,
    content_lines,
    csv_rows,
    find_table,
    read_crs,
    refuse_degrees_out_of_range,
)

_COLUMNS = {
    **PLACE_COLUMNS,
    "image": ("image", "imagename", "image_name", "filename", "file_name", "file", "photo", "photo_name"),
    "name": ("name", "gcp", "gcp_name", "point", "point_name", "label", "id", "point_id", "gcp_label"),
    "px": ("px", "im_x", "image_x", "pixel_x", "x_px", "col", "column", "u"),
    "py": ("py", "im_y", "image_y", "pixel_y", "y_px", "row", "line", "v"),
    "role": ("role", "type", "kind", "usage"),
}
_CHECK, _CONTROL = ("check", "checkpoint", "check_point", "cp", "ckp"), ("control", "gcp", "control_point", "")
_CHECK_LABEL = re.compile(r"CHK[-_ ]", re.IGNORECASE)
_PLACE = ("crs", "x", "y", "z_m", "std_h_m", "std_v_m", "is_check")


@dataclass(frozen=True, kw_only=True)
class Mark:
    """Where a photo shows a point.

    - `image`: as the list writes it. `x_px`, `y_px`: as written. `source`: file and line.
    """

    image: str
    x_px: float
    y_px: float
    source: str


@dataclass(frozen=True, kw_only=True)
class SurveyedPoint:
    """A point of a list, with all its marks.

    - `crs`, `x`, `y`: east or longitude first; empty and NaN of a point that is marked alone, without coordinates.
    - `z_m`: in the list's own unit and height system; None where it has none.
    - `std_h_m`, `std_v_m`: None where the list states none. `is_check`: its role or name says so.
    - `source`: file and line. `is_named`: by the list; else it was given a number.
    """

    name: str
    crs: str
    x: float
    y: float
    z_m: float | None
    marks: tuple[Mark, ...]
    std_h_m: float | None = None
    std_v_m: float | None = None
    is_check: bool = False
    source: str = ""
    is_named: bool = True

    @property
    def is_surveyed(self) -> bool:
        """Whether it has coordinates."""
        return self.x == self.x


@dataclass(frozen=True, kw_only=True)
class ControlList:
    """- `points`: in the list's order. `notes`: what was assumed."""

    points: tuple[SurveyedPoint, ...]
    notes: tuple[str, ...] = ()


@dataclass(frozen=True, kw_only=True)
class _Row:
    """A line of a list: a point as this line has it, and one mark."""

    name: str
    point: SurveyedPoint


def is_check_label(name: str) -> bool:
    """Whether a point's name says that it is a check point, by OpenDroneMap's convention.

    >>> is_check_label("CHK-1"), is_check_label("chk_07"), is_check_label("gcp01")
    (True, True, False)
    """
    return _CHECK_LABEL.match(name) is not None


def parse_control(
    text: str,
    name: str = "gcp_list.txt",
    unnamed: str = "point",
    is_photo: Callable[[str], bool] = no_photos,
    crs: str = "",
) -> ControlList:
    """Return the points of a gcp_list.txt or CSV, each with its marks.

    - `name`: of the file, for messages. `unnamed`: what points without a name are called, with a number.
    - `is_photo`: tells the names of photos, which may have blanks in them. `crs`: of a list that names none.

    Raises `JaxbaError` with file, line, field and value for what cannot be read, for a name with two places, and for a
    point that is marked twice in one photo.

    >>> text = "EPSG:32615\\n576308.6 5183424.7 198.2 1200 900 a.jpg\\n576308.6 5183424.7 198.2 310 905 b.jpg"
    >>> [(point.name, len(point.marks)) for point in parse_control(text).points]
    [('point1', 2)]
    """
    content, comments = content_lines(text)
    if not content:
        raise JaxbaError(f"{name}: is empty; give a CRS line and a line a mark, or a CSV with a header line.")
    table = find_table(content, comments, _COLUMNS)
    rows, notes = (_read_list(content, name, is_photo, crs), []) if table is None else _read_csv(table, name, crs)
    if not rows:
        raise JaxbaError(f"{name}: lists no mark; give a line a mark below the first, or leave the list away.")
    return ControlList(points=_points(rows, unnamed), notes=tuple(notes))


def _read_list(content: list[Line], name: str, is_photo: Callable[[str], bool], crs: str) -> list[_Row]:
    first = number_or_nan(content[0][1].split()[0])
    if crs and first == first:  # a mark: the list names no CRS
        content = [(0, crs), *content]
    crs, _ = read_crs(content[0][1], f"{name} line {content[0][0]}", "gcp_list.txt")
    rows = []
    for line, words in content[1:]:
        where = f"{name} line {line}"
        cells = _cells(words)
        if len(cells) < 6:
            is_csv = max(map(words.count, ",;")) >= 5
            cure = " Separate columns by blanks, or name them in a header line." if is_csv else ""
            count = "1 column" if len(cells) == 1 else f"{len(cells)} columns"
            raise JaxbaError(f"{where}: '{words}' has {count}; give x y z px py image, then a name.{cure}")
        px, py = (read_number(cells[k], where, label) for k, label in ((3, "px"), (4, "py")))
        x, y = _read_place(cells[0], cells[1], where, ("x", "y"))
        image, rest = split_image(cells[5], is_photo)
        is_cell = rest.lstrip(" ").startswith("\t")  # else a blank ends the point's name
        given = rest.strip().split("\t")[0].strip() if is_cell else split_image(rest.strip(), no_photos)[0]
        mark = Mark(image=image, x_px=px, y_px=py, source=where)
        rows.append(_row(given, where, crs if x == x else "", x, y, read_height(cells[2], where), mark))
    return rows


def _cells(words: str) -> list[str]:
    """Return x, y, z, px, py and all that follows; between tabs z may be empty."""
    cells = words.split(maxsplit=5)
    by_tab = [cell.strip() for cell in words.split("\t", maxsplit=5)]
    is_short = len(cells) < 6 or number_or_nan(cells[4]) != number_or_nan(cells[4])
    return by_tab if is_short and len(by_tab) == 6 and not by_tab[2] else cells


def _read_csv(table: Table, name: str, crs: str) -> tuple[list[_Row], list[str]]:
    place, unused = columns_by_name(table.header, _COLUMNS)
    notes = [f"{name}: columns that are not used: {', '.join(unused)}."] if any(unused) else []
    is_geographic = "latitude" in place and "longitude" in place
    x_name, y_name = ("longitude", "latitude") if is_geographic else ("x", "y")
    missing = [column for column in (x_name, y_name, "px", "py", "image") if column not in place]
    if missing:
        alone = (
            "" if set(missing) != {"px", "py", "image"} else " Coordinates alone do not say where photos show a point."
        )
        raise JaxbaError(
            f"{name} line {table.line}: columns {', '.join(table.header)} lack {', '.join(missing)}; name them x, y "
            "(or longitude, latitude), z, px, py, image, name, and give a line for each photo that shows a point."
            f"{alone}"
        )
    known: dict[str, str] = {}
    rows = []
    for line, cell in csv_rows(table, place, name):
        where = f"{name} line {line}"
        x, y = _read_place(cell(x_name), cell(y_name), where, (x_name, y_name))
        px, py = (read_number(cell(column), where, column) for column in ("px", "py"))
        text = cell("crs") or table.crs or crs or ("EPSG:4326" if is_geographic else "")
        if x != x:
            text = ""
        elif not text and "crs" not in place:
            raise JaxbaError(f"{name}: x and y need a CRS; add a crs column, or a first line such as '# EPSG:32615'.")
        if x == x and text not in known:
            known[text] = read_crs(text, where, "gcp_list.txt")[0]
        if not cell("image"):
            raise JaxbaError(f"{where}: image '' is empty; write the photo's name, or delete the line.")
        mark = Mark(image=cell("image"), x_px=px, y_px=py, source=where)
        stds = [_sigma(cell, column, where) or _sigma(cell, "std", where) for column in ("std_h", "std_v")]
        z_m = read_height(cell("z"), where)
        rows.append(_row(cell("name"), where, known.get(text, ""), x, y, z_m, mark, *stds, role=_role(cell, where)))
    return rows, notes


def _read_place(x: str, y: str, where: str, labels: tuple[str, str]) -> tuple[float, float]:
    """Return east and north, or longitude and latitude; NaN of a point that is marked alone, where both are empty."""
    if x.strip().lower() in NOT_KNOWN and y.strip().lower() in NOT_KNOWN:
        return math.nan, math.nan
    return read_number(x, where, labels[0]), read_number(y, where, labels[1])


def _sigma(cell: Callable[[str], str], column: str, where: str) -> float | None:
    value = read_if_known(cell(column), where, column) or 0.0
    if value < 0:
        raise JaxbaError(f"{where}: {column} {value:g} is negative; give a sigma in metres, 0 if unknown.")
    return value or None


def _role(cell: Callable[[str], str], where: str) -> str:
    """Return `check` or `control`; empty where the list leaves it to the point's name."""
    role = cell("role").lower().replace(" ", "_").replace("-", "_")
    if role not in (*_CHECK, *_CONTROL):
        raise JaxbaError(f"{where}: role '{cell('role')}' is not known; write control or check.")
    return "check" if role in _CHECK else role and "control"


def _row(
    name: str,
    where: str,
    crs: str,
    x: float,
    y: float,
    z_m: float | None,
    mark: Mark,
    std_h_m: float | None = None,
    std_v_m: float | None = None,
    *,
    role: str = "",
) -> _Row:
    if x == x:
        refuse_degrees_out_of_range(crs, x, y, where)
    elif not name:
        raise JaxbaError(f"{where}: a point without coordinates needs a name, by which scale bars call it.")
    point = SurveyedPoint(
        name=name, crs=crs, x=x, y=y, z_m=z_m, marks=(mark,), std_h_m=std_h_m, std_v_m=std_v_m, source=where,
        is_check=is_check_label(name) if not role else role == "check",
    )  # fmt: skip
    return _Row(name=name, point=point)


def _points(rows: list[_Row], unnamed: str) -> tuple[SurveyedPoint, ...]:
    """Return rows joined by name, or by coordinates where they have none."""
    named = {row.name for row in rows}
    by_place = {_place(row.point)[:4]: row.name for row in reversed(rows) if row.name}
    free_names = (name for number in itertools.count(1) if (name := f"{unnamed}{number}") not in named)
    first: dict[str, SurveyedPoint] = {}
    marks: dict[str, dict[str, Mark]] = {}
    for row in rows:
        key = _place(row.point)[:4]
        if not row.name and key not in by_place:
            by_place[key] = next(free_names)
        name, mark = row.name or by_place[key], row.point.marks[0]
        before = first.setdefault(name, row.point)
        for field, old, new in zip(_PLACE, _place(before), _place(row.point), strict=True):
            if old != new:
                one, two = ("none" if value is None else value for value in (old, new))
                raise JaxbaError(
                    f"{row.point.source}: {name} has {field} {two}, and {one} in {before.source}; give one value, or "
                    "two names."
                )
        same = marks.setdefault(name, {}).get(mark.image)
        if same is not None:
            raise JaxbaError(
                f"{mark.source}: {name} is marked in {mark.image} twice, at {mark.x_px:g} {mark.y_px:g} here and "
                f"{same.x_px:g} {same.y_px:g} in {same.source}; keep one of the two."
            )
        marks[name][mark.image] = mark
    return tuple(
        dataclasses.replace(point, name=name, marks=tuple(marks[name].values()), is_named=name in named)
        for name, point in first.items()
    )


def _place(point: SurveyedPoint) -> tuple:
    place = tuple(getattr(point, field) for field in _PLACE)
    return place if point.is_surveyed else (None, None, None, *place[3:])
