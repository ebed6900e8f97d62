"""Charts of what the survey says of the block: GNSS positions photo by photo, control and check points."""

from typing import Any

import numpy as np

from jaxba.report.page._drawing import (
    AXES,
    BLUE,
    ORANGE,
    VERMILLION,
    Figure,
    arrows,
    axis,
    base_layout,
    enlarged,
    magnification,
    map_of,
    plain,
    reference,
    round_down,
    triple,
    unit_metres,
)  # fmt: skip
from jaxba.report.page._photo_maps import place

_ROLES = (("control", BLUE, "triangle-up"), ("check", ORANGE, "circle"))


def positions_chart(report: dict[str, Any]) -> Figure | None:
    """Return the differences from the GNSS positions along each axis, in the order of the photos."""
    rows = [(k, photo) for k, photo in enumerate(report["photos"], 1) if photo["residual_m"] is not None]
    rows = [(k, photo) for k, photo in rows if photo["position"] in ("used", "let go", "left out")]
    if not rows:
        return None
    data = []
    for kind, name, marker in (
        ("used", "position used", {"size": 5, "color": BLUE}),
        ("let go", "position let go", {"size": 9, "color": ORANGE, "symbol": "square-open", "line": {"width": 2}}),
        ("left out", "position left out", {"size": 9, "color": ORANGE, "symbol": "diamond-open", "line": {"width": 2}}),
    ):
        chosen = [(k, photo) for k, photo in rows if photo["position"] == kind]
        for number, letter in enumerate(AXES if chosen else (), 1):
            data.append({
                "type": "scatter", "mode": "markers", "name": name, "legendgroup": kind, "showlegend": number == 1,
                "x": [k for k, _ in chosen], "y": [photo["residual_m"][number - 1] for _, photo in chosen],
                "text": [plain(photo["name"]) for _, photo in chosen], "marker": marker, **_axes(number),
                "hovertemplate": f"<b>%{{text}}</b><br>{letter} %{{y:.3f}} m<extra></extra>",
            })  # fmt: skip
    layout = base_layout(
        xaxis=axis("photo, in the order of the table", zeroline=False, anchor="y3"),
    )
    for number, name in enumerate(AXES, 1):
        low, high = 1 - (number - 0.06) / 3 + 0.01, 1 - (number - 1) / 3 - 0.01
        layout[f"yaxis{number if number > 1 else ''}"] = axis(f"{name} (m)", domain=[max(low, 0), high], nticks=5) | {
            "zerolinecolor": "@muted", "range": _range([photo["residual_m"][number - 1] for _, photo in rows
                                                        if photo["position"] == "used"]),
        }  # fmt: skip
    return Figure(
        name="positions", title="Differences from the GNSS positions, photo by photo", height_px=460, data=data,
        layout=layout,
        caption="Adjusted position minus GNSS position of each photo. The axes show the range of the positions that "
        "were used; positions that were let go of or left out may lie outside, and the table of photos has "
        "their differences.",
    )  # fmt: skip


def control_map(report: dict[str, Any]) -> Figure | None:
    """Return the control and check points with their horizontal differences, among the photos."""
    points = _known(report, 2)
    unit_m = unit_metres(report["project"]["unit"])
    if not points or unit_m is None:
        return None
    photos = [photo for photo in report["photos"] if photo["x"] is not None]
    area = map_of(report["project"], [point["surveyed"][:2] for point in points], [place(photo) for photo in photos])
    area = area.with_room_below()
    off = np.array([point["residual_m"][:2] for point in points])
    times = magnification(np.linalg.norm(off, axis=1), 0.09 * area.longest * unit_m)
    here = np.array([point["surveyed"][:2] for point in points])
    shape, text = reference(area, times / unit_m)
    data: list[dict[str, Any]] = [
        {"type": "scatter", "mode": "markers", "name": "photo", "hoverinfo": "skip",
         "marker": {"size": 3, "color": "@muted"},
         "x": [photo["x"] for photo in photos], "y": [photo["y"] for photo in photos]},
        {"type": "scatter", "mode": "lines", "name": "difference, horizontal", "hoverinfo": "skip",
         "line": {"color": "@ink", "width": 1.6}, **arrows(here, here + off * times / unit_m)},
    ]  # fmt: skip
    for role, colour, symbol in _ROLES:
        chosen = [point for point in points if point["role"] == role]
        if chosen:
            data.append({
                "type": "scatter", "mode": "markers+text", "name": f"{role} point",
                "textposition": ["top center" if point["residual_m"][1] < 0 else "bottom center" for point in chosen],
                "x": [point["surveyed"][0] for point in chosen], "y": [point["surveyed"][1] for point in chosen],
                "text": [plain(point["name"]) for point in chosen], "textfont": {"size": 11, "color": "@ink"},
                "marker": {"size": 11, "symbol": symbol, "color": colour, "line": {"color": "@paper", "width": 1}},
                "hovertext": [f"<b>{plain(point['name'])}</b><br>{triple(point['residual_m'])}" for point in chosen],
                "hoverinfo": "text",
            })  # fmt: skip
    return Figure(
        name="control-map", title="Horizontal differences at the points", ratio=area.ratio, data=data,
        layout=area.layout(shapes=[shape], annotations=[text]),
        caption="Each arrow points from where a point was surveyed to where the adjustment puts it, and is drawn "
        f"{enlarged(times)}. Check points took no part in the adjustment, so that they tell how good it "
        "is.",
    )  # fmt: skip


