"""What a run tells of scale bars."""

import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from jaxba.engine._words import many, some
from jaxba.scene import BarFit, ScaleBars

Facts = Sequence[dict[str, Any]]


def bar_facts(bars: ScaleBars, fit: BarFit | None = None) -> list[dict[str, Any]]:
    """Return the bars and, once it is known, how the result fits them, as plain values."""
    facts = []
    for k, (one, other) in enumerate(zip(bars.first, bars.second, strict=True)):
        row: dict[str, Any] = {
            "first": bars.ends.names[one],
            "second": bars.ends.names[other],
            "length_m": float(bars.length_m[k]),
            "std_m": float(bars.std_m[k]),
            "role": "check" if bars.is_check[k] else "control",
        }
        if fit is not None:
            row |= {
                "adjusted_m": float(fit.distance_m[k]),
                "adjusted_std_m": float(fit.distance_std_m[k]),
                "residual_m": float(fit.residual_m[k]),
                "over_sigma": float(fit.over_sigma[k]),
                "used": bool(fit.is_used[k]),
                "set_aside": bool(fit.is_set_aside[k]),
            }
        facts.append(row)
    return facts


def bar_rows(facts: Facts | None) -> list[tuple[str, str]]:
    """Return the rows of the summary in the terminal: RMS of the bars that took part, and of the others."""
    rows = []
    for said in ("used", "set aside", "compared alone"):
        found = [bar for bar in facts or () if _became(bar) == said and _is_known(bar["residual_m"])]
        if found:
            rms = math.sqrt(sum(bar["residual_m"] ** 2 for bar in found) / len(found))
            worst = max(found, key=lambda bar: abs(bar["residual_m"]))
            off = f"worst {worst['first']}-{worst['second']} by {worst['residual_m']:+.4f} m"
            rows.append(("scale bars", f"RMS {rms:.4f} m over {many(len(found), 'bar')} {said}; {off}"))
    return rows


def _became(bar: dict[str, Any]) -> str:
    return "used" if bar["used"] else "set aside" if bar["set_aside"] else "compared alone"


def _is_known(value: float | None) -> bool:
    return value is not None and bool(np.isfinite(value))


def _without_ends(names: Sequence[str]) -> str:
    return (
        f"Scale bars of which fewer than two adjusted photos show an end: {some(list(names))}; mark the ends in more "
        "photos."
    )


def _contradicts(
    name: str, length_m: float, residual_m: float, over_sigma: float, limit: float, is_set_aside: bool
) -> str:
    than = "longer" if residual_m > 0 else "shorter"
    said = "It was set aside." if is_set_aside else "It took no part."
    return (
        f"Scale bar {name} contradicts the block: there it is {abs(residual_m):.3f} m {than} than the {length_m:g} m "
        f"that were measured, {over_sigma:.1f} sigma (limit {limit:g}). {said} Check the length, its unit and the "
        "marks."
    )


def _contradict_each_other(names: Sequence[str], has_scale: bool) -> str:
    without = "" if has_scale else ", and the block has no scale"
    return (
        f"Scale bars {some(list(names))} contradict each other, and nothing tells which is wrong: all of them were set "
        f"aside{without}. Check their lengths, units and marks."
    )


def _not_tested(names: Sequence[str]) -> str:
    return (
        f"Scale bars {some(list(names))} hold the block and were not tested against it, since sigmas could not be "
        "computed; compare their lengths by other means, or mend what the sigmas lack."
    )


def _scale(count: int) -> str:
    return f"{many(count, 'scale bar')} told the scale of a block that has no place on earth: it is in metres."


BAR_WORDS: dict[str, Callable[..., str]] = {
    "scale bars without ends": _without_ends,
    "scale bar contradicts": _contradicts,
    "scale bars contradict each other": _contradict_each_other,
    "scale bars not tested": _not_tested,
    "scale by bars": _scale,
}
