"""Charts of the errors in the photos: over the sensor, along the radius, as a histogram; and of the camera."""

from itertools import pairwise
from typing import Any

import numpy as np

from jaxba.report.page._drawing import (
    BLUE,
    GREY,
    ORANGE,
    VERMILLION,
    Figure,
    arrows,
    axis,
    base_layout,
    colour_bar,
    enlarged,
    plain,
    round_down,
)  # fmt: skip
from jaxba.report.page._tables import number

_CORRELATION = [[0, "rgba(213,94,0,0.7)"], [0.5, "rgba(128,138,148,0.08)"], [1, "rgba(0,114,178,0.7)"]]  # under texts
_ARROW = 0.9  # of a cell's width, what nine arrows in ten stay under


def histogram(report: dict[str, Any]) -> Figure | None:
    """Return how many keypoints miss their point by how much, and where the limit is."""
    found = report["residuals"].get("histogram")
    if not found or not found["counts"]:
        return None
    edges = np.array(found["edges_px"])
    middle, width = (edges[:-1] + edges[1:]) / 2, np.diff(edges)
    texts = [f"{low:g} to {high:g} px" for low, high in pairwise(found["edges_px"])]
    bars = [
        {"type": "bar", "name": name, "x": middle.tolist(), "y": found[key], "width": width.tolist(), "text": texts,
         "textposition": "none", "hovertemplate": "%{text}: %{y:,}<extra></extra>", "marker": marker}
        for name, key, marker in (
            ("used", "counts", {"color": BLUE, "line": {"width": 0}}),
            ("rejected", "rejected",
             {"color": ORANGE, "line": {"width": 0},
              "pattern": {"shape": "/", "size": 5, "fgcolor": "@paper", "fillmode": "overlay"}}),
        )
    ]  # fmt: skip
    marks = [
        (found["median_px"], "median {:.2f} px", "@ink", 1.0),
        (found["threshold_px"], "limit {:.2f} px", VERMILLION, 0.9),
    ]
    known = [(value, text.format(value), colour, y) for value, text, colour, y in marks if value is not None]
    shapes = [
        {"type": "line", "x0": value, "x1": value, "y0": 0, "y1": 1, "yref": "paper",
         "line": {"color": colour, "width": 1.5, "dash": "dash"}}
        for value, _, colour, _ in known
    ]  # fmt: skip
    labels = [
        {"x": value, "y": y, "yref": "paper", "text": text, "showarrow": False, "xanchor": "left", "yanchor": "top",
         "xshift": 4}
        for value, text, _, y in known
    ]  # fmt: skip
    end = float(edges[-1])
    layout = base_layout(
        barmode="stack", bargap=0, shapes=shapes, annotations=labels, hovermode="x",
        xaxis=axis("reprojection error (px)", range=[0, end], zeroline=False),
        yaxis=axis("image points", tickformat=",", rangemode="tozero"),
    )  # fmt: skip
    robust = "" if found["mad_px"] is None else f" (median absolute deviation {found['mad_px']:.2f} px)"
    return Figure(
        name="histogram", title="How large the errors are", height_px=360, data=bars, layout=layout,
        caption="How far image points lie from where the computed cameras and points put them. An error over the limit "
        f"is taken for a wrong match. The limit follows from the spread of all errors{robust} within bounds that the "
        "glossary names; points of few photos are held to less. The last bar holds all that lies beyond. Rejected ones "
        "whose point was rejected as well have no error to be drawn.",
    )  # fmt: skip


