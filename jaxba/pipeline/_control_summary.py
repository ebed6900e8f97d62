"""What a run tells of control and check points."""

from typing import Any

import numpy as np

_SHOWN = 10


def control_lines(outputs: Any) -> tuple[str, list[str]]:
    """Return what the control stage made in a line, and its notes."""
    control = outputs.control
    if not control.num_points and not outputs.notes:
        return "no list of control points", []
    checks = int(control.is_check.sum())
    count = control.num_points - checks
    first = f"{_many(count, 'control point')}, {_many(checks, 'check point')}; {_many(len(control.mark_point), 'mark')}"
    images = len(np.unique(control.mark_image))
    left = [f"Left out: {entry.name}: {entry.reason}." for entry in outputs.left_out]
    if len(left) > _SHOWN:
        left = [*left[:_SHOWN], f"and {len(left) - _SHOWN} more such, each with its reason in summary.json."]
    return f"{first} in {_many(images, 'photo')}", [*outputs.notes, *left]


def _many(count: int, noun: str) -> str:
    return f"{count:,} {noun}{'' if count == 1 else 's'}"
