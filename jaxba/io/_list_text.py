"""What all lists of coordinates share: lines, columns by name, numbers, and the CRS in a header.

Messages name the file, the line, the field and its value.
"""

import csv
import math
import re
from collections.abc import Callable, Iterator, Mapping, Sequence

from jaxba._errors import JaxbaError
from jaxba.scene import HeightKind

Line = tuple[int, str]
"""Number of a line, from 1, and its text."""

PLACE_COLUMNS = {
    "longitude": ("longitude", "lon", "long", "lng"),
    "latitude": ("latitude", "lat"),
    "x": ("x", "easting", "east", "geo_x", "x_easting"),
    "y": ("y", "northing", "north", "geo_y", "y_northing"),
    "z": ("z", "height", "altitude", "elevation", "alt", "geo_z", "z_altitude"),
    "std_h": (
        "std_h", "std_h_m", "horizontal_accuracy", "h_accuracy", "h_acc", "accuracy_horizontal", "horz_accuracy",
        "accuracy_horz",
    ),
    "std_v": (
        "std_v", "std_v_m", "vertical_accuracy", "v_accuracy", "v_acc", "accuracy_vertical", "vert_accuracy",
        "accuracy_vert",
    ),
    "crs": ("crs", "srs", "epsg"),
}  # fmt: skip
"""Titles of the columns that say where something is, as `plain_title` writes them."""


def content_lines(text: str) -> tuple[list[Line], str]:
    """Return the lines that are neither empty nor a comment, and the comment on the first line."""
    lines = [(number, line.strip()) for number, line in enumerate(text.splitlines(), start=1)]
    content = [(number, line) for number, line in lines if line and not line.startswith("#")]
    first = lines[0][1] if lines else ""
    return content, first.lstrip("# ") if first.startswith("#") else ""


def header_titles(line: str, names: Sequence[str]) -> list[str] | None:
    """Return the titles of a CSV's header line, which has one of `names`; None for what is none."""
    for separator in ",;\t":
        cells = [cell.strip() for cell in _cells(line, separator)]
        if len(cells) >= 3 and any(plain_title(cell) in names for cell in cells):
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


def csv_rows(
    content: Sequence[Line], header: Sequence[str], place: Mapping[str, int], name: str
) -> Iterator[tuple[int, Callable[[str], str]]]:
    """Yield number and cells by column of each line below the header; a column that is not there is empty."""
    separator = _separator(header, content)
    for line, words in content:
        cells = _cells(words, separator)
        if len(cells) != len(header):
            raise JaxbaError(
                f"{name} line {line}: has {len(cells)} columns where the header has {len(header)}; mend it."
            )
        yield line, lambda column, cells=cells: cells[place[column]].strip() if column in place else ""


def _separator(header: Sequence[str], content: Sequence[Line]) -> str:
    """Return the separator that cuts the first row into as many cells as the header has."""
    fits = [s for s in ",;\t" if content and len(_cells(content[0][1], s)) == len(header)]
    return fits[0] if fits else ","


def _cells(line: str, separator: str) -> list[str]:
    """Return the cells of a line of CSV, which is not empty; the whole line where it holds a cell of over 131 kB."""
    try:
        return next(csv.reader([line], delimiter=separator))
    except csv.Error:
        return [line]


def crs_of_comment(comment: str) -> str | None:
    """Return the CRS that a comment such as `# EPSG:32615` names; None where it does not look like one."""
    text = re.sub(r"^(crs|srs|epsg)\s*[:=]\s*", "", comment, flags=re.IGNORECASE)
    if re.fullmatch(r"\d+(\+\d+)?", text):
        return f"EPSG:{text}"
    is_crs = re.match(r"(EPSG|ESRI|OGC|IGNF):|\+\w+=|init=|WGS|(PROJ|GEO|COMP|BOUND)\w*\[", text, re.IGNORECASE)
    return text if is_crs else None


def read_crs(text: str, where: str, kind: str = "geo.txt") -> tuple[str, HeightKind]:
    """Return a CRS as its code, or as it is written where it has none, and what its heights are above.

    - `where`: file and line; `kind`: of list, for messages.

    Raises `JaxbaError` for what is no CRS, and for what names no datum.
    """
    from jaxba._crs_text import authority_code, crs_of_text  # loads pyproj

    no_crs = (
        f"is no CRS; give EPSG:4326, a PROJ string, or 'WGS84 UTM 17N' (a {kind} has it on its first line, a CSV a "
        "header with the columns' names)."
    )
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
            raise JaxbaError(f"{where}: {label} {value:g} is out of range; x is the longitude, y the latitude.")


def read_number(text: str, where: str, label: str) -> float:
    """Return a finite number."""
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise JaxbaError(
            f"{where}: {label} '{text}' is no number; write it with a point, without unit or thousands marks."
        )
    return value
