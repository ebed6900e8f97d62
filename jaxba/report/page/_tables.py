"""A table of the page: headings with units, and cells as text, with as many digits as the numbers of a unit need."""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

UNKNOWN = "\u2013"
AXIS_NAMES = ("east", "north", "up")


@dataclass(frozen=True, kw_only=True)
class Column:
    """A column: its heading, its unit, and whether it holds text, states or hashes rather than numbers."""

    name: str
    unit: str = ""
    kind: str = "number"


@dataclass(frozen=True, kw_only=True)
class Table:
    """A table.

    - `title`: above it. `note`: a sentence on how to read it. `columns`, `rows`: as many cells in each row as columns.
    - `is_closed`: it opens at a click. `is_wide`: it is printed on pages that lie on their side.
    """

    title: str
    columns: Sequence[Column]
    rows: Sequence[Sequence[str]]
    note: str = ""
    is_closed: bool = False
    is_wide: bool = False


def text(name: str) -> Column:
    """Return a column of text."""
    return Column(name=name, kind="text")


def state(name: str) -> Column:
    """Return a column of states: good, fair, poor or unknown, or why there is none."""
    return Column(name=name, kind="state")


def along(name: str, unit: str = "m") -> list[Column]:
    """Return three columns of numbers, along east, north and up."""
    return [Column(name=f"{name} {axis}".strip(), unit=unit) for axis in AXIS_NAMES]


def table(
    title: str,
    columns: Sequence[Column],
    rows: Iterable[Sequence[Any]],
    *,
    digits: int | None = None,
    note: str = "",
    is_closed: bool = False,
    is_wide: bool = False,
) -> Table:
    """Return a table of values: texts stay as they are, None is unknown, numbers get the digits that they need.

    - `digits`: after the point, for all numbers that are not whole; without it the numbers of the same unit tell.

    >>> table("", [Column(name="a"), Column(name="b")], [[1, 0.25], [2000, "any"]]).rows
    [['1', '0.250'], ['2,000', 'any']]
    """
    found = [list(row) for row in rows]
    places = [digits_for(_alike(columns, found, column.unit)) if digits is None else digits for column in columns]
    texts = [[number(value, place) for value, place in zip(row, places, strict=True)] for row in found]
    return Table(title=title, columns=columns, rows=texts, note=note, is_closed=is_closed, is_wide=is_wide)


def number(value: Any, digits: int = 3) -> str:
    """Return a value as it stands in a cell.

    >>> number(4612800.1234), number(12000), number("any"), number(True), number(None) == UNKNOWN
    ('4,612,800.123', '12,000', 'any', 'yes', True)
    """
    if value is None:
        return UNKNOWN
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, str):
        return value
    if isinstance(value, int):
        return f"{value:,}"
    shown = f"{value:,.{digits}f}"
    return shown.lstrip("-") if float(shown.replace(",", "")) == 0 else shown


def digits_for(values: Iterable[Any], least: int = 3, most: int = 8) -> int:
    """Return the digits after the point with which most numbers have two digits that count.

    >>> digits_for([0.012, 1.5, None]), digits_for([0.00012, 0.0004])
    (3, 5)
    """
    sizes = sorted(abs(value) for value in values if isinstance(value, float) and value)
    if not sizes:
        return least
    return int(min(max(1 - math.floor(math.log10(sizes[len(sizes) // 2])), least), most))


def _alike(columns: Sequence[Column], rows: Sequence[Sequence[Any]], unit: str) -> list[Any]:
    """Return the values of all columns of a unit."""
    return [value for row in rows for value, column in zip(row, columns, strict=True) if column.unit == unit]
