"""What the figures of the page have in common: a figure's parts, colours, packed numbers, maps, arrows and their scale.

A figure is data and layout of Plotly as plain dicts. Colours that begin with `@` are those of the page's style sheet
(`@ink`, `@muted`, `@grid`, `@paper`, `@blue`, `@step-1` to `@step-4`), which follow its light or dark look; `page.js`
puts them in. The other colours are those of Okabe and Ito (2008), which colour-blind readers tell apart.
"""

import base64
import html
import json
import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from jaxtyping import Float
from scipy.spatial import KDTree

from jaxba.report.page._tables import number

BLUE, SKY, ORANGE, VERMILLION, PURPLE, GREY = "@blue", "#56b4e9", "#e69f00", "#d55e00", "#cc79a7", "#808a94"
DIVERGING = [[0.0, VERMILLION], [0.5, "rgba(128,138,148,0.12)"], [1.0, "#0072b2"]]
AXES = ("east", "north", "up")

_UNIT_M = {"metre": 1.0, "foot": 0.3048, "US survey foot": 1200 / 3937}
_SHORT = {"metre": "m", "foot": "ft", "US survey foot": "US ft"}


@dataclass(frozen=True, kw_only=True)
class Figure:
    """A figure of the page.

    - `name`: in the page's addresses. `title`, `caption`: what it is and how to read it, for a customer.
    - `data`, `layout`: Plotly's. `ratio`: height over width of the room inside the axes, or `height_px` of the whole.
    - `places`: x, y of what lines join, packed; a trace with `ends` draws lines between them by their numbers.
    - `modes`: ways to colour the first trace, which has no marker of its own: a label, and Plotly's `marker` for it.
    """

    name: str
    title: str
    caption: str
    data: list[dict[str, Any]]
    layout: dict[str, Any]
    ratio: float | None = None
    height_px: int | None = None
    places: dict[str, str] | None = None
    modes: list[dict[str, Any]] = field(default_factory=list)

    def json(self) -> str:
        """Return what `page.js` draws, as JSON that can stand inside a script element."""
        parts = {"data": self.data, "layout": self.layout, "modes": self.modes}
        parts |= {"ratio": self.ratio, "height": self.height_px, "places": self.places}
        text = json.dumps(parts, allow_nan=False, separators=(",", ":"))
        return text.replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026")


def packed(values: Any, dtype: str) -> dict[str, str]:
    """Return an array as Plotly's typed array: `f4`, `u1`, ... in base64, little-endian.

    >>> packed([[1, 2], [3, 4]], "u1")
    {'dtype': 'u1', 'bdata': 'AQIDBA==', 'shape': '2, 2'}
    """
    array = np.ascontiguousarray(values, np.dtype(dtype).newbyteorder("<"))
    found = {"dtype": dtype, "bdata": base64.b64encode(array.tobytes()).decode()}
    return found if array.ndim == 1 else found | {"shape": ", ".join(map(str, array.shape))}


def plain(text: str) -> str:
    """Return a text that Plotly shows as it is, rather than as its markup.

    >>> plain("<b>.jpg")
    '&lt;b&gt;.jpg'
    """
    return html.escape(text, quote=False)


def short_unit(unit: str | None) -> str:
    """Return a unit of coordinates as it stands in headings; nothing in a free frame."""
    return _SHORT.get(unit, unit) if unit else ""


def unit_metres(unit: str | None) -> float | None:
    """Return the length of a unit in metres: a free frame counts as metres, an unknown unit as None."""
    return _UNIT_M.get(unit) if unit else 1.0


def round_down(value: float) -> float:
    """Return the largest 1, 2 or 5 times a power of ten that is not above a positive value.

    >>> [round_down(value) for value in (0.07, 3.0, 1234.0)]
    [0.05, 2.0, 1000.0]
    """
    power = 10.0 ** math.floor(math.log10(value))
    return float(f"{power * max(step for step in (1, 2, 5) if step * power <= value * (1 + 1e-9)):.1g}")


