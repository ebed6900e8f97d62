"""What all lists of coordinates share: lines, columns by name, numbers, and the CRS in a header.

Messages name the file, the line, the field and its value.
"""

import csv
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass

from jaxba._errors import JaxbaError
from jaxba.scene import HeightKind

Line = tuple[int, str]
"""Number of a line, from 1, and its text."""

PLACE_COLUMNS = {
    "longitude": ("longitude", "lon", "long", "lng", "x_longitude"),
    "latitude": ("latitude", "lat", "y_latitude"),
    "x": ("x", "easting", "east", "geo_x", "x_easting", "x_east"),
    "y": ("y", "northing", "north", "geo_y", "y_northing", "y_north"),
    "z": ("z", "height", "altitude", "elevation", "alt", "geo_z", "z_altitude"),
    "std_h": (
        "std_h", "std_h_m", "horizontal_accuracy", "h_accuracy", "h_acc", "accuracy_horizontal", "horz_accuracy",
        "accuracy_horz", "accuracy_x_y", "accuracy_xy", "xy_accuracy",
    ),
    "std_v": (
        "std_v", "std_v_m", "vertical_accuracy", "v_accuracy", "v_acc", "accuracy_vertical", "vert_accuracy",
        "accuracy_vert", "accuracy_z", "z_accuracy",
    ),
    "std": ("std", "std_m", "accuracy"),
    "crs": ("crs", "srs", "epsg"),
}  # fmt: skip
"""Titles of the columns that say where something is, as `plain_title` writes them."""

_FORMS = {
    "geo.txt": "A geo.txt has the CRS on its first line, then lines `image x y z`; a CSV has a header that names its "
    "columns: name, longitude and latitude or x and y, and if known z, std_h, std_v, yaw, pitch, roll, crs.",
    "gcp_list.txt": "A gcp_list.txt has the CRS on its first line, then lines `x y z px py image name`; a CSV has a "
    "header that names its columns: name, longitude and latitude or x and y, z, px, py, image, and if known std_h, "
    "std_v, role, crs.",
}


def content_lines(text: str) -> tuple[list[Line], list[Line]]:
    """Return the lines that are neither empty nor a comment, and the comments above them, without their marks."""
    lines = [(number, line.strip()) for number, line in enumerate(text.splitlines(), start=1)]
    content = [(number, line) for number, line in lines if line and not line.startswith("#")]
    end = content[0][0] if content else len(lines) + 1
    return content, [(number, line.lstrip("# ")) for number, line in lines if line.startswith("#") and number < end]


@dataclass(frozen=True, kw_only=True)
class Table:
    """A CSV: titles in `header`, the `line` that they stand on, the lines below, and the CRS above, if there is one."""

    header: list[str]
    line: int
    rows: list[Line]
    crs: str | None


def find_table(content: Sequence[Line], comments: Sequence[Line], known: Mapping[str, Sequence[str]]) -> Table | None:
    """Return the CSV that a list is; None where no line above the first row has titles of columns.

    The header is the first line, or the second below a CRS, or the last comment, as Metashape and Pix4D write it. The
    CRS is in a comment above, such as `# EPSG:32615` or Metashape's `# CoordinateSystem: GEOGCS[...]`.
    """
    crs = next((found for _, text in comments if (found := crs_of_comment(text))), None)
    for row, (line, text) in enumerate(content[:2]):
        if header := _titles(text, known):
            return Table(header=header, line=line, rows=list(content[row + 1 :]), crs=content[0][1] if row else crs)
    for line, text in comments[::-1]:
        header = _titles(text, known)
        if header and content and any(len(_cells(content[0][1], s)) >= len(header) for s in ",;\t"):
            return Table(header=header, line=line, rows=list(content), crs=crs)
    return None


def _titles(line: str, known: Mapping[str, Sequence[str]]) -> list[str] | None:
    """Return the titles of a line that has two or more of those that are known; None for what is no header."""
    titles = {title for names in known.values() for title in names}
    for separator in ",;\t":
        cells = [cell.strip() for cell in _cells(line, separator)]
        if len(cells) >= 3 and sum(plain_title(cell) in titles for cell in cells) >= 2:
            return cells
    return None


def plain_title(title: str) -> str:
    """Return a column's title without case, units in brackets and punctuation."""
    bare = re.sub(r"[\[(].*?[\])]", "", title.lower())
    return re.sub(r"[^a-z0-9]+", "_", bare).strip("_")


