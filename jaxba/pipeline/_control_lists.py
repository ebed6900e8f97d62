"""Control lists: the points of both lists joined, which of them are check points, and their measured heights."""

import dataclasses
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from jaxba._errors import JaxbaError
from jaxba.engine._words import some
from jaxba.io import ControlList, SurveyedPoint, is_check_label, parse_control, photo_names, without_fillers
from jaxba.scene import Photo

_PLACE = ("crs", "x", "y", "z_m")


def points_of_lists(
    gcp: tuple[str, str] | None,
    check: tuple[str, str] | None,
    check_names: str | None,
    photos: Sequence[Photo],
    crs: str = "",
) -> tuple[list[SurveyedPoint], list[str]]:
    """Return the points of both lists, check points marked as such, and notes.

    - `gcp`, `check`: name and text of the lists. `check_names`: of points that are check points in either. `crs`: of
      a list that names none.
    """
    notes: list[str] = []
    found: dict[str, SurveyedPoint] = {}
    is_photo = photo_names([photo.name for photo in photos])
    for entry, is_check in ((gcp, False), (check, True)):
        if entry is None:
            continue
        read: ControlList = parse_control(entry[1], entry[0], "check" if is_check else "point", is_photo, crs)
        notes += read.notes
        for point in read.points:
            same = found.get(point.name) if point.is_named else None
            same = same or next((other for other in found.values() if _is_one_unnamed(other, point)), None)
            joined = point if same is None else _joined(same, point)
            while same is None and joined.name in found:  # a number that is a name in the other list
                joined = dataclasses.replace(joined, name=f"{joined.name}_")
            found[joined.name] = dataclasses.replace(joined, is_check=joined.is_check or is_check)
    asked = [name for name in (text.strip() for text in (check_names or "").replace(";", ",").split(",")) if name]
    unknown = [name for name in asked if name not in found]
    if unknown:
        raise JaxbaError(
            f"control.check={check_names}: no point is called {', '.join(unknown)}; the points are {', '.join(found)}."
        )
    points = [dataclasses.replace(point, is_check=point.is_check or name in asked) for name, point in found.items()]
    return points, [*notes, *_label_notes(points)]


def heights_of_points(
    points: Sequence[SurveyedPoint], asked: str, names: str, notes: list[str]
) -> Float[np.ndarray, " points"]:
    """Return the heights that were measured, NaN for others, and add what is told of them to the notes.

    - `asked`: `control.heights`. `names`: of the lists.
    """
    if asked == "ignore":
        notes.append(f"{names}: heights are ignored as asked (control.heights=ignore): control is horizontal only.")
        return np.full(len(points), np.nan)
    measured, found = without_fillers(
        [point.z_m for point in points], [point.name for point in points], names, kind="point",
        so=": horizontal control only", cure=" If 0 was measured, set control.heights=use.", keep_zeros=asked == "use",
    )  # fmt: skip
    notes += found
    z = np.array([np.nan if value is None else value for value in measured])
    known = np.isfinite(z)
    if not known.any():
        notes.append(f"{names} has no heights: control is horizontal only.")
    elif len(z) > 2 and known.all() and np.ptp(z) == 0:
        notes.append(
            f"{names}: all {len(z)} heights are {z[0]:g}. They are used; if they were not measured, set "
            "control.heights=ignore."
        )
    return z


def _label_notes(points: Sequence[SurveyedPoint]) -> list[str]:
    """Return notes on the points that are check points by their names, and on those that only look like some."""
    by_label = [point.name for point in points if point.is_check and is_check_label(point.name)]
    alike = [point.name for point in points if not point.is_check and point.name.lower().startswith(("chk", "check"))]
    notes = []
    if by_label:
        notes.append(f"Check points by their names, CHK-...: {some(by_label)}.")
    if alike:
        notes.append(
            f"{some(alike)}: used as control. If these are check points, name them CHK-... or give control.check."
        )
    return notes


def _is_one_unnamed(first: SurveyedPoint, second: SurveyedPoint) -> bool:
    """Whether two lists mean one point by its place, which one of them does not name."""
    if first.is_named and second.is_named:
        return False
    return all(getattr(first, field) == getattr(second, field) for field in _PLACE)


def _joined(first: SurveyedPoint, second: SurveyedPoint) -> SurveyedPoint:
    """Return a point of both lists: one place, the marks of both, the same mark once."""
    if not (first.is_surveyed and second.is_surveyed):  # marked alone in one of them
        first = dataclasses.replace(second if second.is_surveyed else first, marks=first.marks)
        second = dataclasses.replace(second, **{field: getattr(first, field) for field in _PLACE})
    for field in _PLACE:
        if first.is_surveyed and getattr(first, field) != getattr(second, field):
            raise JaxbaError(
                f"{second.source}: {second.name} has {field} {getattr(second, field)}, and {getattr(first, field)} in "
                f"{first.source}; give one value, or two names."
            )
    known = {(mark.image, mark.x_px, mark.y_px) for mark in first.marks}
    new = [mark for mark in second.marks if (mark.image, mark.x_px, mark.y_px) not in known]
    return dataclasses.replace(first, marks=(*first.marks, *new), is_check=first.is_check or second.is_check)