def control_chart(report: dict[str, Any]) -> Figure | None:
    """Return each point's difference along each axis with its sigma."""
    points = _known(report, 0)
    if not points:
        return None
    points = sorted(points, key=lambda point: point["role"] != "control")
    names = [plain(point["name"]) for point in points]
    data = []
    for number, name in enumerate(AXES, 1):
        for role, colour, symbol in _ROLES:
            rows = [(label, point) for label, point in zip(names, points, strict=True) if point["role"] == role]
            rows = [(label, point) for label, point in rows if point["residual_m"][number - 1] is not None]
            if rows:
                data.append({
                    "type": "scatter", "mode": "markers", "name": f"{role} point", "legendgroup": role,
                    "x": [point["residual_m"][number - 1] for _, point in rows], "y": [label for label, _ in rows],
                    "showlegend": not any(trace["legendgroup"] == role for trace in data),
                    "xaxis": f"x{number if number > 1 else ''}",
                    "error_x": {"array": [_sigma(point, number - 1) for _, point in rows], "thickness": 1.2,
                                "width": 3},
                    "marker": {"size": 9, "symbol": symbol, "color": colour},
                    "hovertemplate": f"<b>%{{y}}</b><br>{name} %{{x:.3f}} m, sigma %{{error_x.array:.3f}} "
                    "m<extra></extra>",
                })  # fmt: skip
    layout = base_layout(
        yaxis=axis(type="category", categoryorder="array", categoryarray=names, autorange="reversed", domain=[0, 1])
    )
    most = max(
        (abs(v) + (_sigma(p, k) or 0) for p in points for k, v in enumerate(p["residual_m"]) if v is not None),
        default=1,
    )
    tick = round_down(max(most, 1e-4))
    for number, name in enumerate(AXES, 1):
        layout[f"xaxis{number if number > 1 else ''}"] = axis(
            f"{name} (m)", domain=[(number - 1) / 3 + 0.012 * (number > 1), number / 3 - 0.012],
            tickvals=[-tick, 0, tick], range=[-1.12 * most, 1.12 * most], tickangle=0,
        ) | {"zerolinecolor": VERMILLION}  # fmt: skip
    return Figure(
        name="control-chart", title="Differences along each axis", height_px=min(130 + 26 * len(points), 1600),
        data=data, layout=layout,
        caption="Adjusted minus surveyed place of each point. A bar is one sigma of the adjusted place to each "
        "side, without that of the survey; the table says by how many sigmas of the difference itself a point is "
        "off.",
    )  # fmt: skip


def _known(report: dict[str, Any], count: int) -> list[dict[str, Any]]:
    """Return the points with differences along so many of the first axes, or along any where it is 0."""
    points = report["control"].get("points", [])
    if count:
        return [p for p in points if None not in p["residual_m"][:count] and None not in p["surveyed"][:count]]
    return [point for point in points if any(value is not None for value in point["residual_m"])]


def _sigma(point: dict[str, Any], number: int) -> float | None:
    """Return the sigma of the adjusted point along an axis."""
    return point["std_m"][number]


def _axes(number: int) -> dict[str, str]:
    return {"xaxis": "x", "yaxis": "y" if number == 1 else f"y{number}"}


def _range(values: list[float | None]) -> list[float] | None:
    known = [abs(value) for value in values if value is not None]
    return None if not known else [-1.15 * max(max(known), 1e-4), 1.15 * max(max(known), 1e-4)]
