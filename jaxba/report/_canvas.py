"""What the pictures have in common: their size and look, a map from above with its scale, and the bytes of a PNG.

Drawn without a window or any state of pyplot, with the fonts that come with matplotlib and without a date: the same
content gives the same bytes.
"""

import io
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

SIZE_PX = (1600, 900)
INK, PALE = "#1c2733", "#8a97a6"
_DPI = 100
_MOST_BYTES = 600_000
_OUTSIDE = 0.002  # share of the points on each side that may lie outside the picture
_NARROWEST = 0.35  # shorter over longer side of the map, at least
_LOOK: dict[Any, Any] = {
    "font.family": "DejaVu Sans", "font.size": 10.0, "text.color": INK, "axes.edgecolor": PALE,
    "axes.labelcolor": INK, "xtick.color": PALE, "ytick.color": PALE, "xtick.labelcolor": INK,
    "ytick.labelcolor": INK, "axes.linewidth": 0.8, "svg.hashsalt": "jaxba",
}  # fmt: skip


def drawn(draw: "Callable[[Figure], None]") -> bytes:
    """Return what a function draws on an empty figure, as a PNG of 1600 x 900 pixels."""
    from matplotlib import rc_context
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure
    from PIL import Image

    with rc_context(_LOOK):
        figure = Figure(figsize=(SIZE_PX[0] / _DPI, SIZE_PX[1] / _DPI), dpi=_DPI, facecolor="white")
        canvas = FigureCanvasAgg(figure)
        draw(figure)
        canvas.draw()
        image = Image.fromarray(np.asarray(canvas.buffer_rgba())[:, :, :3])
    png = _png(image)
    if len(png) > _MOST_BYTES:  # a dense cloud has another colour in every pixel
        png = _png(image.quantize(256, Image.Quantize.FASTOCTREE, dither=Image.Dither.NONE))
    return png


def titles(figure: "Figure", title: str, subtitle: str) -> None:
    """Write what the picture is of above everything."""
    figure.text(0.02, 0.955, title, fontsize=19, fontweight="bold", va="center")
    figure.text(0.02, 0.916, subtitle, fontsize=11, color=PALE, va="center")


def axes_at(figure: "Figure", place_px: tuple[float | int, ...]) -> "Axes":
    """Return axes at a place in pixels: left, bottom, width, height."""
    left, bottom, width, height = place_px
    return figure.add_axes((left / SIZE_PX[0], bottom / SIZE_PX[1], width / SIZE_PX[0], height / SIZE_PX[1]))


def fitting(box: Float[np.ndarray, "2 2"], width: float, height: float) -> tuple[float, float]:
    """Return the largest size in pixels, in that room, that has the box's shape."""
    sides = box[1] - box[0]
    scale = min(width / sides[0], height / sides[1])
    return float(scale * sides[0]), float(scale * sides[1])


def box_of(points: np.ndarray, cameras: np.ndarray) -> Float[np.ndarray, "2 2"]:
    """Return the lowest and the highest x, y to show: all cameras and all but far points; no strip is too narrow."""
    low, high = np.percentile(points, [100 * _OUTSIDE, 100 - 100 * _OUTSIDE], axis=0)
    if len(cameras):
        low, high = np.minimum(low, cameras.min(axis=0)), np.maximum(high, cameras.max(axis=0))
    longest = max(float((high - low).max()), 1e-9)
    margin = np.maximum(0.04 * longest, (_NARROWEST * longest - (high - low)) / 2)
    return np.stack([low - margin, high + margin])


def scatter_points(axes: "Axes", xyz: np.ndarray, box: np.ndarray, colour: np.ndarray, **options: Any) -> Any:
    """Scatter points so large that they nearly touch."""
    bounds = axes.get_position()
    side_px = np.array([bounds.width * SIZE_PX[0], bounds.height * SIZE_PX[1]])
    scale = np.min(side_px / (box[1] - box[0]))  # pixels in a unit
    inside = np.all((xyz[:, :2] >= box[0]) & (xyz[:, :2] <= box[1]), axis=1)
    spacing_px = scale * np.sqrt(np.prod(np.ptp(xyz[inside, :2], axis=0)) / max(int(inside.sum()), 1))
    side = np.clip(1.2 * spacing_px, 2.0, 5.5) * 72 / _DPI
    return axes.scatter(xyz[:, 0], xyz[:, 1], s=side**2, c=colour, linewidths=0, **options)


def draw_map(axes: "Axes", box: np.ndarray, unit: str | None = None, x_label: str = "", y_label: str = "") -> None:
    """Give axes the box's limits, with coordinates and a scale bar, or without them where there is no unit."""
    from matplotlib.ticker import MaxNLocator, StrMethodFormatter

    axes.set_aspect("equal", adjustable="box")
    axes.set_xlim(*box[:, 0])
    axes.set_ylim(*box[:, 1])
    axes.set_facecolor("#f2f4f6")
    if unit is None:
        axes.set_xticks([])
        axes.set_yticks([])
        return
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_major_locator(MaxNLocator(5))
        axis.set_major_formatter(StrMethodFormatter("{x:,.0f}" if np.ptp(box[:, 0]) > 5 else "{x:.3g}"))
    axes.tick_params(axis="y", labelrotation=90)
    for label in axes.get_yticklabels():
        label.set_verticalalignment("center")
    axes.set_xlabel(x_label)
    axes.set_ylabel(y_label)
    _scale_bar(axes, unit)


def _scale_bar(axes: "Axes", unit: str) -> None:
    """Draw a bar of a round length, about a fifth of the picture, at the lower left."""
    (left, right), (bottom, top) = axes.get_xlim(), axes.get_ylim()
    target = (right - left) / 5
    power = 10 ** np.floor(np.log10(target))
    length = power * max(step for step in (1, 2, 5) if step * power <= target)
    x, y, height = left + 0.04 * (right - left), bottom + 0.04 * (top - bottom), 0.008 * (top - bottom)
    axes.fill_between([x - 2 * height, x + length + 2 * height], y - 2 * height, y + 6 * height, color="white",
                      alpha=0.8, linewidth=0, zorder=5)  # fmt: skip
    axes.fill_between([x, x + length], y, y + height, color=INK, linewidth=0, zorder=6)
    axes.text(x + length / 2, y + 1.8 * height, f"{length:g} {unit}".strip(), ha="center", va="bottom", zorder=6)


def _png(image: Any) -> bytes:
    buffer = io.BytesIO()
    image.save(buffer, "png")
    return buffer.getvalue()
