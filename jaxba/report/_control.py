"""What a run tells of control and check points."""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from jaxba.engine._words import many
from jaxba.scene import Control, ControlFit, LeftOut, ScaleBars

_SHOWN = 10
_AXES = ("east", "north", "up")


def control_lines(control: Control, notes: Sequence[str], left_out: Sequence[LeftOut], bars: ScaleBars) -> list[str]:
    """Return what there is of control in a line, then the notes on it and what cannot be used."""
    if not control.num_points and not notes and not bars.num:
        return ["no list of control points"]
    checks = int(control.is_check.sum())
    count = control.num_points - checks
    first = f"{many(count, 'control point')}, {many(checks, 'check point')}"
    if bars.num:
        first = f"{first}, {many(bars.num, 'scale bar')}"
    marked = np.concatenate(
        [np.column_stack([of.mark_image, of.mark_xy_px]) for of in (control, bars.ends)]
    )  # those of a control point at the end of a bar stand in both
    first = f"{first}; {many(len(np.unique(marked, axis=0)), 'mark')}"
    images = len(np.unique(marked[:, 0]))
    left = [f"Left out: {entry.name}: {entry.reason}." for entry in left_out]
    if len(left) > _SHOWN:
        left = [*left[:_SHOWN], f"and {len(left) - _SHOWN} more such, each with its reason in summary.json."]
    return [f"{first} in {many(images, 'photo')}", *notes, *left]


def control_facts(control: Control, fit: ControlFit | None = None) -> dict[str, Any]:
    """Return the points and, once it is known, how the result fits them, as plain values."""
    facts: dict[str, Any] = {}
    if fit is not None:
        use = np.isfinite(fit.residual_m).any(axis=1)
        for role, rms, mine in (("control", fit.control_rms_m, ~control.is_check), ("check", fit.check_rms_m, None)):
            facts[role] = _group(control, fit, rms, use & (control.is_check if mine is None else mine))
        facts |= {
            "method": fit.method,
            "gnss_minus_control_m": fit.gnss_minus_control_m.tolist(),
            "gnss_minus_control_std_m": fit.gnss_minus_control_std_m.tolist(),
            "scale": fit.scale.tolist(),
        }
    facts["points"] = [_point(control, fit, k) for k in range(control.num_points)]
    return facts


def control_rows(facts: dict[str, Any] | None) -> list[tuple[str, str]]:
    """Return the rows of the summary in the terminal: RMS of control and of check points, and the worst of each."""
    rows = []
    for role in ("control", "check"):
        group = (facts or {}).get(role)
        if group is None or not group["num"]:
            continue
        axes = zip(("east", "north", "up"), group["rms_m"], strict=True)
        used = {axis: value for axis, value in axes if value is not None}
        figures = ", ".join(f"{value:.3f}" for value in used.values())
        text = f"RMS {figures} m {', '.join(used)} over {many(group['num'], 'point')}"
        rows.append((role, f"{text}; worst {group['worst']} by {group['worst_m']:.3f} m"))
    unseen = _unseen((facts or {}).get("points", []))
    return [*rows, ("control", unseen)] if unseen else rows


def _unseen(points: Sequence[dict[str, Any]]) -> str:
    """Return which error of a control point the others would not show, the largest across and up."""
    texts = []
    for axes, word in (((0, 1), "across"), ((2,), "in height")):
        found = [(max(known), point["name"]) for point in points if (known := _known(point, axes))]
        if found:
            largest, name = max(found)
            size = f"under {largest:.2f} m" if math.isfinite(largest) else "of any size"
            texts.append(f"an error of {name} {size} {word}")
    return f"{' and '.join(texts)} would not show" if texts else ""


def _known(point: dict[str, Any], axes: Sequence[int]) -> list[float]:
    values = point.get("detectable_m") or []
    return [values[axis] for axis in axes if values and values[axis] is not None and not math.isnan(values[axis])]


def _group(control: Control, fit: ControlFit, rms_m: np.ndarray, rows: np.ndarray) -> dict[str, Any]:
    """Return the figures of the control or of the check points that have residuals."""
    result: dict[str, Any] = {"num": int(rows.sum()), "rms_m": rms_m.tolist()}
    if rows.any():
        length = np.where(rows, np.sqrt(np.nansum(fit.residual_m**2, axis=1)), -1.0)
        worst = int(np.argmax(length))
        horizontal = np.where(rows, np.hypot(fit.residual_m[:, 0], fit.residual_m[:, 1]), np.nan)
        result |= {
            "rms_horizontal_m": float(np.sqrt(np.nanmean(horizontal**2))),
            "worst": control.names[worst],
            "worst_m": float(length[worst]),
        }
    return result


def _point(control: Control, fit: ControlFit | None, k: int) -> dict[str, Any]:
    marks = int(np.count_nonzero(control.mark_point == k))
    result = {"name": control.names[k], "role": "check" if control.is_check[k] else "control", "marks": marks}
    if fit is None:
        return result
    return result | {
        "marks_used": int(fit.num_marks[k]),
        "residual_m": fit.residual_m[k].tolist(),
        "std_m": fit.std_m[k].tolist(),
        "mark_rms_px": float(fit.mark_rms_px[k]),
        "over_sigma": float(fit.over_sigma[k]),
        "set_aside": [axis for axis, aside in zip(_AXES, fit.is_set_aside[k], strict=True) if aside],
        "without_m": fit.without_m[k].tolist(),
        "without_std_m": fit.without_std_m[k].tolist(),
        "detectable_m": fit.detectable_m[k].tolist(),
        "reach_m": fit.reach_m[k].tolist(),
        "suspect": bool(fit.is_suspect[k]),
    }
