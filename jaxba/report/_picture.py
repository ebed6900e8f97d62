"""The cloud on one picture: from above in its colours with the flight, by height, and the errors as a histogram.

Drawn without a window or any state of pyplot, with the fonts that come with matplotlib and without a date: the same
cloud gives the same bytes. At most `MOST_POINTS` points are drawn, evenly chosen.
"""

import io
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float, UInt8

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

MOST_POINTS = 200_000
_MOST_BYTES = 600_000
_SIZE_PX, _DPI = (1600, 900), 100
_INK, _PALE, _FLIGHT = "#1c2733", "#8a97a6", "#ff5a36"
_OUTSIDE = 0.002  # share of the points on each side that may lie outside the picture
_NARROWEST = 0.35  # shorter over longer side of the map, at least
_LOOK: dict[Any, Any] = {
    "font.family": "DejaVu Sans", "font.size": 10.0, "text.color": _INK, "axes.edgecolor": _PALE,
    "axes.labelcolor": _INK, "xtick.color": _PALE, "ytick.color": _PALE, "xtick.labelcolor": _INK,
    "ytick.labelcolor": _INK, "axes.linewidth": 0.8, "svg.hashsalt": "jaxba",
}  # fmt: skip


@dataclass(frozen=True, kw_only=True, eq=False)
class Picture:
    """What the picture shows.

    - `xyz`, `camera_xyz`: points and adjusted cameras in the result's coordinates. Cameras are in flight order.
    - `rgb`, `error_px`: of the points. `title`, `subtitle`: above all. `crs`: what x and y are in; `unit`: of both.
    - `height_label`: of the colour bar.
    """

    xyz: Float[np.ndarray, "points 3"]
    rgb: UInt8[np.ndarray, "points 3"]
    error_px: Float[np.ndarray, " points"]
    camera_xyz: Float[np.ndarray, "cameras 3"]
    title: str
    subtitle: str
    crs: str
    unit: str
    height_label: str


def draw_picture(picture: Picture) -> bytes:
    """Return a PNG of 1600 x 900 pixels.

    >>> rng = np.random.default_rng(0)
    >>> picture = Picture(xyz=rng.random((50, 3)), rgb=np.zeros((50, 3), np.uint8), error_px=rng.random(50),
    ...     camera_xyz=rng.random((4, 3)), title="", subtitle="", crs="local", unit="m", height_label="height")
    >>> draw_picture(picture)[:4]
    b'\\x89PNG'
    """
    from matplotlib import rc_context
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure
    from PIL import Image

    with rc_context(_LOOK):
        figure = Figure(figsize=(_SIZE_PX[0] / _DPI, _SIZE_PX[1] / _DPI), dpi=_DPI, facecolor="white")
        canvas = FigureCanvasAgg(figure)
        _draw(figure, picture)
        canvas.draw()
        image = Image.fromarray(np.asarray(canvas.buffer_rgba())[:, :, :3])
    png = _png(image)
    if len(png) > _MOST_BYTES:  # a dense cloud has another colour in every pixel
        png = _png(image.quantize(256, Image.Quantize.FASTOCTREE, dither=Image.Dither.NONE))
    return png


def _png(image: Any) -> bytes:
    buffer = io.BytesIO()
    image.save(buffer, "png", optimize=True)
    return buffer.getvalue()


def _draw(figure: "Figure", picture: Picture) -> None:
    shown = np.linspace(0, len(picture.xyz) - 1, min(len(picture.xyz), MOST_POINTS)).astype(int)
    shown = shown[np.argsort(picture.xyz[shown, 2], kind="stable")]  # what is high lies on top
    xyz, rgb = picture.xyz[shown], picture.rgb[shown]
    box = _box(picture.xyz[:, :2], picture.camera_xyz[:, :2])
    figure.text(0.02, 0.955, picture.title, fontsize=19, fontweight="bold", va="center")
    figure.text(0.02, 0.916, picture.subtitle, fontsize=11, color=_PALE, va="center")

    # places in pixels: left, bottom, width, height; the map takes what its shape needs, the rest stands beside it
    width, height = _fitting(box, 900.0, 715.0)
    colours = _axes(figure, (100, 70, width, height))
    _points(colours, xyz, box, rgb / 255)
    _flight(colours, picture.camera_xyz)
    _map_axes(colours, box, picture)
    _scale_bar(colours, picture.unit)
    colours.set_title("from above, with the flight (triangle: first photo)", fontsize=11, loc="left")

    left = 100 + width + 85
    room = _SIZE_PX[0] - left - 110
    small_width, small_height = _fitting(box, room, 385.0)
    heights = _axes(figure, (left, 400, small_width, small_height))
    low, high = np.percentile(picture.xyz[:, 2], [1, 99])
    dots = _points(heights, xyz, box, xyz[:, 2], cmap="viridis", vmin=low, vmax=high if high > low else low + 1)
    _map_axes(heights, box, None)
    heights.set_title("by height", fontsize=11, loc="left")
    bar = figure.colorbar(dots, cax=_axes(figure, (left + small_width + 15, 400, 16, small_height)))
    bar.set_label(picture.height_label)
    bar.outline.set_visible(False)  # pyright: ignore[reportCallIssue]
    _histogram(_axes(figure, (left, 70, room + 60, 270)), picture.error_px)


def _fitting(box: Float[np.ndarray, "2 2"], width: float, height: float) -> tuple[float, float]:
    """Return the largest size in pixels, in that room, that has the box's shape."""
    sides = box[1] - box[0]
    scale = min(width / sides[0], height / sides[1])
    return float(scale * sides[0]), float(scale * sides[1])


