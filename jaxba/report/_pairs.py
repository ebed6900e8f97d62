"""What is said of candidate pairs: thresholds, models, which figure a pair missed, the fallback to SIFT."""

import enum
from typing import Any

import numpy as np
from jaxtyping import UInt8

from jaxba.scene import Fallback, Missed, Model, PairRecord, ViewGraph


def pair_facts(graph: ViewGraph, record: PairRecord) -> dict[str, Any]:
    """Return how many pairs got which threshold and model, missed which figure, and fell back or why not."""
    thresholds, counts = np.unique(record.threshold_px, return_counts=True)
    return {
        "pairs": len(graph.pairs),
        "matches": len(graph.matches),
        "thresholds_px": {f"{t:g}": int(count) for t, count in zip(thresholds, counts, strict=True)},
        "models": _counts(Model, record.model),
        "missed": _counts(Missed, record.missed),
        "fallback": _counts(Fallback, record.fallback),
    }


def pair_lines(graph: ViewGraph, record: PairRecord) -> list[str]:
    """Return the same in sentences, with the ranges of the figures."""
    if len(graph.pairs) == 0:
        return []
    facts = pair_facts(graph, record)
    most_first = sorted(facts["thresholds_px"].items(), key=lambda entry: -entry[1])
    models = ", ".join(f"{count:,} {name}" for name, count in facts["models"].items() if name != "none")
    lines = [
        f"RANSAC threshold {', '.join(f'{t} px on {_pairs(count)}' for t, count in most_first)}.",
        f"The better model: {models or 'none of any pair'}.",
    ]
    matches, verified = graph.num_putative, record.num_verified
    share = np.rint(100 * verified / np.maximum(matches, 1)).astype(int)
    few, unverified, weak, loose = (record.missed == missed for missed in list(Missed)[1:])
    rejected = [
        (few, f"{{}} with {_range(matches[few])} matches before verification"),
        (unverified, f"{{}} with {_range(verified[unverified])} verified of {_range(matches[unverified])}"),
    ]
    weaker = [
        (weak, f"{{}} with {_range(verified[weak])} verified matches (match.min_good)"),
        (loose, f"{{}} with {_range(share[loose])}% of the matches verified (match.min_inlier_ratio)"),
    ]
    for word, found in (
        ("No overlap, or none found (match.min_inliers)", rejected),
        ("Weak", weaker),
    ):
        texts = [text.format(_pairs(int(rows.sum()))) for rows, text in found if rows.any()]
        if texts:
            lines.append(f"{word}: {', '.join(texts)}.")
    return lines + _fallback_lines(record)


def _fallback_lines(record: PairRecord) -> list[str]:
    taken, worse, fine, unknown = (record.fallback == fallback for fallback in list(Fallback)[1:])
    texts = []
    if taken.any():
        texts.append(f"{_pairs(int(taken.sum()))} matched with SIFT")
    if worse.any():
        texts.append(f"{_pairs(int(worse.sum()))} no better with SIFT")
    if fine.any():
        gsd_cm = np.round(100 * record.gsd_m[fine], 1)
        texts.append(
            f"{_pairs(int(fine.sum()))} too fine for SIFT, {_range(gsd_cm)} cm/px (match.fallback_gsd); "
            f"{int((fine & _is_rejected(record)).sum())} of these are rejected"
        )
    if unknown.any():
        texts.append(
            f"{_pairs(int(unknown.sum()))} without a known ground sample distance, as match.fallback_gsd asks for; "
            f"{int((unknown & _is_rejected(record)).sum())} of these are rejected"
        )
    return [f"Not good with ORB: {'; '.join(texts)}."] if texts else []


def _is_rejected(record: PairRecord) -> Any:
    return np.isin(record.missed, [Missed.MATCHES, Missed.VERIFIED])


def _counts(kind: type[enum.IntEnum], codes: UInt8[np.ndarray, " pairs"]) -> dict[str, int]:
    names = [entry.name.lower() for entry in kind]
    return {name: int((codes == code).sum()) for code, name in enumerate(names) if (codes == code).any()}


def _pairs(count: int) -> str:
    return f"{count:,} pair{'' if count == 1 else 's'}"


def _range(values: Any) -> str:
    low, high = (values.min(), values.max()) if len(values) else (0, 0)
    return f"{low:g}" if low == high else f"{low:g} to {high:g}"
