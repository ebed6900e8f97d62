"""Findings on control: what a surveyor should know of the points, each a kind with its figures."""

import numpy as np
from jaxtyping import Bool

from jaxba.scene import Block, Control, ControlFit, Finding, Photo, Reference
from jaxba.sfm._adjust import Adjusted
from jaxba.sfm._measured import OUTLIER, used_positions
from jaxba.sfm._problem import is_collinear
from jaxba.sfm.control._control import LEAST_TO_PLACE, image_rows
from jaxba.sfm.control._explained import MOST_SCALE, Explained
from jaxba.sfm.control._fit import LEAST_OF
from jaxba.sfm.control._misclosure import Mistake
from jaxba.sfm.control._start import determines_tilt

_OFFSET = 3.0  # sigmas of a position, after a fit
_HEIGHT_UNITS = {"feet as metres": 0.3048, "metres as feet": 1 / 0.3048}  # true heights over those of the list
_LEAST_FEET_M, _SAME_UNIT = 20.0, 0.03  # below it anything looks so; relative, of what the unit makes
_MARKS_OFF = 5.0  # sigmas of a mark, in the median


def control_findings(
    adjusted: Adjusted, control: Control, fit: ControlFit, reference: Reference, photos: tuple[Photo, ...]
) -> tuple[Finding, ...]:
    """Return the findings on the control and check points of an adjusted block."""
    if not control.num_points:
        return ()
    block = adjusted.block
    explained = _explained(adjusted, fit)
    return tuple(
        [
            *_not_usable(control, adjusted, fit, explained),
            *_not_tested(adjusted),
            *_unused(block, control, fit),
            *_too_few(block, control, fit, reference),
            *_wrong_marks(block, adjusted, control, fit, photos),
            *_scatter(control, fit),
            *_shifted(control, fit),
            *_set_aside(control, fit, explained),
            *_suspects(control, fit),
            *_offset(block, control, fit, reference, explained),
        ]
    )


def _unused(block: Block, control: Control, fit: ControlFit) -> list[Finding]:
    if not block.is_georeferenced:
        return [Finding.of("control without a place")]
    lost = ~np.isfinite(fit.adjusted_m[:, 0])
    if not lost.any():
        return []
    names = [name for name, is_lost in zip(control.names, lost, strict=True) if is_lost]
    return [Finding.of("control not marked twice", names=names, marks=fit.num_marks[lost].tolist())]


def _too_few(block: Block, control: Control, fit: ControlFit, reference: Reference) -> list[Finding]:
    use = ~control.is_check & np.isfinite(fit.adjusted_m).all(axis=1)
    if control.method == "none" or not (~control.is_check).any() or not block.is_georeferenced:
        return []
    count = int(use.sum())
    found = []
    least = LEAST_OF.get(control.method, LEAST_TO_PLACE)
    if count < least:
        found.append(Finding.of("few control points", count=count, least=least, is_fit=control.method in LEAST_OF))
    elif is_collinear(control.xyz_m[use]):
        found.append(Finding.of("control on a line", count=count))
    elif not determines_tilt(control.xyz_m[use], control.std_m[use]):
        index = block.image_index[used_positions(block, reference)]
        if not np.isfinite(reference.std_m[index, 2]).any():
            found.append(Finding.of("control horizontal only"))
    return found


def _wrong_marks(
    block: Block, adjusted: Adjusted, control: Control, fit: ControlFit, photos: tuple[Photo, ...]
) -> list[Finding]:
    wrong = np.flatnonzero((image_rows(block, control) >= 0) & ~adjusted.mark_used)
    found = []
    if len(wrong):
        marks = [[control.names[control.mark_point[k]], photos[control.mark_image[k]].name] for k in wrong]
        found.append(Finding.of("marks contradict", marks=marks, std_px=float(control.mark_std_px)))
    known = np.isfinite(fit.mark_rms_px)
    if known.any():
        median = float(np.median(fit.mark_rms_px[known]))
        worst = int(np.nanargmax(fit.mark_rms_px))
        rms_px = float(fit.mark_rms_px[worst])
        if median > _MARKS_OFF * control.mark_std_px:
            found.append(Finding.of("marks off", median_px=median, std_px=float(control.mark_std_px)))
        elif rms_px > _MARKS_OFF * control.mark_std_px:
            marks, name = int(fit.num_marks[worst]), control.names[worst]
            found.append(Finding.of("marks disagree", marks=marks, name=name, rms_px=rms_px))
    return found


