"""Lists of control and check points with their marks in photos: OpenDroneMap's gcp_list.txt, or CSV with a header line.

gcp_list.txt, a line a mark, by blanks or tabs; all after `image` may be missing:

    EPSG:32615                    (or a PROJ string, or `WGS84 UTM 17N`)
    x y z px py image [name] [anything]

x is the easting or longitude whatever the CRS's own axis order. px and py count from the outer corner of the first
pixel. Points without a name are told apart by their coordinates, and named point1, point2, ... in their order.

CSV: columns by name in any order: `name`, `x`, `y`, `z`, `px`, `py`, `image` and common variants; sigmas of the
coordinates in metres as `std_h`, `std_v`; `role`, control or check. The CRS stands in a `crs` column or a comment such
as `# EPSG:32615` on the first line; latitude and longitude are EPSG:4326 without one.
"""

import dataclasses
import itertools
from collections.abc import Callable
from dataclasses import dataclass

from jaxba._errors import JaxbaError
from jaxba.io._list_text import (
    PLACE_COLUMNS,
    Line,
    columns_by_name,
    content_lines,
    crs_of_comment,
    csv_rows,
    header_titles,
    read_crs,
    read_number,
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

    - `crs`, `x`, `y`: east or longitude first. `z_m`: in the list's own unit and height system; None where it has none.
    - `std_h_m`, `std_v_m`: None where the list states none. `is_check`: its role says so. `source`: file and line.
    - `is_named`: by the list; else it was given a number.
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


def parse_control(text: str, name: str = "gcp_list.txt", unnamed: str = "point") -> ControlList:
    """Return the points of a gcp_list.txt or CSV, each with its marks.

    - `name`: of the file, for messages. `unnamed`: what points without a name are called, with a number.

    Raises `JaxbaError` with file, line, field and value for what cannot be read, for a name with two places, and for a
    point that is marked twice in one photo.

    >>> text = "EPSG:32615\\n576308.6 5183424.7 198.2 1200 900 a.jpg\\n576308.6 5183424.7 198.2 310 905 b.jpg"
    >>> [(point.name, len(point.marks)) for point in parse_control(text).points]
    [('point1', 2)]
    """
    content, comment = content_lines(text)
    if not content:
        raise JaxbaError(f"{name}: is empty; give a CRS line and a line a mark, or a CSV with a header line.")
    header = header_titles(content[0][1], (*_COLUMNS["image"], *_COLUMNS["px"]))
    notes: list[str] = []
    if header is not None:
        rows, notes = _read_csv(content, header, crs_of_comment(comment), name)
    else:
        rows = _read_list(content, name)
    if not rows:
        raise JaxbaError(f"{name}: lists no mark; give a line a mark below the first, or leave the list away.")
    return ControlList(points=_points(rows, unnamed), notes=tuple(notes))


def _read_list(content: list[Line], name: str) -> list[_Row]:
    crs, _ = read_crs(content[0][1], f"{name} line {content[0][0]}", "gcp_list.txt")
    rows = []
    for line, words in content[1:]:
        where = f"{name} line {line}"
        cells = [cell.strip() for cell in words.split("\t")] if words.count("\t") >= 5 else words.split()
        if len(cells) < 6:
            raise JaxbaError(f"{where}: '{words}' has {len(cells)} columns; give x y z px py image, then a name.")
        x, y, z_m, px, py = (
            read_number(cell, where, label) for cell, label in zip(cells, ("x", "y", "z", "px", "py"), strict=False)
        )
        given = cells[6] if len(cells) > 6 else ""
        rows.append(_row(given, where, crs, x, y, z_m, Mark(image=cells[5], x_px=px, y_px=py, source=where)))
    return rows


def _read_csv(
    content: list[Line], header: list[str], comment_crs: str | None, name: str
) -> tuple[list[_Row], list[str]]:
    place, unused = columns_by_name(header, _COLUMNS)
    notes = [f"{name}: columns that are not used: {', '.join(unused)}."] if any(unused) else []
    is_geographic = "latitude" in place and "longitude" in place
    x_name, y_name = ("longitude", "latitude") if is_geographic else ("x", "y")
    missing = [column for column in (x_name, y_name, "px", "py", "image") if column not in place]
    if missing:
        raise JaxbaError(
            f"{name} line {content[0][0]}: columns {', '.join(header)} lack {', '.join(missing)}; name them x, y (or "
            "longitude, latitude), z, px, py, image, name."
        )
    if not is_geographic and "crs" not in place and comment_crs is None:
        raise JaxbaError(f"{name}: x and y need a CRS; add a crs column, or a first line such as '# EPSG:32615'.")
    known: dict[str, str] = {}
    rows = []
    for line, cell in csv_rows(content[1:], header, place, name):
        where = f"{name} line {line}"
        text = cell("crs") or comment_crs or ("EPSG:4326" if is_geographic else "")
        if text not in known:
            known[text] = read_crs(text, where, "gcp_list.txt")[0]
        x, y, px, py = (read_number(cell(column), where, column) for column in (x_name, y_name, "px", "py"))
        if not cell("image"):
            raise JaxbaError(f"{where}: image '' is empty; write the photo's name, or delete the line.")
        mark = Mark(image=cell("image"), x_px=px, y_px=py, source=where)
        stds = [_sigma(cell, column, where) for column in ("std_h", "std_v")]
        z_m = read_number(cell("z"), where, "z") if cell("z") else None
        rows.append(_row(cell("name"), where, known[text], x, y, z_m, mark, *stds, is_check=_is_check(cell, where)))
    return rows, notes


def _sigma(cell: Callable[[str], str], column: str, where: str) -> float | None:
    if not cell(column):
        return None
    value = read_number(cell(column), where, column)
    if value < 0:
        raise JaxbaError(f"{where}: {column} {value:g} is negative; give a sigma in metres, 0 if unknown.")
    return value or None


def _is_check(cell: Callable[[str], str], where: str) -> bool:
    role = cell("role").lower().replace(" ", "_").replace("-", "_")
    if role not in (*_CHECK, *_CONTROL):
        raise JaxbaError(f"{where}: role '{cell('role')}' is not known; write control or check.")
    return role in _CHECK


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
    is_check: bool = False,
) -> _Row:
    refuse_degrees_out_of_range(crs, x, y, where)
    point = SurveyedPoint(
        name=name, crs=crs, x=x, y=y, z_m=z_m, marks=(mark,), std_h_m=std_h_m, std_v_m=std_v_m, is_check=is_check,
        source=where,
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
                raise JaxbaError(
                    f"{row.point.source}: {name} has {field} {new}, and {old} in {before.source}; give one value, or "
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
    return tuple(getattr(point, field) for field in _PLACE)
