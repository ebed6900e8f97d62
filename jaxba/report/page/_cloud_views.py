"""The cloud from above, as a picture that prints well, and the cloud in space, to be turned.

The picture is drawn here, point by point, and laid under the axes. In space there are too many points for texts or full
coordinates: x and y are counted from a round place near the middle, so that 32 bits are enough, and the axes are
labelled with the full coordinates. Colours are at most 255, each a byte a point. Points are squares, which are two
triangles each and look alike at their size: without a graphics card 50,000 circles take 2.8 s to draw, squares 1.5 s.
"""

import base64
import io
import math
from typing import Any

import numpy as np
from jaxtyping import Float, UInt8
from PIL import Image

from jaxba.report._canvas import box_of
from jaxba.report.page._drawing import (
    GREY,
    VERMILLION,
    Figure,
    axis,
    base_layout,
    colour_bar,
    digits_of,
    map_in,
    marker_size,
    packed,
    plain,
    short_unit,
    unit_metres,
)  # fmt: skip
from jaxba.report.page._photo_maps import photo_markers

_PICTURE_PX = 900  # longer side of the picture
_COLOURS = 255
_VALUES = ((0.0, "#440154"), (0.25, "#3b528b"), (0.5, "#21918c"), (0.75, "#5ec962"), (1.0, "#fde725"))  # viridis


def preview(report: dict[str, Any]) -> Figure | None:
    """Return the cloud from above with the photos; None where there is no cloud."""
    cloud = report["cloud"]
    if "none" in cloud or not cloud["x"]:
        return None
    adjusted = [photo for photo in report["photos"] if photo["x"] is not None]
    points = np.array([cloud["x"], cloud["y"], cloud["z"]]).T
    box = box_of(points[:, :2], np.array([[photo["x"], photo["y"]] for photo in adjusted]).reshape(-1, 2))
    area = map_in(report["project"], box)
    image = {
        "source": _picture(points, np.array(cloud["rgb"], np.uint8), area.box), "xref": "x", "yref": "y",
        "x": area.box[0, 0], "y": area.box[1, 1], "sizex": area.width, "sizey": area.box[1, 1] - area.box[0, 1],
        "sizing": "stretch", "layer": "below",
    }  # fmt: skip
    layout = area.layout(images=[image])
    for name in ("xaxis", "yaxis"):
        layout[name]["showgrid"] = False
    marker = {"size": marker_size(len(adjusted)), "color": VERMILLION, "line": {"color": "#ffffff", "width": 0.8}}
    return Figure(
        name="preview", title="Points and photos", ratio=area.ratio, layout=layout,
        data=[photo_markers("photo", adjusted, marker)],
        caption=f"The points in the colours of the photos, and where the photos were taken. {_share(cloud)}",
    )  # fmt: skip


def in_space(report: dict[str, Any]) -> Figure | None:
    """Return the cloud and the photos in three dimensions; None where there is no cloud."""
    cloud = report["cloud"]
    if "none" in cloud or not cloud["x"]:
        return None
    project = report["project"]
    points = np.array([cloud["x"], cloud["y"], cloud["z"]]).T
    origin = np.array([*np.round(np.median(points[:, :2], axis=0), -1), 0.0])
    adjusted = [photo for photo in report["photos"] if photo["x"] is not None]
    cameras = np.array([[photo["x"], photo["y"], photo["z"]] for photo in adjusted]).reshape(-1, 3) - origin
    size = float(np.clip(6.0 - math.log10(len(points)), 1.4, 4.0))
    every = np.concatenate([points - origin, cameras])
    data = [
        {"type": "scatter3d", "mode": "markers", "name": "point", "hoverinfo": "skip", "showlegend": False,
         **{name: packed(points[:, k] - origin[k], "f4") for k, name in enumerate("xyz")}},
        {"type": "scatter3d", "mode": "markers", "name": "photo", "showlegend": False,
         **{name: packed(cameras[:, k], "f4") for k, name in enumerate("xyz")},
         "text": [plain(photo["name"]) for photo in adjusted], "hovertemplate": "%{text}<extra></extra>",
         "marker": {"size": marker_size(len(adjusted), 3.6), "symbol": "diamond", "color": VERMILLION}},
    ]  # fmt: skip
    names = ("east", "north", "up") if project["crs"] else ("x", "y", "z")
    units = (project["unit"], project["unit"], project["height_unit"])
    low, high = every.min(axis=0), every.max(axis=0)
    margin = 0.03 * max(float((high - low).max()), 1e-6)
    sides = (high - low + 2 * margin) * [unit_metres(unit) or 1.0 for unit in units]
    scene = {
        f"{letter}axis": _space_axis(low[k] - margin, high[k] + margin, origin[k], names[k], short_unit(units[k]))
        for k, letter in enumerate("xyz")
    }
    ratio = 1.25 * sides / (0.75 * sides[:2].max() + 0.6 * sides[2])  # of a size that the camera below sees whole
    scene |= {
        "aspectmode": "manual", "aspectratio": dict(zip("xyz", np.round(ratio, 4).tolist(), strict=True)),
        "camera": {"eye": {"x": 0.0, "y": -1.5, "z": 1.0}, "center": {"x": 0.0, "y": 0.0, "z": -0.12}},
        "dragmode": "turntable",
    }  # fmt: skip
    return Figure(
        name="space", title="Points and photos, to be turned", height_px=560, data=data,
        modes=_modes(cloud, size, project["height_unit"]),
        layout=base_layout(scene=scene, margin={"l": 0, "r": 0, "t": 0, "b": 0}),
        caption="Drag to turn, use the wheel or two fingers to come nearer. Diamonds are the photos; points are grey "
        f"where what colours them is not known. {_share(cloud)}",
    )  # fmt: skip