def length_text(metres: float) -> str:
    """Return a length in the unit in which it is a handy number.

    >>> length_text(0.02), length_text(0.0005), length_text(3.0)
    ('2 cm', '0.5 mm', '3 m')
    """
    for unit, factor in (("m", 1.0), ("cm", 100.0)):
        if abs(metres * factor) >= 1 - 1e-9:
            return f"{metres * factor:.6g} {unit}"
    return f"{metres * 1000:.6g} mm"


def base_layout(**options: Any) -> dict[str, Any]:
    """Return a layout with the page's look: no background of its own, a legend above."""
    return {
        "paper_bgcolor": "rgba(0,0,0,0)", "plot_bgcolor": "rgba(0,0,0,0)", "uirevision": "same", "hovermode": "closest",
        "font": {"color": "@ink", "size": 12}, "margin": {"l": 12, "r": 12, "t": 12, "b": 12},
        "legend": {"orientation": "h", "x": 0, "xanchor": "left", "y": 1.01, "yanchor": "bottom",
                   "itemsizing": "trace", "bgcolor": "rgba(0,0,0,0)", "traceorder": "normal"},
        "hoverlabel": {"align": "left"}, **options,
    }  # fmt: skip


def axis(title: str = "", **options: Any) -> dict[str, Any]:
    """Return an axis with the page's colours and room for its own labels."""
    return {
        "title": {"text": title, "standoff": 8}, "automargin": True, "gridcolor": "@grid", "zerolinecolor": "@grid",
        "linecolor": "@muted", "tickcolor": "@muted", "ticks": "outside", "ticklen": 4, **options,
    }  # fmt: skip


def colour_bar(title: str, **options: Any) -> dict[str, Any]:
    """Return a slim colour bar at the right."""
    return {
        "title": {"text": title, "side": "top"}, "thickness": 12, "outlinewidth": 0, "len": 0.9,
        "tickcolor": "@muted", "ticks": "outside", "ticklen": 3, **options,
    }  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class Map:
    """A map from above: its box, the lowest and the highest x, y, and the project, which tells their unit."""

    box: Float[np.ndarray, "2 2"]
    project: dict[str, Any]

    @property
    def width(self) -> float:
        """Return the width in the unit of x."""
        return float(self.box[1, 0] - self.box[0, 0])

    @property
    def longest(self) -> float:
        """Return the longer side in the unit of x and y."""
        return float((self.box[1] - self.box[0]).max())

    @property
    def ratio(self) -> float:
        """Return height over width."""
        return float((self.box[1, 1] - self.box[0, 1]) / self.width)

    def with_room_below(self) -> "Map":
        """Return the map with room for `reference` under all that it shows."""
        return map_in(self.project, self.box - np.array([[0.0, 0.09 * self.longest], [0.0, 0.0]]))

    def layout(self, **options: Any) -> dict[str, Any]:
        """Return axes of equal scale with coordinates that are written out."""
        unit, crs = short_unit(self.project["unit"]), self.project["crs"]
        names = ("East", "North") if crs else ("X", "Y")
        titles = [f"{name} ({unit})" if unit else name for name in names]
        if crs:
            titles[0] += f", {plain(crs)}"
        form = f",.{digits_of(300 * self.longest)}f"
        x, y = (axis(title, tickformat=form, nticks=6, zeroline=False, constrain="domain") for title in titles)
        x |= {"range": self.box[:, 0].tolist()}
        y |= {
            "range": self.box[:, 1].tolist(),
            "tickangle": -90,
            "scaleanchor": "x",
            "ticklabeloverflow": "hide past domain",
        }
        for one in (x, y):
            one["automargin"] = False  # with a legend and equal scales, Plotly does not come to rest in a narrow window
        return base_layout(xaxis=x, yaxis=y, margin={"l": 54, "r": 12, "t": 12, "b": 50}, **options)


def map_of(project: dict[str, Any], *places: Any) -> Map:
    """Return a map with room around places, each of rows of x, y; it is never narrower than a third of its length."""
    every = np.concatenate([np.asarray(place, float).reshape(-1, 2) for place in places])
    low, high = every.min(axis=0), every.max(axis=0)
    longest = float((high - low).max())
    margin = np.maximum(0.06 * longest, (0.35 * longest - (high - low)) / 2)
    return map_in(project, np.stack([low - margin, high + margin]))