def _axes(figure: "Figure", place_px: tuple[float | int, ...]) -> "Axes":
    left, bottom, width, height = place_px
    return figure.add_axes((left / _SIZE_PX[0], bottom / _SIZE_PX[1], width / _SIZE_PX[0], height / _SIZE_PX[1]))


def _box(points: np.ndarray, cameras: np.ndarray) -> Float[np.ndarray, "2 2"]:
    """Return the lowest and the highest x, y to show: all cameras and all but far points; no strip is too narrow."""
    low, high = np.percentile(points, [100 * _OUTSIDE, 100 - 100 * _OUTSIDE], axis=0)
    if len(cameras):
        low, high = np.minimum(low, cameras.min(axis=0)), np.maximum(high, cameras.max(axis=0))
    longest = max(float((high - low).max()), 1e-9)
    margin = np.maximum(0.04 * longest, (_NARROWEST * longest - (high - low)) / 2)
    return np.stack([low - margin, high + margin])


def _points(axes: "Axes", xyz: np.ndarray, box: np.ndarray, colour: np.ndarray, **options: Any) -> Any:
    """Scatter points so large that they nearly touch."""
    bounds = axes.get_position()
    side_px = np.array([bounds.width * _SIZE_PX[0], bounds.height * _SIZE_PX[1]])
    scale = np.min(side_px / (box[1] - box[0]))  # pixels in a unit
    inside = np.all((xyz[:, :2] >= box[0]) & (xyz[:, :2] <= box[1]), axis=1)
    spacing_px = scale * np.sqrt(np.prod(np.ptp(xyz[inside, :2], axis=0)) / max(int(inside.sum()), 1))
    side = np.clip(1.2 * spacing_px, 2.0, 5.5) * 72 / _DPI
    return axes.scatter(xyz[:, 0], xyz[:, 1], s=side**2, c=colour, linewidths=0, **options)


def _flight(axes: "Axes", cameras: np.ndarray) -> None:
    if not len(cameras):
        return
    x, y = cameras[:, 0], cameras[:, 1]
    axes.plot(x, y, color="white", linewidth=2.6, alpha=0.75)
    axes.plot(x, y, color=_FLIGHT, linewidth=1.1)
    axes.scatter(x, y, s=30, color=_FLIGHT, edgecolors="white", linewidths=0.9, zorder=3)
    axes.scatter(x[:1], y[:1], s=130, marker="^", color=_FLIGHT, edgecolors="white", linewidths=1.2, zorder=4)


def _map_axes(axes: "Axes", box: np.ndarray, picture: Picture | None) -> None:
    from matplotlib.ticker import MaxNLocator, StrMethodFormatter

    axes.set_aspect("equal", adjustable="box")
    axes.set_xlim(*box[:, 0])
    axes.set_ylim(*box[:, 1])
    axes.set_facecolor("#f2f4f6")
    if picture is None:
        axes.set_xticks([])
        axes.set_yticks([])
        return
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_major_locator(MaxNLocator(5))
        axis.set_major_formatter(StrMethodFormatter("{x:,.0f}" if np.ptp(box[:, 0]) > 5 else "{x:.3g}"))
    axes.tick_params(axis="y", labelrotation=90)
    for label in axes.get_yticklabels():
        label.set_verticalalignment("center")
    axes.set_xlabel(f"{'X' if picture.unit == '' else 'east'}{_in(picture.unit)}: {picture.crs}")
    axes.set_ylabel(f"{'Y' if picture.unit == '' else 'north'}{_in(picture.unit)}")


def _scale_bar(axes: "Axes", unit: str) -> None:
    """Draw a bar of a round length, about a fifth of the picture, at the lower left."""
    (left, right), (bottom, top) = axes.get_xlim(), axes.get_ylim()
    target = (right - left) / 5
    power = 10 ** np.floor(np.log10(target))
    length = power * max(step for step in (1, 2, 5) if step * power <= target)
    x, y, height = left + 0.04 * (right - left), bottom + 0.04 * (top - bottom), 0.008 * (top - bottom)
    axes.fill_between([x - 2 * height, x + length + 2 * height], y - 2 * height, y + 6 * height, color="white",
                      alpha=0.8, linewidth=0, zorder=5)  # fmt: skip
    axes.fill_between([x, x + length], y, y + height, color=_INK, linewidth=0, zorder=6)
    axes.text(x + length / 2, y + 1.8 * height, f"{length:g} {unit}".strip(), ha="center", va="bottom", zorder=6)


def _histogram(axes: "Axes", error_px: Float[np.ndarray, " points"]) -> None:
    errors = error_px[np.isfinite(error_px)]
    if len(errors) == 0:
        axes.set_axis_off()
        return
    most = max(float(np.percentile(errors, 99.5)), 1e-3)
    axes.hist(errors, bins=60, range=(0, most), color="#3d7ea6", linewidth=0)
    median = float(np.median(errors))
    axes.axvline(median, color=_FLIGHT, linewidth=1.4)
    axes.set_ylim(0, 1.15 * axes.get_ylim()[1])
    axes.text(median, 0.99, f" median {median:.2f} px", color=_FLIGHT, va="top", transform=axes.get_xaxis_transform())
    axes.set_xlim(0, most)
    axes.set_title(
        f"mean reprojection error of each point ({np.mean(errors > most):.1%} beyond)", fontsize=11, loc="left"
    )
    axes.set_xlabel("px")
    axes.set_ylabel("points")
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)


def _in(unit: str) -> str:
    return f" ({unit})" if unit else ""
