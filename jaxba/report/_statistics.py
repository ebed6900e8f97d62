"""What a run tells of its statistics: how each kind of measurement scatters, how well the camera is known."""

import math
from typing import Any

import numpy as np

from jaxba.scene import SurveyStatistics

_CORRELATED = 0.8
_SHOWN = 6
_WORDS = {
    "position horizontal": "positions across",
    "position vertical": "positions up",
    "control horizontal": "control across",
    "control vertical": "control up",
    "attitude": "attitudes",
    "scale bar": "scale bars",
}


def statistics_facts(found: SurveyStatistics | None) -> dict[str, Any] | None:
    """Return the statistics as plain values; None where there are none."""
    if found is None:
        return None
    return {
        "redundancy": found.redundancy,
        "kinds": [{name: _or_none(value) for name, value in vars(kind).items()} for kind in found.kinds],
        "unknowns": list(found.unknowns),
        "unknown_std": found.unknown_std.tolist(),
        "correlation": [[_or_none(value) for value in row] for row in found.correlation.tolist()],
    }


def statistics_rows(facts: dict[str, Any] | None) -> list[tuple[str, str]]:
    """Return the rows of the summary in the terminal."""
    if facts is None:
        return []
    known = [_text(kind) for kind in facts["kinds"] if kind["is_known"] and kind["std"] is not None]
    few = [_name(kind) for kind in facts["kinds"] if not kind["is_known"]]
    rows = []
    if known:
        untold = f"; too little redundancy to tell those of {' and '.join(few)}" if few else ""
        rows.append(("scatter", f"{', '.join(known)}{untold}"))
    pairs = _correlated(facts)
    if pairs:
        rows.append(("correlated", ", ".join(pairs[:_SHOWN])))
    return rows


def _or_none(value: Any) -> Any:
    return None if isinstance(value, float) and math.isnan(value) else value


def _text(kind: dict[str, Any]) -> str:
    decimals = 1 if kind["unit"] == "deg" else 3 if kind["unit"] == "m" and kind["std"] < 1 else 2
    text = f"{_name(kind)} {kind['std']:.{decimals}f} {kind['unit']}"
    taken = kind["taken_std"]
    return text if taken is None else f"{text} (taken as {taken:.{decimals}f})"


def _name(kind: dict[str, Any]) -> str:
    name = str(kind["name"])
    return _WORDS.get(name, name)


def _correlated(facts: dict[str, Any]) -> list[str]:
    """Return the pairs of shared unknowns that are strongly correlated, the strongest first."""
    names, matrix = facts["unknowns"], np.nan_to_num(np.array(facts["correlation"], float))
    if not len(names):
        return []
    first, second = np.nonzero(np.triu(np.abs(matrix) >= _CORRELATED, 1))
    order = np.argsort(-np.abs(matrix[first, second]), kind="stable")
    return [f"{names[first[k]]} and {names[second[k]]} {matrix[first[k], second[k]]:+.2f}" for k in order]
