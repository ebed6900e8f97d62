"""The cloud on one picture: from above in its colours with the flight, by height, and the errors as a histogram.

The same cloud gives the same bytes. At most `MOST_POINTS` points are drawn, evenly chosen.
"""

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float, UInt8

from jaxba.report._canvas import SIZE_PX, axes_at, box_of, draw_map, drawn, fitting, scatter_points, titles

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

MOST_POINTS = 200_000
_FLIGHT = "#ff5a36"


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
    return drawn(lambda figure: _draw(figure, picture))


def _draw(figure: "Figure", picture: Picture) -> None:
    shown = np.linspace(0, len(picture.xyz) - 1, min(len(picture.xyz), MOST_POINTS)).astype(int)
    shown = shown[np.argsort(picture.xyz[shown, 2], kind="stable")]  # what is high lies on top
    xyz, rgb = picture.xyz[shown], picture.rgb[shown]
    box = box_of(picture.xyz[:, :2], picture.camera_xyz[:, :2])
    titles(figure, picture.title, picture.subtitle)

    # places in pixels: left, bottom, width, height; the map takes what its shape needs, the rest stands beside it
    width, height = fitting(box, 900.0, 715.0)
    colours = axes_at(figure, (100, 70, width, height))
    scatter_points(colours, xyz, box, rgb / 255)
    _flight(colours, picture.camera_xyz)
    of_unit = f" ({picture.unit})" if picture.unit else ""
    x, y = ("east", "north") if picture.unit else ("X", "Y")
    draw_map(colours, box, picture.unit, f"{x}{of_unit}: {picture.crs}", f"{y}{of_unit}")
    colours.set_title("from above, with the flight (triangle: first photo)", fontsize=11, loc="left")

    left = 100 + width + 85
    room = SIZE_PX[0] - left - 110
    small_width, small_height = fitting(box, room, 385.0)
    heights = axes_at(figure, (left, 400, small_width, small_height))
    low, high = np.percentile(picture.xyz[:, 2], [1, 99])
    dots = scatter_points(heights, xyz, box, xyz[:, 2], cmap="viridis", vmin=low, vmax=high if high > low else low + 1)
    draw_map(heights, box)
    heights.set_title("by height", fontsize=11, loc="left")
    bar = figure.colorbar(dots, cax=axes_at(figure, (left + small_width + 15, 400, 16, small_height)))
    bar.set_label(picture.height_label)
    bar.outline.set_visible(False)  # pyright: ignore[reportCallIssue]
    _histogram(axes_at(figure, (left, 70, room + 60, 270)), picture.error_px)


def _flight(axes: "Axes", cameras: np.ndarray) -> None:
    if not len(cameras):
        return
    x, y = cameras[:, 0], cameras[:, 1]
    axes.plot(x, y, color="white", linewidth=2.6, alpha=0.75)
    axes.plot(x, y, color=_FLIGHT, linewidth=1.1)
    axes.scatter(x, y, s=30, color=_FLIGHT, edgecolors="white", linewidths=0.9, zorder=3)
    axes.scatter(x[:1], y[:1], s=130, marker="^", color=_FLIGHT, edgecolors="white", linewidths=1.2, zorder=4)


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
