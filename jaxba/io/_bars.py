"""Lists of scale bars: known distances between marked points, a line a bar.

CSV with a header line, `first`, `second`, `length_m` and, if known, `std_m`; or the same four columns by blanks or tabs
without one. Points are called by their names in the lists of control and check points; lengths are metres.
"""

import re
from dataclasses import dataclass

from jaxba._errors import JaxbaError
from jaxba.io._list_cells import read_if_known, read_number
from jaxba.io._list_text import columns_by_name, content_lines, csv_rows, find_table

BAR_COLUMNS = {
    "first": ("first", "from", "start", "point_1", "point1", "label_1", "name_1"),
    "second": ("second", "to", "end", "point_2", "point2", "label_2", "name_2"),
    "length_m": ("length_m", "length", "distance_m", "distance"),
    "std_m": ("std_m", "std", "accuracy", "accuracy_m", "sigma", "sigma_m"),
}
"""Titles of the columns, as `plain_title` writes them."""
_UNIT, _METRES = re.compile(r"[\[(](.*?)[\])]"), ("m", "metre", "metres", "meter", "meters", "")


@dataclass(frozen=True, kw_only=True)
class MeasuredBar:
    """A line of a list: labels of two points, their distance, its sigma or None, and file and line."""

    first: str
    second: str
    length_m: float
    std_m: float | None
    source: str


def parse_bars(text: str, name: str = "bars.csv") -> tuple[MeasuredBar, ...]:
    """Return the bars of a list in its order.

    - `name`: of the file, for messages.

    Raises `JaxbaError` with file, line, field and value for what cannot be read, a length that is not above 0, a sigma
    below it (0 is one that is not known), a title with another unit than metres, a bar from a point to itself, and two
    bars between the same points.

    >>> [(bar.first, bar.second, bar.length_m) for bar in parse_bars("first,second,length_m\\nA,B,12.5")]
    [('A', 'B', 12.5)]
    """
    content, comments = content_lines(text)
    form = "give a line a bar: first second length_m std_m, or a CSV with these titles."
    if not content:
        raise JaxbaError(f"{name}: is empty; {form}")
    table = find_table(content, comments, BAR_COLUMNS)
    if table is None:
        rows = [(line, _by_blanks(words, f"{name} line {line}", form)) for line, words in content]
    else:
        place, _ = columns_by_name(table.header, BAR_COLUMNS)
        missing = [column for column in ("first", "second", "length_m") if column not in place]
        if missing:
            raise JaxbaError(f"{name} line {table.line}: columns {', '.join(table.header)} lack {', '.join(missing)}.")
        for column in ("length_m", "std_m"):
            _refuse_unit(table.header[place[column]] if column in place else "", f"{name} line {table.line}")
        rows = [(line, {column: cell(column) for column in BAR_COLUMNS}) for line, cell in csv_rows(table, place, name)]
    if not rows:
        raise JaxbaError(f"{name}: lists no bar; {form}")
    bars = tuple(_bar(cells, f"{name} line {line}") for line, cells in rows)
    known: dict[frozenset[str], MeasuredBar] = {}
    for bar in bars:
        same = known.setdefault(frozenset((bar.first, bar.second)), bar)
        if same is not bar:
            raise JaxbaError(
                f"{bar.source}: the bar from {bar.first} to {bar.second} stands in {same.source} as well; give their "
                "mean, or keep one of them."
            )
    return bars


def _refuse_unit(title: str, where: str) -> None:
    unit = _UNIT.search(title)
    if unit and unit[1].strip().lower() not in _METRES:
        raise JaxbaError(f"{where}: {title} is in {unit[1].strip()}; give metres, and write so.")


def _by_blanks(words: str, where: str, form: str) -> dict[str, str]:
    cells = words.split()
    if len(cells) not in (3, 4):
        raise JaxbaError(f"{where}: '{words}' has {len(cells)} columns; {form}")
    return dict(zip(BAR_COLUMNS, [*cells, ""][:4], strict=True))


def _bar(cells: dict[str, str], where: str) -> MeasuredBar:
    for column in ("first", "second"):
        if not cells[column]:
            raise JaxbaError(f"{where}: {column} is empty; write the name of a marked point.")
    if cells["first"] == cells["second"]:
        raise JaxbaError(f"{where}: the bar begins and ends at {cells['first']}; write two points.")
    length_m = read_number(cells["length_m"], where, "length_m")
    std_m = read_if_known(cells["std_m"], where, "std_m") or None
    for column, value in (("length_m", length_m), ("std_m", std_m)):
        if value is not None and value <= 0:
            raise JaxbaError(f"{where}: {column} {value:g}; give metres above 0.")
    return MeasuredBar(first=cells["first"], second=cells["second"], length_m=length_m, std_m=std_m, source=where)