def sensor_field(report: dict[str, Any], sensor: dict[str, Any]) -> Figure | None:
    """Return the mean errors in each part of a sensor as arrows."""
    count = np.array(sensor["count"])
    if not count.size or not count.any():
        return None
    rows, columns = count.shape
    size = np.array([sensor["width_px"], sensor["height_px"]], float)
    cell = size / [columns, rows]
    x, y = np.meshgrid((np.arange(columns) + 0.5) * cell[0], (np.arange(rows) + 0.5) * cell[1])
    off = np.array([_filled(sensor["dx_px"]), _filled(sensor["dy_px"])])
    seen = (count > 0) & np.isfinite(off).all(axis=0)
    length = np.hypot(*off)
    times = round_down(_ARROW * cell.min() / max(float(np.percentile(length[seen], 90)), 1e-9))
    start = np.stack([x[seen], y[seen]], axis=1)
    texts = [
        f"mean error {dx:+.3f}, {dy:+.3f} px<br>{number:,} image points"
        for dx, dy, number in zip(*off[:, seen].tolist(), count[seen].tolist(), strict=True)
    ]
    data = [
        {"type": "heatmap", "z": [[value if ok else None for value, ok in zip(*both, strict=True)] for both in
                                  zip(np.round(length, 4).tolist(), seen.tolist(), strict=True)],
         "x0": cell[0] / 2, "dx": cell[0], "y0": cell[1] / 2, "dy": cell[1], "hoverinfo": "skip", "zmin": 0,
         "colorscale": [[0, "rgba(86,180,233,0.03)"], [1, "rgba(86,180,233,0.75)"]],
         "colorbar": colour_bar("px")},
        {"type": "scatter", "mode": "lines", "line": {"color": "@ink", "width": 1.1}, "hoverinfo": "skip",
         "showlegend": False, **arrows(start, start + times * off[:, seen].T)},
        {"type": "scatter", "mode": "markers", "x": start[:, 0].tolist(), "y": start[:, 1].tolist(), "text": texts,
         "marker": {"size": 10, "color": GREY, "opacity": 0}, "hovertemplate": "%{text}<extra></extra>",
         "showlegend": False},
    ]  # fmt: skip
    beyond = float(cell.min())  # arrows of the outermost cells end outside
    frame = {"type": "rect", "x0": 0, "y0": 0, "x1": size[0], "y1": size[1], "line": {"color": "@muted", "width": 1}}
    bare: dict[str, Any] = {"constrain": "domain", "showgrid": False, "zeroline": False, "nticks": 6}
    layout = base_layout(
        shapes=[frame],
        xaxis=axis("x (px)", range=[-beyond, size[0] + beyond], **bare),
        yaxis=axis("y (px)", range=[size[1] + beyond, -beyond], scaleanchor="x", **bare),
    )
    return Figure(
        name=f"sensor-{sensor['camera']}", title=f"Mean errors over the sensor{_of(report, sensor)}", data=data,
        layout=layout, ratio=float((size[1] + 2 * beyond) / (size[0] + 2 * beyond)),
        caption="Each arrow is the mean error in its part of the photos, from where image points were measured to "
        f"where the result has them, drawn {enlarged(times)}. Short arrows in all directions are noise. "
        "Arrows that turn or spread together show what the camera's model does not describe.",
    )  # fmt: skip


def radial_profile(report: dict[str, Any], sensor: dict[str, Any]) -> Figure | None:
    """Return the errors along the radius against the distance from the centre."""
    radial = sensor["radial"]
    if not radial["radius_px"]:
        return None
    counts = [f"{count:,} image points" for count in radial["count"]]
    lines = [
        {"type": "scatter", "mode": "lines+markers", "name": name, "x": radial["radius_px"], "y": radial[key],
         "text": counts, "line": {"color": colour, "width": 2, "dash": dash}, "marker": {"size": 6, "symbol": symbol},
         "hovertemplate": "%{y:.3f} px at %{x:.0f} px<br>%{text}<extra></extra>"}
        for name, key, colour, dash, symbol in (
            ("mean, away from the centre", "mean_px", BLUE, "solid", "circle"),
            ("root mean square", "rms_px", ORANGE, "dot", "square"),
        )
    ]  # fmt: skip
    layout = base_layout(
        xaxis=axis("distance from the centre (px)", rangemode="tozero", zeroline=False, tickformat=",.0f"),
        yaxis=axis("error (px)") | {"zerolinecolor": "@muted"},
    )
    return Figure(
        name=f"radial-{sensor['camera']}", title=f"Errors along the radius{_of(report, sensor)}", height_px=320,
        data=lines, layout=layout,
        caption="Where the blue line stays near zero, the distortion of the lens is described well. A line that "
        "rises or falls towards the corner says that it is not.",
    )  # fmt: skip


def correlation(report: dict[str, Any]) -> Figure | None:
    """Return how the camera's parameters go together."""
    found = report["correlation"]
    if "none" in found or not found["names"]:
        return None
    names = [plain(name) for name in found["names"]]
    texts = [[number(value, 2) for value in row] for row in found["matrix"]]
    heat = {
        "type": "heatmap", "z": found["matrix"], "x": names, "y": names, "zmin": -1, "zmax": 1,
        "colorscale": _CORRELATION,
        "colorbar": colour_bar("", tickvals=[-1, -0.5, 0, 0.5, 1]), "text": texts, "xgap": 1, "ygap": 1,
        "hovertemplate": "%{y} and %{x}: %{text}<extra></extra>",
    }  # fmt: skip
    if len(names) <= 14:
        heat |= {"texttemplate": "%{text}", "textfont": {"size": 11, "color": "@ink"}}
    layout = base_layout(
        xaxis=axis(type="category", showgrid=False, tickangle=-45),
        yaxis=axis(type="category", showgrid=False, autorange="reversed"),
    )
    return Figure(
        name="correlation", title="Correlation of the parameters", height_px=min(240 + 32 * len(names), 900),
        data=[heat], layout=layout,
        caption="Of two parameters with a correlation near 1 or -1 the photos know mainly a combination. That fx and "
        "fy go together is usual; what matters is whether the sigmas in the table above are small.",
    )  # fmt: skip


def _filled(rows: list[list[float | None]]) -> np.ndarray:
    return np.array([[np.nan if value is None else value for value in row] for row in rows], float)


def _of(report: dict[str, Any], sensor: dict[str, Any]) -> str:
    """Return which camera's, where there are several."""
    if len(report["residuals"]["sensors"]) < 2:
        return ""
    cameras = report["cameras"]
    named = sensor["camera"] < len(cameras)
    return f": {cameras[sensor['camera']]['name']}" if named else f": camera {sensor['camera']}"