def map_in(project: dict[str, Any], box: Float[np.ndarray, "2 2"]) -> Map:
    """Return the map of a box, or of a square of one unit where the box is a point."""
    longest = float((box[1] - box[0]).max())
    if longest < 1e-6:
        box = box.mean(axis=0) + np.array([[-0.5, -0.5], [0.5, 0.5]])
    return Map(box=np.round(box, digits_of(longest)), project=project)


def digits_of(extent: float) -> int:
    """Return the digits after the point that tell apart a ten-thousandth of an extent, and no more than is drawn.

    >>> digits_of(400.0), digits_of(3.0), digits_of(0.0)
    (2, 4, 4)
    """
    return max(4 - math.floor(math.log10(extent)), 0) if extent > 0 else 4


def marker_size(count: int, largest: float = 9.0) -> float:
    """Return the size of markers, in pixels, that leaves room between so many of them on a map."""
    return round(float(np.clip(largest * math.sqrt(40 / max(count, 1)), 0.55 * largest, largest)), 1)


def arrows(start: np.ndarray, end: np.ndarray) -> dict[str, list[float | None]]:
    """Return x and y of one line that draws arrows, a head at each end and a gap between two."""
    along = end - start
    across = np.stack([-along[:, 1], along[:, 0]], axis=1)
    left, right = end - 0.28 * along + 0.13 * across, end - 0.28 * along - 0.13 * across
    return line_of(np.stack([start, end, left, end, right], axis=1))


def line_of(parts: np.ndarray) -> dict[str, list[float | None]]:
    """Return x and y of one line through parts of as many places each, with a gap between two."""
    digits = digits_of(float(np.ptp(parts.reshape(-1, 2), axis=0).max()))
    x, y = ([value for part in parts[..., k] for value in (*np.round(part, digits).tolist(), None)] for k in (0, 1))
    return {"x": x, "y": y}


def magnification(lengths: np.ndarray, room: float) -> float:
    """Return how many times lengths are to be drawn too large for nine in ten to be at most as long as that room."""
    typical = float(np.percentile(lengths, 90)) if len(lengths) else 0.0
    return round_down(room / typical) if typical > 0 else 1.0


def enlarged(times: float) -> str:
    """Return how large something is drawn, in words that follow `drawn`.

    >>> enlarged(200.0), enlarged(1.0), enlarged(0.5)
    ('200 times too large', 'at its true size', 'at 0.5 of its size')
    """
    return (
        "at its true size"
        if times == 1
        else f"{times:,.6g} times too large"
        if times > 1
        else f"at {times:g} of its size"
    )


def spacing(here: Float[np.ndarray, "places 2"], area: Map) -> float:
    """Return how far places are from each other: to the nearest in the median, or as if they were spread evenly."""
    if len(here) < 2:
        return 0.2 * area.longest
    nearest = float(np.median(KDTree(here).query(here, k=2)[0][:, 1]))
    even = 0.6 * math.sqrt(float(np.prod(np.ptp(here, axis=0))) / len(here))
    return float(np.clip(max(nearest, even), 0.01 * area.longest, 0.2 * area.longest))


def reference(area: Map, drawn_per_metre: float) -> tuple[dict[str, Any], dict[str, Any]]:
    """Return a shape and an annotation: a bar at the lower left that says how long an error of so many cm is drawn."""
    metres = round_down(0.14 * area.width / drawn_per_metre)
    x, y = area.box[0] + 0.025 * area.longest
    bar = {"type": "line", "x0": x, "x1": x + metres * drawn_per_metre, "y0": y, "y1": y}
    bar |= {"line": {"color": "@ink", "width": 3}}
    text = {"x": x, "y": y, "text": f"error of {length_text(metres)}", "showarrow": False, "xanchor": "left"}
    return bar, text | {"yanchor": "bottom", "yshift": 2, "font": {"size": 11}}


def triple(values: Sequence[float | None], digits: int = 3) -> str:
    """Return what is known along east, north and up, in a hover text."""
    known = zip(AXES, values, strict=True)
    return ", ".join(f"{name} {number(value, digits)}" for name, value in known) + " m"
