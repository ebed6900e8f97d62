"""Findings on control: what a surveyor should know of the points, each a sentence or two with figures and the cure."""

import numpy as np

from jaxba.scene import Block, Control, ControlFit, Photo, Reference
from jaxba.sfm._adjust import Adjusted
from jaxba.sfm._control import LEAST_TO_PLACE, image_rows
from jaxba.sfm._control_fit import BLUNDER, LEAST_OF
from jaxba.sfm._control_start import determines_tilt
from jaxba.sfm._problem import is_collinear, used_positions

_OFFSET = 3.0  # sigmas of a position
_MARKS_OFF = 5.0  # sigmas of a mark, in the median


def control_findings(
    adjusted: Adjusted, control: Control, fit: ControlFit, reference: Reference, photos: tuple[Photo, ...]
) -> tuple[str, ...]:
    """Return the findings on the control and check points of an adjusted block."""
    if not control.num_points:
        return ()
    block = adjusted.block
    return tuple(
        [
            *_unused(block, control, fit),
            *_too_few(block, control, fit, reference),
            *_wrong_marks(block, adjusted, control, fit, photos),
            *_scatter(control, fit),
            *_suspects(control, fit),
            *_offset(block, fit, reference),
        ]
    )


def _unused(block: Block, control: Control, fit: ControlFit) -> list[str]:
    if not block.is_georeferenced:
        return ["The block has no place on earth, so that its control and check points cannot be compared with it."]
    lost = [
        f"{name} ({count} mark{'' if count == 1 else 's'})"
        for name, count, found in zip(control.names, fit.num_marks, np.isfinite(fit.adjusted_m[:, 0]), strict=True)
        if not found
    ]
    if not lost:
        return []
    return [
        f"Points that are not marked in two adjusted photos or more, and not used: {', '.join(lost)}. Mark them in "
        "more photos."
    ]


def _too_few(block: Block, control: Control, fit: ControlFit, reference: Reference) -> list[str]:
    use = ~control.is_check & np.isfinite(fit.adjusted_m).all(axis=1)
    if control.method == "none" or not (~control.is_check).any() or not block.is_georeferenced:
        return []
    count = int(use.sum())
    found = []
    least = LEAST_OF.get(control.method, LEAST_TO_PLACE)
    if count < least:
        what = "so no fit was made" if control.method in LEAST_OF else "so they do not fix the block by themselves"
        found.append(f"{count} control points can be used where {least} are needed, {what}. Mark more of them.")
    elif is_collinear(control.xyz_m[use]):
        found.append(
            f"The {count} control points lie on a line, so that they do not hold the block from turning about it. "
            "Survey some to its sides."
        )
    elif not determines_tilt(control.xyz_m[use], control.std_m[use]):
        index = block.image_index[used_positions(block, reference)]
        if not np.isfinite(reference.std_m[index, 2]).any():
            found.append(
                "Control is horizontal only and no position has a height, so the block's height and tilt are those of "
                "the start values (cameras look down on average): heights and slopes are not to be relied on. Survey "
                "the heights of three control points or more."
            )
    return found


def _wrong_marks(
    block: Block, adjusted: Adjusted, control: Control, fit: ControlFit, photos: tuple[Photo, ...]
) -> list[str]:
    wrong = np.flatnonzero((image_rows(block, control) >= 0) & ~adjusted.mark_used)
    found = []
    if len(wrong):
        names = ", ".join(
            f"{control.names[control.mark_point[k]]} in {photos[control.mark_image[k]].name}" for k in wrong
        )
        found.append(
            f"Marks that contradict the others of their point by over 5 sigmas (control.mark_std_px="
            f"{control.mark_std_px:g}), left out: {names}. Look at them."
        )
    known = np.isfinite(fit.mark_rms_px)
    if known.any():
        median = float(np.median(fit.mark_rms_px[known]))
        worst = int(np.nanargmax(fit.mark_rms_px))
        if median > _MARKS_OFF * control.mark_std_px:
            found.append(
                f"Marks miss their points by {median:.1f} px in the median (sigma {control.mark_std_px:g} px): were "
                "they set in photos of another size (control.mark_width_px), or counted from another corner?"
            )
        elif fit.mark_rms_px[worst] > _MARKS_OFF * control.mark_std_px:
            found.append(
                f"The {fit.num_marks[worst]} marks of {control.names[worst]} do not agree (RMS "
                f"{fit.mark_rms_px[worst]:.1f} px), and which is wrong cannot be told: look at them, or mark more "
                "photos."
            )
    return found


def _scatter(control: Control, fit: ControlFit) -> list[str]:
    known = ~control.is_check & np.isfinite(fit.adjusted_m).all(axis=1)
    parts = []
    for word, axis, scale in (("horizontally", 0, fit.scale[0]), ("in height", 2, fit.scale[1])):
        if scale > 1:
            stated = float(np.median(control.std_m[known, axis]))
            parts.append(f"{scale * stated:.2g} m {word} where their sigma is {stated:.2g} m")
    if not parts:
        return []
    return [
        f"The {known.sum()} control points contradict the block, most of them and not one: they scatter by "
        f"{', '.join(parts)}. Their sigmas were enlarged to that. Compare how they were surveyed with control.std_h "
        "and control.std_v, and check their CRS, names and marks."
    ]


def _suspects(control: Control, fit: ControlFit) -> list[str]:
    found = []
    for k in np.flatnonzero(fit.is_suspect):
        r = ", ".join(f"{value:+.3f}" if np.isfinite(value) else "none" for value in fit.residual_m[k])
        role = "Check" if control.is_check[k] else "Control"
        part = "" if control.is_check[k] else _PARTS.get(fit.method, "")
        found.append(
            f"{role} point {control.names[k]} contradicts the block: adjusted minus surveyed {r} m east, north, up, "
            f"{fit.over_sigma[k]:.1f} sigmas where {BLUNDER:g} are exceeded by chance in one of a thousand. Check its "
            f"coordinates, its name and its marks.{part}"
        )
    return found


_PARTS = {
    "adjust": " It pulls the block no harder than a point that is off by 3 sigmas; make it a check point "
    "(control.check) to leave it out.",
    "helmert": " It was left out of the fit where others remained.",
    "affine": " It was left out of the fit where others remained.",
}


def _offset(block: Block, fit: ControlFit, reference: Reference) -> list[str]:
    offset = fit.gnss_minus_control_m
    index = block.image_index[used_positions(block, reference)]
    if not len(index) or not np.isfinite(offset).any():
        return []
    std = np.median(reference.std_m[index], axis=0)
    known = np.isfinite(offset) & np.isfinite(std)
    if not (np.abs(offset[known]) > _OFFSET * std[known]).any():
        return []
    figures = ", ".join(f"{value:+.2f}" if np.isfinite(value) else "unknown" for value in offset)
    how = "the block follows control" if fit.method != "none" else "compared only"
    return [
        f"GNSS positions minus the block as control places it: {figures} m east, north, up, for all photos in common, "
        f"with sigmas of {', '.join(f'{s:.2g}' for s in std)} m; {how}. Decimetres are the antenna's offset; metres "
        "and tens of metres two datums or height systems; hundreds a wrong zone or swapped axes of one of the two."
    ]