def _share(cloud: dict[str, Any]) -> str:
    if cloud["num_shown"] == cloud["num_points"]:
        return f"All {cloud['num_points']:,} points are drawn."
    return f"{cloud['num_shown']:,} of the {cloud['num_points']:,} points are drawn."


def _picture(points: Float[np.ndarray, "points 3"], rgb: UInt8[np.ndarray, "points 3"], box: np.ndarray) -> str:
    """Return a PNG of the box as an address: dots so large that they nearly touch, the highest on top."""
    scale = _PICTURE_PX / float((box[1] - box[0]).max())
    width, height = np.maximum(np.round((box[1] - box[0]) * scale).astype(int), 1)
    order = np.argsort(points[:, 2], kind="stable")
    column = np.floor((points[order, 0] - box[0, 0]) * scale).astype(int)
    row = np.floor((box[1, 1] - points[order, 1]) * scale).astype(int)
    spacing = scale * math.sqrt(float(np.prod(np.ptp(points[:, :2], axis=0))) / len(points))
    side = int(np.clip(round(1.4 * spacing), 1, 15))
    canvas = np.zeros((height, width, 4), np.uint8)
    colour = np.concatenate([rgb[order], np.full((len(order), 1), 255, np.uint8)], axis=1)
    for shift in np.ndindex(side, side):
        if math.hypot(shift[0] - (side - 1) / 2, shift[1] - (side - 1) / 2) > max(side / 2, 1.0):
            continue
        x, y = column + shift[0] - side // 2, row + shift[1] - side // 2
        inside = (x >= 0) & (x < width) & (y >= 0) & (y < height)
        canvas[y[inside], x[inside]] = colour[inside]  # of points at one place, the last one stays
    image = Image.fromarray(canvas).quantize(128, Image.Quantize.FASTOCTREE, dither=Image.Dither.NONE)
    buffer = io.BytesIO()
    image.save(buffer, "png", optimize=True)
    return "data:image/png;base64," + base64.b64encode(buffer.getvalue()).decode()


def _modes(cloud: dict[str, Any], size: float, height_unit: str | None) -> list[dict[str, Any]]:
    """Return the ways to colour the points: as in the photos, by height, and by what is known of their errors."""
    row = Image.fromarray(np.array(cloud["rgb"], np.uint8)[None])
    few = row.quantize(_COLOURS, Image.Quantize.MEDIANCUT, dither=Image.Dither.NONE)
    palette = np.array(few.getpalette(), int).reshape(-1, 3)
    last = max(len(palette) - 1, 1)
    scale = [[k / last, f"rgb({r},{g},{b})"] for k, (r, g, b) in enumerate(palette)]
    if len(scale) == 1:  # Plotly wants both ends
        scale.append([1.0, scale[0][1]])
    colours = {"color": packed(np.asarray(few)[0], "u1"), "colorscale": scale, "cmin": 0, "cmax": last}
    modes = [{"label": "Colours", "marker": {"size": size, "symbol": "square", **colours, "showscale": False}}]
    for label, title, key in (
        ("Height", short_unit(height_unit), "z"),
        ("Reprojection error", "px", "error_px"),
        ("Sigma of height", "m", "std_z_m"),
    ):
        if cloud[key] is not None and any(value is not None for value in cloud[key]):
            modes.append({"label": label, "marker": {"size": size, "symbol": "square", **_by_value(cloud[key], title)}})
    return modes


def _by_value(values: list[float | None], title: str) -> dict[str, Any]:
    """Return a marker coloured by values, from the lowest to the highest percent; what is not known is grey."""
    known = np.array([np.nan if value is None else value for value in values], float)
    low, high = np.nanpercentile(known, [1, 99]).tolist()
    high = max(high, low + 1e-9)
    steps = np.where(np.isfinite(known), 1 + 254 * np.clip((known - low) / (high - low), 0, 1), 0)
    ticks = _round_ticks(low, high, 5)
    first = 0 if np.isnan(known).any() else 1  # the bar shows grey where something is
    scale = [[(1 + share * 254 - first) / (255 - first), colour] for share, colour in _VALUES]
    return {
        "color": packed(np.round(steps), "u1"), "cmin": first, "cmax": 255, "showscale": True,
        "colorscale": scale if first else [[0, GREY], [scale[0][0], GREY], *scale],
        "colorbar": colour_bar(
            title, tickvals=[1 + 254 * (tick - low) / (high - low) for tick in ticks],
            ticktext=[f"{tick:,.6g}" for tick in ticks],
        ),
    }  # fmt: skip


def _space_axis(low: float, high: float, origin: float, name: str, unit: str) -> dict[str, Any]:
    """Return an axis over a range that is counted from an origin, with full coordinates as labels."""
    ticks = _round_ticks(low + origin, high + origin, 4)
    labels = [f"{tick:,.{digits_of(300 * (high - low))}f}" for tick in ticks]
    return axis(f"{name} ({unit})" if unit else name) | {
        "range": [float(low), float(high)], "tickvals": [tick - origin for tick in ticks],
        "ticktext": labels, "showbackground": False,
        "zeroline": False, "tickfont": {"size": 10}, "showspikes": False,
    }  # fmt: skip


def _round_ticks(low: float, high: float, most: int) -> list[float]:
    """Return about as many round values in a range."""
    span = max(high - low, 1e-9)
    power = 10.0 ** math.floor(math.log10(span / most))
    step = next(factor * power for factor in (1, 2, 5, 10) if factor * power >= span / most)
    return [round(k * step, 10) for k in range(math.ceil(low / step), math.floor(high / step) + 1)]
