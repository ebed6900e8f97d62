"""The figures of a report as PNG, for papers and slides: 1600 x 900 pixels each, the same bytes for the same facts."""

from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from jaxba.report._canvas import INK, PALE, axes_at, drawn, fitting, titles
from jaxba.report.page._drawing import magnification

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Facts = Mapping[str, Any]
_BLUE, _ORANGE = "#0072b2", "#d55e00"
_SHOWN = 0.05  # of a drawing's extent, that what is enlarged may take up
_MAP_PX = 1250.0, 715.0
_STATES = {"good": (_BLUE, 0.5), "weak": ("#e69f00", 0.5), "pruned": (_ORANGE, 1.2)}


def pngs(facts: Facts) -> dict[str, bytes]:
    """Return the files of a report's figures by name; one that has no data is left out."""
    figures: dict[str, tuple[bool, Callable[[Figure, Facts], None]]] = {
        "map": (_has_places(facts), _map),
        "matches": (_has_places(facts) and bool(facts["pairs"].get("first")), _matches),
        "overlap": ("rows" in facts["overlap"], _overlap),
        "residuals": ("histogram" in facts["residuals"], _residuals),
        "correlation": ("names" in facts["correlation"], _correlation),
    }
    return {
        f"{name}.png": drawn(lambda figure, draw=draw: draw(figure, facts))
        for name, (is_known, draw) in figures.items()
        if is_known
    }


def _has_places(facts: Facts) -> bool:
    return sum(photo["x"] is not None for photo in facts["photos"]) > 1


def _places(facts: Facts) -> np.ndarray:
    """Return x and y of each photo: adjusted, else measured, else NaN."""
    rows = []
    for photo in facts["photos"]:
        measured = photo["measured"]
        rows.append([photo["x"], photo["y"]] if photo["x"] is not None else measured[:2] if measured else [np.nan] * 2)
    return np.array(rows, float)


def _map_axes(figure: "Figure", facts: Facts, places: np.ndarray) -> "Axes":
    """Return axes for a map around places, with coordinates of the CRS."""
    low, high = np.nanmin(places, axis=0), np.nanmax(places, axis=0)
    margin = 0.08 * max(float(np.max(high - low)), 1e-9)
    box = np.stack([low - margin, high + margin])
    axes = axes_at(figure, (110, 70, *fitting(box, *_MAP_PX)))
    axes.set_xlim(*box[:, 0])
    axes.set_ylim(*box[:, 1])
    axes.ticklabel_format(useOffset=False, style="plain")
    project = facts["project"]
    unit = f" ({project['unit']})" if project["unit"] else ""
    axes.set_xlabel(f"{'east' if unit else 'X'}{unit}{': ' + project['crs_name'] if project['crs_name'] else ''}")
    axes.set_ylabel(f"{'north' if unit else 'Y'}{unit}")
    return axes


def _map(figure: "Figure", facts: Facts) -> None:
    from matplotlib.patches import Ellipse

    places = _places(facts)
    axes = _map_axes(figure, facts, places)
    photos = facts["photos"]
    sizes = [photo["ellipse_m"][0] for photo in photos if photo["ellipse_m"]]
    extent = float(np.nanmax(np.ptp(places[np.isfinite(places).all(axis=1)], axis=0)))
    times = magnification(np.array(sizes), _SHOWN * extent)
    for photo, place in zip(photos, places, strict=True):
        if photo["ellipse_m"]:
            a, b, azimuth = photo["ellipse_m"]
            axes.add_patch(
                Ellipse(place, 2 * times * b, 2 * times * a, angle=-azimuth, fill=False, color=_ORANGE, linewidth=1.2)
            )
    adjusted = np.array([photo["state"] == "adjusted" for photo in photos])
    axes.scatter(*places[adjusted].T, s=16, color=_BLUE, label="adjusted", zorder=3)
    axes.scatter(*places[~adjusted].T, s=40, color=INK, marker="x", label="not adjusted, where it was measured")
    axes.legend(loc="upper left", bbox_to_anchor=(1.01, 1.0), frameon=False)
    scope = facts["sigmas"].get("scope", "")
    said = f"ellipses of one sigma, {scope}, {times:g} times as large" if sizes else "no sigmas are known"
    titles(figure, "Cameras", f"{int(adjusted.sum())} of {len(photos)} photos adjusted; {said}")


def _matches(figure: "Figure", facts: Facts) -> None:
    from matplotlib.collections import LineCollection

    places, found = _places(facts), facts["pairs"]
    ends, states = np.array([found["first"], found["second"]]).T, np.array(found["state"])
    axes = _map_axes(figure, facts, places)
    for state, (colour, width) in _STATES.items():
        lines = places[ends[states == state]]
        axes.add_collection(LineCollection(list(lines), colors=colour, linewidths=width, alpha=0.5, label=state))
    axes.scatter(*places.T, s=14, color=INK, zorder=3)
    axes.legend(loc="upper left", bbox_to_anchor=(1.01, 1.0), frameon=False)
    counts = [found["state"].count(state) for state in (*_STATES, "rejected")]
    titles(figure, "Pairs of photos with matches", "{} good, {} weak, {} pruned; {} rejected ones".format(*counts))


