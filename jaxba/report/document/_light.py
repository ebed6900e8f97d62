"""A traffic light: a figure held against limits that stand beside it."""

from typing import Any, Literal

import numpy as np

State = Literal["good", "fair", "poor", "unknown"]


def row(name: str, value: str, state: State, text: str, limits: str) -> dict[str, Any]:
    """Return a light: what is judged, its value with the unit, the state, what it is, and by which limits."""
    return {"name": name, "value": value, "state": state, "text": text, "limits": limits}


def unknown(name: str, text: str, limits: str) -> dict[str, Any]:
    """Return the light of a figure that is not known; `text`: why."""
    return row(name, "", "unknown", text, limits)


def low(value: float, limits: tuple[float, float]) -> State:
    """Return the state of a figure that is the better, the lower it is."""
    if not np.isfinite(value):
        return "unknown"
    return "good" if value <= limits[0] else "fair" if value <= limits[1] else "poor"


def high(value: float, limits: tuple[float, float]) -> State:
    """Return the state of a figure that is the better, the higher it is."""
    return low(-value, (-limits[0], -limits[1]))
