"""Findings on control and check points in words."""

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

_PARTS = {
    "helmert": " It was left out of the fit where others remained.",
    "affine": " It was left out of the fit where others remained.",
}


def along_axes(values: Sequence[float], form: str) -> str:
    """Return metres along east, north and up in words, those that are known.

    >>> along_axes([0.5, -0.25, math.nan], "+.2f")
    'east +0.50, north -0.25 m'
    """
    axes = zip(("east", "north", "up"), values, strict=True)
    known = [f"{axis} {value:{form}}" for axis, value in axes if math.isfinite(value)]
    return f"{', '.join(known)} m" if known else "not known"


def _without_a_place() -> str:
    return "The block has no place on earth, so that its control and check points cannot be compared with it."


def _not_marked_twice(names: Sequence[str], marks: Sequence[int]) -> str:
    rows = zip(names, marks, strict=True)
    lost = ", ".join(f"{name} ({count} mark{'' if count == 1 else 's'})" for name, count in rows)
    return f"Points that are not marked in two adjusted photos or more, and not used: {lost}. Mark them in more photos."


def _few(count: int, least: int, is_fit: bool) -> str:
    what = "so no fit was made" if is_fit else "so they do not fix the block by themselves"
    return f"{count} control points can be used where {least} are needed, {what}. Mark more of them."


def _on_a_line(count: int) -> str:
    return (
        f"The {count} control points lie on a line, so that they do not hold the block from turning about it. "
        "Survey some to its sides."
    )


def _horizontal_only() -> str:
    return (
        "Control is horizontal only and no position has a height, so the block's height and tilt are those of "
        "the start values (cameras look down on average): heights and slopes are not to be relied on. Survey "
        "the heights of three control points or more."
    )


def _marks_contradict(marks: Sequence[Sequence[str]], std_px: float) -> str:
    names = ", ".join(f"{point} in {photo}" for point, photo in marks)
    return (
        f"Marks that contradict the others of their point by over 5 sigmas (control.mark_std_px="
        f"{std_px:g}), left out: {names}. Look at them."
    )


def _marks_off(median_px: float, std_px: float) -> str:
    return (
        f"Marks miss their points by {median_px:.1f} px in the median (sigma {std_px:g} px): were "
        "they set in photos of another size (control.mark_width_px), or counted from another corner?"
    )


def _marks_disagree(marks: int, name: str, rms_px: float) -> str:
    return (
        f"The {marks} marks of {name} do not agree (RMS "
        f"{rms_px:.1f} px), and which is wrong cannot be told: look at them, or mark more "
        "photos."
    )


def _scatters(count: int, axes: Sequence[str], scatter_m: Sequence[float], stated_m: Sequence[float]) -> str:
    rows = zip(axes, scatter_m, stated_m, strict=True)
    parts = ", ".join(f"{scatter:.2g} m {axis} where their sigma is {stated:.2g} m" for axis, scatter, stated in rows)
    return (
        f"The {count} control points contradict the block, most of them and not one: they scatter by "
        f"{parts}. Their sigmas were enlarged to that. Compare how they were surveyed with control.std_h "
        "and control.std_v, and check their CRS, names and marks."
    )


def _shifted(count: int, shift_m: Sequence[float], std_m: Sequence[float], is_controlled: bool) -> str:
    cure = (
        "Control and check points may be of two surveys or height systems: compare how both were measured"
        if is_controlled
        else "A GNSS base beside its mark, another datum or height system, or the antenna's offset does that, and no "
        "sigma of a position holds it: correct the positions by it, or use three of the points as control"
    )
    return (
        f"All {count} check points are off alike: block minus survey {along_axes(shift_m, '+.3f')}, where sigmas of "
        f"{along_axes(std_m, '.2g')} are expected. The block as a whole stands beside its place; its coordinates are "
        f"not to be used before that is settled. {cure}."
    )


def _contradicts(
    name: str, is_check: bool, residual_m: Sequence[float], over_sigma: float, limit: float, method: str
) -> str:
    part = "" if is_check else _PARTS.get(method, "")
    return (
        f"{'Check' if is_check else 'Control'} point {name} contradicts the block: adjusted minus surveyed "
        f"{along_axes(residual_m, '+.3f')}, {over_sigma:.1f} sigmas where {limit:g} are exceeded by chance in one of a "
        f"thousand. Check its coordinates, its name and its marks.{part}"
    )