def _overlap(figure: "Figure", facts: Facts) -> None:
    found = facts["overlap"]
    rows = np.array(found["rows"])
    low = np.array([found["x0"], found["y0"]])
    high = low + found["cell"] * np.array(rows.shape[::-1])
    axes = _map_axes(figure, facts, np.stack([low, high]))
    shown = np.ma.masked_equal(np.minimum(rows, 10), 0)
    image = axes.imshow(
        shown, origin="lower", extent=(low[0], high[0], low[1], high[1]), cmap="cividis", vmin=1, vmax=10,
        interpolation="nearest",
    )  # fmt: skip
    bar = figure.colorbar(image, ax=axes, fraction=0.03, pad=0.02, ticks=range(1, 11))
    bar.set_ticklabels([*map(str, range(1, 10)), "10 or more"])
    inside = rows[rows > 0]
    weak = float(np.mean(inside < 3)) if len(inside) else 1.0
    titles(figure, "Photos that see the ground", f"{weak:.0%} of the cells in fewer than three")


def _residuals(figure: "Figure", facts: Facts) -> None:
    found = facts["residuals"]
    histogram = found["histogram"]
    axes = axes_at(figure, (1060, 80, 490, 330))
    edges, counts = np.array(histogram["edges_px"]), np.array(histogram["counts"])
    axes.bar(edges[:-1], counts, np.diff(edges), align="edge", color=_BLUE, label="used")
    axes.bar(edges[:-1], histogram["rejected"], np.diff(edges), counts, align="edge", color=_ORANGE, label="rejected")
    axes.axvline(histogram["threshold_px"], color=INK, linewidth=1.2, label="MAD threshold")
    axes.set_xlabel("reprojection error (px)")
    axes.set_ylabel("image points")
    axes.legend(frameon=False)
    sensor = max(found["sensors"], key=lambda of: np.sum(of["count"]), default=None)
    if sensor is not None:
        _sensor(figure, sensor)
    titles(figure, "Residuals", f"median {histogram['median_px']:.2f} px, MAD {histogram['mad_px']:.2f} px")


def _sensor(figure: "Figure", sensor: Mapping[str, Any]) -> None:
    """Draw the field over the sensor with the most image points, and its radial profile."""
    dx, dy = (np.array(sensor[name], float) for name in ("dx_px", "dy_px"))
    width, height = sensor["width_px"], sensor["height_px"]
    x, y = np.meshgrid(
        *(_middles(count, length) for count, length in zip(dx.shape[::-1], (width, height), strict=True))
    )
    box = np.array([[0.0, 0.0], [width, height]])
    axes = axes_at(figure, (90, 80, *fitting(box, 860.0, 720.0)))
    known = np.isfinite(dx) & np.isfinite(dy)
    times = magnification(np.hypot(dx[known], dy[known]), _SHOWN * width)
    axes.quiver(
        x[known], y[known], times * dx[known], times * dy[known], angles="xy", scale_units="xy", scale=1.0, color=_BLUE,
        width=0.002,
    )  # fmt: skip
    axes.set_xlim(0, width)
    axes.set_ylim(height, 0)
    axes.set_title(f"mean over the sensor, {times:g} times as long (px)", fontsize=11, loc="left")
    axes = axes_at(figure, (1060, 500, 490, 290))
    radial = {name: np.array(values, float) for name, values in sensor["radial"].items()}
    axes.axhline(0, color=PALE, linewidth=0.8)
    axes.plot(radial["radius_px"], radial["mean_px"], color=_BLUE, label="mean outwards")
    axes.plot(radial["radius_px"], radial["rms_px"], color=_ORANGE, linestyle="--", label="RMS")
    axes.set_xlabel("distance from the middle of the photo (px)")
    axes.set_ylabel("residual (px)")
    axes.legend(frameon=False)


def _middles(count: int, length: int) -> np.ndarray:
    return (np.arange(count) + 0.5) / count * length


def _correlation(figure: "Figure", facts: Facts) -> None:
    found = facts["correlation"]
    matrix = np.array(found["matrix"], float)
    axes = axes_at(figure, (250, 130, 680, 680))
    image = axes.imshow(matrix, cmap="RdBu_r", vmin=-1, vmax=1)
    axes.set_xticks(range(len(matrix)), found["names"], rotation=45, ha="right")
    axes.set_yticks(range(len(matrix)), found["names"])
    for (row, column), value in np.ndenumerate(matrix):
        if np.isfinite(value):
            colour = "white" if abs(value) > 0.6 else INK
            axes.text(column, row, f"{value:+.2f}", ha="center", va="center", fontsize=7, color=colour)
    figure.colorbar(image, ax=axes, fraction=0.03)
    titles(figure, "Correlations of what photos share", "near +1 or -1 two unknowns can be exchanged for each other")