def _scatter(control: Control, fit: ControlFit) -> list[Finding]:
    known = ~control.is_check & np.isfinite(fit.adjusted_m).all(axis=1)
    axes, scatter_m, stated_m = [], [], []
    for word, axis, scale in (("horizontally", 0, fit.scale[0]), ("in height", 2, fit.scale[1])):
        if scale > 1:
            stated = float(np.median(control.std_m[known, axis]))
            axes.append(word)
            scatter_m.append(float(scale * stated))
            stated_m.append(stated)
    if not axes:
        return []
    count = int(known.sum())
    return [Finding.of("control scatters", count=count, axes=axes, scatter_m=scatter_m, stated_m=stated_m)]


def _explained(adjusted: Adjusted, fit: ControlFit) -> Explained:
    """Return what is wrong with control in the adjustment; nothing where it took no part."""
    if adjusted.on_control is None or fit.method != "adjust":
        return Explained(len(fit.is_suspect))
    return adjusted.on_control.explained


def _not_tested(adjusted: Adjusted) -> list[Finding]:
    why_not = None if adjusted.on_control is None else adjusted.on_control.why_not
    return [Finding.of("note", text=f"Control points were not tested. {why_not}")] if why_not else []


def _not_usable(control: Control, adjusted: Adjusted, fit: ControlFit, explained: Explained) -> list[Finding]:
    """The verdict that a result must not be used, with its reasons."""
    reasons = []
    for mistake in explained.mistakes:
        if mistake.rivals:
            names = [_culprit(control, one) for one in (mistake, *mistake.rivals)]
            reasons.append({"reason": "cannot tell", "names": names})
    used = ~control.is_check & np.isfinite(fit.adjusted_m).all(axis=1)
    wrong = {mistake.points[0] for mistake in explained.mistakes if mistake.kind == "point"}
    if 2 * len(wrong) > used.sum() > 1:
        reasons.append({"reason": "most are wrong", "names": [control.names[k] for k in sorted(wrong)]})
    if adjusted.on_control is not None and not adjusted.on_control.is_settled:
        names = [control.names[k] for k in np.flatnonzero(explained.wrong.any(axis=1))]
        reasons.append({"reason": "not settled", "names": names})
    if max(explained.scale) >= MOST_SCALE:
        reasons.append({"reason": "survey scatters", "times": MOST_SCALE})
    if _is_shifted(fit).any():
        reasons.append({"reason": "check points shifted", "shift_m": fit.check_shift_m.tolist()})
    return [Finding.of("do not use", reasons=reasons)] if reasons else []


def _culprit(control: Control, mistake: Mistake) -> str:
    if mistake.kind == "common":
        return "all positions in common"
    return " with ".join(control.names[k] for k in mistake.points)


def _is_shifted(fit: ControlFit) -> Bool[np.ndarray, "3"]:
    with np.errstate(invalid="ignore"):
        return np.abs(fit.check_shift_m) > OUTLIER * fit.check_shift_std_m