def columns_by_name(header: Sequence[str], known: Mapping[str, Sequence[str]]) -> tuple[dict[str, int], list[str]]:
    """Return the place of each known column, and the titles of the others."""
    place: dict[str, int] = {}
    unused = []
    for index, title in enumerate(header):
        column = next((column for column, names in known.items() if plain_title(title) in names), None)
        if column is None or column in place:
            unused.append(title)
        else:
            place[column] = index
    return place, unused


def csv_rows(table: Table, place: Mapping[str, int], name: str) -> Iterator[tuple[int, Callable[[str], str]]]:
    """Yield number and cells by column of each line below the header; a column that is not there is empty."""
    separator = _separator(table)
    count = len(table.header)
    for line, words in table.rows:
        cells = _cells(words, separator)
        if len(cells) < count or any(cell.strip() for cell in cells[count:]):
            raise JaxbaError(f"{name} line {line}: has {len(cells)} columns where the header has {count}; mend it.")
        yield line, lambda column, cells=cells: cells[place[column]].strip() if column in place else ""


def _separator(table: Table) -> str:
    """Return the separator that cuts the first row into as many cells as the header has, or a few more."""
    counts = {s: len(_cells(table.rows[0][1], s)) for s in ",;\t"} if table.rows else {}
    fits = [s for s, count in counts.items() if count == len(table.header)]
    fits += [s for s, count in counts.items() if count > len(table.header)]
    return fits[0] if fits else ","


def _cells(line: str, separator: str) -> list[str]:
    """Return the cells of a line of CSV, which is not empty; the whole line where it holds a cell of over 131 kB."""
    try:
        return next(csv.reader([line], delimiter=separator))
    except csv.Error:
        return [line]


def crs_of_comment(comment: str) -> str | None:
    """Return the CRS that a comment such as `EPSG:32615` or `CoordinateSystem: PROJCS[...]` names; None for none.

    >>> crs_of_comment("crs: 32615"), crs_of_comment("CoordinateSystem: WGS 84 (EPSG::4326)"), crs_of_comment("my list")
    ('EPSG:32615', 'EPSG:4326', None)
    """
    text = re.sub(r"^(crs|srs|epsg|coordinate ?system)\s*[:=]\s*", "", comment, flags=re.IGNORECASE)
    if code := re.search(r"\(EPSG::?(\d+)\)$", text, re.IGNORECASE):
        return f"EPSG:{code[1]}"
    if re.fullmatch(r"\d+(\+\d+)?", text):
        return f"EPSG:{text}"
    is_crs = re.match(r"(EPSG|ESRI|OGC|IGNF):|\+\w+=|init=|WGS|(PROJ|GEO|COMP|BOUND|LOCAL)\w*\[", text, re.IGNORECASE)
    return text if is_crs else None


def read_crs(text: str, where: str, kind: str = "geo.txt") -> tuple[str, HeightKind]:
    """Return a CRS as its code, or as it is written where it has none, and what its heights are above.

    - `where`: file and line; `kind`: of list, `geo.txt` or `gcp_list.txt`, for messages.

    Raises `JaxbaError` for what is no CRS, and for what names no datum.
    """
    from jaxba._crs_text import authority_code, crs_of_text  # loads pyproj

    no_crs = f"is no CRS; give EPSG:4326, a PROJ string, or 'WGS84 UTM 17N'. {_FORMS[kind]}"
    crs = crs_of_text(text, f"{where}: ", no_crs)
    code = authority_code(crs) or text
    if crs.is_compound:
        vertical = crs.sub_crs_list[-1].name.lower()
        return code, "ellipsoidal" if "ellipsoid" in vertical else "mean_sea_level"
    return code, "ellipsoidal" if len(crs.axis_info) == 3 and crs.is_geographic else "unknown"


def refuse_degrees_out_of_range(crs: str, x: float, y: float, where: str) -> None:
    """Raise where x and y of WGS 84 are no longitude and latitude."""
    if crs not in ("EPSG:4326", "EPSG:4979"):
        return
    for label, value, limit in (("longitude", x, 180), ("latitude", y, 90)):
        if abs(value) > limit:
            metres = " It looks like metres: write the projected CRS that it is in." if abs(value) > 20_000 else ""
            raise JaxbaError(f"{where}: {label} {value:g} is out of range; x is the longitude, y the latitude.{metres}")
