"""A partition on one picture: cameras from above in the colours of their tiles, separators, points cut; and the sizes.

Tiles that overlap have different colours. At most `MOST_POINTS` points are drawn, evenly chosen.
"""

from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial import KDTree

from jaxba.ba import Partition
from jaxba.ba._projection import camera_centers
from jaxba.report._canvas import INK, PALE, SIZE_PX, axes_at, box_of, draw_map, drawn, fitting, scatter_points, titles
from jaxba.report._picture import MOST_POINTS

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_COLOURS = tuple(
    ["#3d7ea6", "#e07a3f", "#4f9d69", "#b0558f", "#c9a227", "#6a5acd", "#2aa198", "#c0504d", "#7f8c3a", "#5c6bc0"]
)
_TINT = 0.72  # of white in a tile's ground
_MOST_NUMBERS, _MOST_NAMED_BARS, _BAR_PX = 150, 40, 65


def draw_tiles(partition: Partition, title: str, subtitle: str) -> bytes:
    """Return a PNG of 1600 x 900 pixels; equal partitions give the same bytes.

    >>> import jaxba
    >>> found = jaxba.partition(jaxba.synthetic.uav_block(16).problem, max_images=8, overlap=2)
    >>> draw_tiles(found, "16 images", "2 tiles")[:4]
    b'\\x89PNG'
    """
    return drawn(lambda figure: _draw(figure, partition, title, subtitle))


def _draw(figure: "Figure", partition: Partition, title: str, subtitle: str) -> None:
    block, owner = partition.block, partition.owner
    cameras, points = camera_centers(block.poses)[:, :2], np.asarray(block.points, float)
    colours = _rgb(np.array(_COLOURS)[_colour_of_tile(partition)])
    box = box_of(points[:, :2], cameras)
    titles(figure, title, f"{subtitle}; ringed cameras are in several tiles, dark points are seen from several")
    width, height = fitting(box, 950.0, 715.0)
    ground = axes_at(figure, (100, 70, width, height))
    _draw_ground(ground, partition, points, colours, box)
    _draw_cameras(ground, cameras, colours[owner], partition.is_separator, box, width)
    _draw_numbers(ground, cameras, owner, colours)
    draw_map(ground, box, "m", "x (m)", "y (m)")
    ground.set_title("cameras from above", fontsize=11, loc="left")
    left, room = max(100 + width + 85, 700), min(_BAR_PX * len(colours), 715)
    _draw_sizes(axes_at(figure, (left, 70 + 715 - room, SIZE_PX[0] - left - 50, room)), partition, colours)


def _draw_ground(
    axes: "Axes",
    partition: Partition,
    xyz: Float[np.ndarray, "points 3"],
    colours: Float[np.ndarray, "tiles 3"],
    box: Float[np.ndarray, "2 2"],
) -> None:
    """Draw points in a tint of the tile that sees them, those that are cut dark."""
    seen = partition.block.observations
    tile_of_point = np.full(len(xyz), -1)
    tile_of_point[np.asarray(seen.point_index)] = partition.owner[np.asarray(seen.image_index)]
    shown = np.flatnonzero(tile_of_point >= 0)
    shown = shown[np.linspace(0, len(shown) - 1, min(len(shown), MOST_POINTS)).astype(int)]
    shown = shown[np.argsort(partition.is_cut[shown], kind="stable")]
    tints = _TINT + (1 - _TINT) * colours[tile_of_point[shown]]
    tints[partition.is_cut[shown]] = _rgb(np.array(["#5b6673"]))
    scatter_points(axes, xyz[shown], box, tints)


def _draw_cameras(
    axes: "Axes",
    xy: Float[np.ndarray, "images 2"],
    colours: Float[np.ndarray, "images 3"],
    is_separator: Bool[np.ndarray, " images"],
    box: Float[np.ndarray, "2 2"],
    width_px: float,
) -> None:
    """Draw cameras so large that neighbours stay apart, separators above the others."""
    spacing_px = np.median(KDTree(xy).query(xy, k=2)[0][:, 1]) * width_px / np.ptp(box[:, 0])
    size = float(np.clip(0.5 * spacing_px, 2.0, 9.0)) ** 2
    for mask, edge, order in ((~is_separator, "white", 3), (is_separator, INK, 4)):
        line = (0.08 if order == 3 else 0.16) * np.sqrt(size)
        axes.scatter(xy[mask, 0], xy[mask, 1], s=size, c=colours[mask], edgecolors=edge, linewidths=line, zorder=order)


