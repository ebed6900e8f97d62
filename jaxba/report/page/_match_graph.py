"""The map of the pairs of photos that were matched.

A block of 500 photos has 10,000 pairs and more. The page holds the numbers of their photos alone, packed, and `page.js`
joins the places of these by lines.
"""

from collections.abc import Iterable
from typing import Any

import numpy as np

from jaxba.report.page._drawing import GREY, ORANGE, PURPLE, VERMILLION, Figure, map_of, marker_size, packed, plain
from jaxba.report.page._photo_maps import photo_markers, place

_MOST_PAIRS_TO_POINT_AT = 1500  # each is an element of its own in the page, which is slow by the ten thousand
_REFUTED = {"rejected": (VERMILLION, "dot"), "pruned": (PURPLE, "dashdot"), "weak": (ORANGE, "dash")}


def match_graph(report: dict[str, Any]) -> Figure | None:
    """Return the photos with a line for each pair that was matched; None where there is none."""
    found = report["pairs"]
    places = np.array([place(photo) or (np.nan, np.nan) for photo in report["photos"]], float).reshape(-1, 2)
    if "none" in found or not found["first"]:
        return None
    ends = np.array([found["first"], found["second"]], np.int64).T
    shown = np.flatnonzero(np.isfinite(places[ends]).all(axis=(1, 2)))
    if not len(shown):
        return None
    area = map_of(report["project"], places[np.isfinite(places).all(axis=1)])
    kind = "u2" if len(places) < 2**16 else "u4"
    states, matches = np.array(found["state"])[shown], np.array(found["matches"])[shown]
    data = [
        {"type": "scatter", "mode": "lines", "name": name, "line": line, "hoverinfo": "skip",
         "opacity": 0.5 if name == "rejected" else 1, "ends": packed(ends[shown[mine]].ravel(), kind)}
        for name, line, mine in _match_groups(states, matches, marker_size(len(places), 1.0))
    ]  # fmt: skip
    if len(shown) <= _MOST_PAIRS_TO_POINT_AT:
        data.append(_pair_texts(report["photos"], places, found, shown))
    photos = [photo for photo in report["photos"] if place(photo)]
    data.append(photo_markers("photo", photos, {"size": marker_size(len(photos), 7.0), "color": "@ink"}))
    hidden = len(ends) - len(shown)
    return Figure(
        name="matches", title="Which photos are tied together", ratio=area.ratio, data=data, layout=area.layout(),
        places=packed(np.nan_to_num(places), "f8"),
        caption="Each line joins two photos that show the same ground; the stronger the line, the more matches tie "
        "them together. A block with a gap in this net, or with a thin place, can bend there. Pairs that were "
        "rejected show different ground, or their matches contradict each other; pairs that were pruned contradict "
        "the rest of the block."
        + (f" {hidden:,} pairs of photos without a position are not drawn." if hidden else ""),
    )  # fmt: skip


def _match_groups(
    states: np.ndarray, matches: np.ndarray, width: float
) -> Iterable[tuple[str, dict[str, Any], np.ndarray]]:
    """Yield name, line and pairs of what is drawn alike: what did not hold first, then by the number of matches.

    - `width`: 1 for lines of the usual width, less where there are many.
    """
    for state, (colour, dash) in _REFUTED.items():
        group = np.flatnonzero(states == state)
        if len(group):
            yield state, {"color": colour, "width": width, "dash": dash}, group
    good = np.flatnonzero(states == "good")
    if not len(good):
        return
    counts = matches[good]
    steps = sorted({int(float(f"{value:.1g}")) for value in np.percentile(counts, [25, 50, 75]) if value >= 1})
    kinds = np.digitize(counts, steps)
    for k in range(len(steps) + 1):
        low, high = (steps[k - 1] if k else int(counts.min())), (steps[k] - 1 if k < len(steps) else None)
        group = good[kinds == k]
        if len(group):
            name = f"{low:,} matches or more" if high is None else f"{low:,} to {high:,}"
            yield name, {"color": f"@step-{k + 4 - len(steps)}", "width": (0.8 + 0.5 * k) * width}, group


def _pair_texts(
    photos: list[dict[str, Any]], places: np.ndarray, found: dict[str, Any], shown: np.ndarray
) -> dict[str, Any]:
    """Return unseen markers amid the lines that tell what each pair is."""
    texts, ends = [], np.array([found["first"], found["second"]]).T[shown]
    for k in shown.tolist():
        names = ", ".join(plain(photos[found[end][k]]["name"]) for end in ("first", "second"))
        facts = [f"{found['matches'][k]:,} of {found['putative'][k]:,} matches hold"]
        facts += [] if found["median_px"][k] is None else [f"median {found['median_px'][k]:.2f} px"]
        facts += [] if found["angle_deg"][k] is None else [f"rays meet at {found['angle_deg'][k]:.1f}°"]
        texts.append(f"<b>{names}</b><br>{found['state'][k]}: {', '.join(facts)}")
    middle = places[ends].mean(axis=1)
    return {
        "type": "scatter", "mode": "markers", "showlegend": False, "marker": {"size": 9, "color": GREY, "opacity": 0},
        "x": middle[:, 0].tolist(), "y": middle[:, 1].tolist(), "text": texts,
        "hovertemplate": "%{text}<extra></extra>",
    }  # fmt: skip