def _set_aside(control: Control, fit: ControlFit, explained: Explained) -> list[Finding]:
    """Control that contradicts all else, as it was explained: points, and labels exchanged."""
    found = []
    for mistake in explained.mistakes:
        rivals = [_culprit(control, rival) for rival in mistake.rivals]
        if mistake.kind == "swapped":
            names = [control.names[k] for k in mistake.points]
            apart_m = float(np.linalg.norm(control.xyz_m[mistake.points[0]] - control.xyz_m[mistake.points[1]]))
            found.append(Finding.of("control labels exchanged", names=names, apart_m=apart_m, rivals=rivals))
    exchanged = {k for mistake in explained.mistakes if mistake.kind == "swapped" for k in mistake.points}
    for k in np.flatnonzero(fit.is_set_aside.any(axis=1)):
        if int(k) in exchanged:
            continue
        mine = [m for m in explained.mistakes if m.kind == "point" and m.points == (int(k),)]
        axes = sorted({axis for m in mine for axis in m.axes})
        found.append(
            Finding.of(
                "control point set aside",
                name=control.names[k],
                axes=axes,
                off_m=[float(fit.without_m[k, axis]) if axis in axes else float("nan") for axis in range(3)],
                std_m=[float(fit.without_std_m[k, axis]) if axis in axes else float("nan") for axis in range(3)],
                over_sigma=float(fit.over_sigma[k]),
                limit=OUTLIER,
                rivals=sorted({_culprit(control, rival) for m in mine for rival in m.rivals}),
            )
        )
    return found


def _shifted(control: Control, fit: ControlFit) -> list[Finding]:
    """Check points that are all off alike: the block's place, and none of them, is wrong."""
    if not _is_shifted(fit).any():
        return []
    count = int(np.count_nonzero(control.is_check & np.isfinite(fit.adjusted_m).all(axis=1)))
    return [
        Finding.of(
            "check points shifted",
            count=count,
            shift_m=fit.check_shift_m.tolist(),
            std_m=fit.check_shift_std_m.tolist(),
            is_controlled=fit.method != "none",
        )
    ]


def _suspects(control: Control, fit: ControlFit) -> list[Finding]:
    return [
        Finding.of(
            "control point contradicts",
            name=control.names[k],
            is_check=bool(control.is_check[k]),
            residual_m=fit.residual_m[k].tolist(),
            over_sigma=float(fit.over_sigma[k]),
            limit=OUTLIER,
            method=fit.method,
        )
        for k in np.flatnonzero(fit.is_suspect & ~fit.is_set_aside.any(axis=1))
    ]


def _offset(
    block: Block, control: Control, fit: ControlFit, reference: Reference, explained: Explained
) -> list[Finding]:
    """Positions that are off in common: as tests of the adjustment say, or after a fit by their sigmas."""
    offset = fit.gnss_minus_control_m
    index = block.image_index[used_positions(block, reference)]
    if not len(index) or not np.isfinite(offset).any():
        return []
    std = np.median(reference.std_m[index], axis=0)
    if fit.method == "adjust":
        is_off = explained.is_shifted
    else:
        with np.errstate(invalid="ignore"):
            is_off = np.abs(offset) > _OFFSET * std
    if not is_off.any():
        return []
    return [
        Finding.of(
            "gnss off control",
            offset_m=offset.tolist(),
            offset_std_m=fit.gnss_minus_control_std_m.tolist(),
            std_m=std.tolist(),
            is_compared=fit.method == "none",
            looks_like=_looks_like(float(offset[2]), _height_m(control, fit, reference)),
        )
    ]


def _height_m(control: Control, fit: ControlFit, reference: Reference) -> float:
    """Return the median height of the control points, as their list has it; NaN where none has one."""
    used = ~control.is_check & np.isfinite(control.std_m[:, 2]) & np.isfinite(fit.adjusted_m[:, 2])
    if reference.frame is None or not used.any():
        return float("nan")
    return reference.frame.height_m + float(np.median(control.xyz_m[used, 2]))


def _looks_like(off_up_m: float, height_m: float) -> str:
    """Return which usual mistake makes positions and control differ by so much in height; empty for none.

    >>> _looks_like(250.0 - 250.0 / 0.3048, 250.0 / 0.3048)
    'feet as metres'
    """
    for name, factor in _HEIGHT_UNITS.items():
        expected_m = height_m * (factor - 1)
        if abs(expected_m) > _LEAST_FEET_M and abs(off_up_m - expected_m) < _SAME_UNIT * abs(expected_m):
            return name
    return ""