def _draw_numbers(
    axes: "Axes",
    xy: Float[np.ndarray, "images 2"],
    owner: Int[np.ndarray, " images"],
    colours: Float[np.ndarray, "tiles 3"],
) -> None:
    """Write each tile's number at the camera nearest to its middle."""
    if len(colours) > _MOST_NUMBERS:
        return
    size = float(np.clip(60 / np.sqrt(len(colours)), 9, 20))
    for number, colour in enumerate(colours):
        own = xy[owner == number]
        middle = own[np.argmin(np.sum((own - own.mean(axis=0)) ** 2, axis=1))]
        plate = {"boxstyle": "circle,pad=0.28", "facecolor": "white", "edgecolor": colour, "linewidth": 1.8}
        place: Any = {"ha": "center", "va": "center", "zorder": 7}
        axes.text(middle[0], middle[1], str(number), fontsize=size, fontweight="bold", bbox=plate, **place)


def _draw_sizes(axes: "Axes", partition: Partition, colours: Float[np.ndarray, "tiles 3"]) -> None:
    """Draw a bar a tile: observations of its own images, and beyond them those of images that overlap into it."""
    from matplotlib.ticker import MaxNLocator, StrMethodFormatter

    numbers = np.arange(len(partition.tiles))
    all_of = np.array([tile.problem.num_observations for tile in partition.tiles])
    own = [np.count_nonzero(tile.own[np.asarray(tile.problem.observations.image_index)]) for tile in partition.tiles]
    axes.barh(numbers, all_of, color=colours * 0.4 + 0.6, height=0.82, linewidth=0)
    axes.barh(numbers, own, color=colours, height=0.82, linewidth=0)
    axes.set_ylim(len(numbers) - 0.5, -0.5)
    axes.set_yticks(numbers if len(numbers) <= _MOST_NAMED_BARS else [])
    axes.tick_params(axis="y", length=0)
    axes.set_title("observations of each tile (pale: of images that overlap)", fontsize=11, loc="left")
    if len(numbers) <= _MOST_NAMED_BARS:
        for number, tile in enumerate(partition.tiles):
            images = f" {int(tile.own.sum())} + {int((~tile.own).sum())} images"
            axes.text(all_of[number], number, images, va="center", fontsize=9)
    axes.set_xlim(0, 1.25 * max(all_of.max(), 1))
    axes.xaxis.set_major_formatter(StrMethodFormatter("{x:,.0f}"))
    axes.xaxis.set_major_locator(MaxNLocator(5))
    axes.tick_params(axis="x", color=PALE)
    for side in ("top", "right", "left"):
        axes.spines[side].set_visible(False)


def _colour_of_tile(partition: Partition) -> Int[np.ndarray, " tiles"]:
    """Return a colour for each tile that no tile overlapping it has, as far as there are colours."""
    num_tiles = len(partition.tiles)
    overlaps = np.zeros((num_tiles, num_tiles), bool)
    for number, tile in enumerate(partition.tiles):
        overlaps[number, partition.owner[tile.images]] = True
    overlaps |= overlaps.T
    colour = np.full(num_tiles, -1)
    used = np.zeros(len(_COLOURS), int)
    for number in range(num_tiles):
        near = np.bincount(colour[overlaps[number] & (colour >= 0)], minlength=len(_COLOURS))
        colour[number] = np.lexsort((used, near))[0]
        used[colour[number]] += 1
    return colour


def _rgb(colours: np.ndarray) -> Float[np.ndarray, "colours 3"]:
    return np.array([[int(text[k : k + 2], 16) / 255 for k in (1, 3, 5)] for text in colours])
