"""Scale bars of a list, with the marks of the points at their ends."""

from collections.abc import Sequence

import numpy as np

from jaxba._errors import JaxbaError
from jaxba.engine._words import some
from jaxba.io import MeasuredBar, SurveyedPoint, parse_bars
from jaxba.pipeline._marks import PhotoMarks
from jaxba.scene import Control, ScaleBars

_LEAST_MARKS = 2


def bars_of(
    entry: tuple[str, str] | None,
    points: Sequence[SurveyedPoint],
    marks: PhotoMarks,
    std_m: float,
    mark_std_px: float,
    *,
    is_assumed: bool,
) -> tuple[ScaleBars, list[str]]:
    """Return the bars of a list, and notes on what is not used.

    - `entry`: name and text of the list, None where there is none. `points`: of the lists of control and check points,
      and `marks` of these. `std_m`: sigma of a bar that states none. `mark_std_px`, `is_assumed`: see `Control`.

    Raises `JaxbaError` as `parse_bars` does, and for an end that no list marks.
    """
    number = {point.name: k for k, point in enumerate(points)}
    bars = () if entry is None else parse_bars(entry[1], entry[0])
    for bar in bars:
        for label in (bar.first, bar.second):
            if label not in number:
                raise JaxbaError(f"{bar.source}: no list marks a point {label}; the points are {some(list(number))}.")
    used = {number[label] for bar in bars for label in (bar.first, bar.second)}
    idle = [point.name for k, point in enumerate(points) if not point.is_surveyed and k not in used]
    notes = [f"{some(idle)}: marked without coordinates, and no scale bar ends there: not used."] if idle else []
    if not bars:
        return ScaleBars.nothing(), notes
    rows = sorted(used)
    row_of = {point: row for row, point in enumerate(rows)}
    mine = np.isin(marks.point, rows)
    ends = Control(
        names=tuple(points[k].name for k in rows),
        xyz_m=np.zeros((len(rows), 3)),
        std_m=np.full((len(rows), 3), np.inf),
        is_check=np.zeros(len(rows), bool),
        mark_point=np.array([row_of[int(k)] for k in marks.point[mine]], np.int64),
        mark_image=marks.image[mine],
        mark_xy_px=marks.xy_px[mine],
        mark_std_px=mark_std_px,
        mark_std_is_assumed=is_assumed,
    )
    count = np.bincount(ends.mark_point, minlength=len(rows))
    notes += [
        f"{ends.names[k]}, an end of a scale bar, is marked in {count[k]} of the photos; two or more fix a point."
        for k in np.flatnonzero(count < _LEAST_MARKS)
    ]
    found = ScaleBars(
        ends=ends,
        first=np.array([row_of[number[bar.first]] for bar in bars], np.int64),
        second=np.array([row_of[number[bar.second]] for bar in bars], np.int64),
        length_m=np.array([bar.length_m for bar in bars]),
        std_m=np.array([bar.std_m or std_m for bar in bars]),
        is_check=np.array([_is_check(bar, points, number) for bar in bars]),
    )
    return found, notes


def _is_check(bar: MeasuredBar, points: Sequence[SurveyedPoint], number: dict[str, int]) -> bool:
    return any(points[number[label]].is_check for label in (bar.first, bar.second))