def _gnss_off(
    offset_m: Sequence[float],
    offset_std_m: Sequence[float],
    std_m: Sequence[float],
    is_compared: bool,
    looks_like: str,
) -> str:
    how = "compared only" if is_compared else "the block follows control"
    known = [std if math.isfinite(offset) else math.inf for offset, std in zip(offset_m, std_m, strict=True)]
    residual_m = [-offset for offset in offset_m]
    sigma = f" (sigma {along_axes(offset_std_m, '.2g')})" if any(map(math.isfinite, offset_std_m)) else ""
    named = f" Heights of the list read {looks_like} would make just this difference." if looks_like else ""
    return (
        f"The block as control places it lies off its GNSS positions, all alike (adjusted minus measured): "
        f"{along_axes(residual_m, '+.2f')}{sigma}, where one position has sigmas of {along_axes(known, '.2g')}; {how}. "
        "Centimetres and decimetres are the antenna's offset or a base beside its mark; metres and tens of metres two "
        f"datums or height systems; hundreds a wrong zone or swapped axes of one of the two.{named}"
    )


def _set_aside(
    name: str,
    axes: Sequence[int],
    off_m: Sequence[float],
    std_m: Sequence[float],
    over_sigma: float,
    limit: float,
    rivals: Sequence[str],
) -> str:
    where = "in height" if list(axes) == [2] else "across" if 2 not in axes else "across and in height"
    return (
        f"Control point {name} contradicts photos, positions and the other control points {where}: they place it "
        f"{along_axes(off_m, '+.3f')} from where it was surveyed (sigma {along_axes(std_m, '.2g')}; {over_sigma:.1f} "
        f"sigmas where {limit:g} are exceeded by chance in one of a thousand). It does not hold the block {where}. "
        f"Check its coordinates, its name and its marks.{_or(rivals)}"
    )


def _exchanged(names: Sequence[str], apart_m: float, rivals: Sequence[str]) -> str:
    first, second = names
    return (
        f"The labels of control points {first} and {second} are exchanged: each lies where the other was surveyed, "
        f"{apart_m:.1f} m away. Neither holds the block. Exchange their coordinates in the list, or the names at their "
        f"marks.{_or(rivals)}"
    )


def _or(rivals: Sequence[str]) -> str:
    return f" {' or '.join(rivals)} would explain it as well: which it is cannot be told." if rivals else ""


_REASONS: dict[str, Callable[..., str]] = {
    "cannot tell": lambda names: (
        f"the contradiction may lie with {' or '.join(names)}, and which cannot be told. Survey or mark one point more "
        "near them"
    ),
    "most are wrong": lambda names: (
        f"most of the control points contradict the block ({', '.join(names)}). Check the list's CRS, its heights, its "
        "names and marks"
    ),
    "not settled": lambda names: (
        f"which control points are wrong ({', '.join(names) or 'none of them'}?) depends on which hold the block. Look "
        "at all of them, and survey more"
    ),
    "survey scatters": lambda times: (
        f"control points scatter by {times:g} times their sigmas or more: that is no survey of them. Check the list's "
        "CRS, its heights, its names and marks, or state what they are good to (control.std_h, control.std_v)"
    ),
    "check points shifted": lambda shift_m: (
        f"the block stands {along_axes(shift_m, '+.3f')} from where all check points say. Correct positions or control "
        "by it, whichever is wrong"
    ),
}


def _not_usable(reasons: Sequence[Mapping[str, Any]]) -> str:
    texts = [_REASONS[one["reason"]](**{k: v for k, v in one.items() if k != "reason"}) for one in reasons]
    return f"DO NOT USE this result: {'; '.join(texts)}; then run again."


CONTROL_WORDS: dict[str, Callable[..., str]] = {
    "do not use": _not_usable,
    "control point set aside": _set_aside,
    "control labels exchanged": _exchanged,
    "control without a place": _without_a_place,
    "control not marked twice": _not_marked_twice,
    "few control points": _few,
    "control on a line": _on_a_line,
    "control horizontal only": _horizontal_only,
    "marks contradict": _marks_contradict,
    "marks off": _marks_off,
    "marks disagree": _marks_disagree,
    "control scatters": _scatters,
    "check points shifted": _shifted,
    "control point contradicts": _contradicts,
    "gnss off control": _gnss_off,
}
CONTROL_KINDS = tuple(CONTROL_WORDS)
