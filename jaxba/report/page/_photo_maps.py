"""Maps of the photos: how well each position is known, how far it is from its GNSS position, and overlap."""

from collections.abc import Iterable
from typing import Any

import numpy as np

from jaxba.report.page._drawing import (
    BLUE,
    DIVERGING,
    ORANGE,
    PURPLE,
    SKY,
    VERMILLION,
    Figure,
    Map,
    arrows,
    colour_bar,
    enlarged,
    line_of,
    magnification,
    map_of,
    marker_size,
    packed,
    plain,
    reference,
    round_down,
    spacing,
    triple,
    unit_metres,
)  # fmt: skip

_ELLIPSE_SIDES = 24
_OVERLAP_COLOURS = ("#d55e00", "#f0a04b", "#f7d9a8", "#d6e6f2", "#a6cbe3", "#6ba6d0", "#3a83bd", "#12609e", "#083d73")


def sigma_map(report: dict[str, Any]) -> Figure | None:
    """Return the map of the photos with their error ellipses; None where no photo has a place."""
    placed = [photo for photo in report["photos"] if place(photo) is not None]
    if not placed:
        return None
    project = report["project"]
    area = map_of(project, [place(photo) for photo in placed]).with_room_below()
    sized = [photo for photo in placed if photo["x"] is not None and photo["ellipse_m"] is not None]
    ellipses, shapes, caption = _ellipses(area, report, sized)
    layout = area.layout(shapes=[shape for shape, _ in shapes], annotations=[text for _, text in shapes])
    lost = len(report["photos"]) - len(placed)
    if lost:
        caption += f" {_photos(lost)} without any position cannot be shown."
    if any(photo["x"] is None for photo in placed):
        caption += " Photos that are not part of the block stand at their GNSS position."
    return Figure(
        name="sigmas", title="How well each photo's position is known", ratio=area.ratio, layout=layout,
        data=[*ellipses, *_by_kind(placed)], caption=caption,
    )  # fmt: skip


def residual_map(report: dict[str, Any]) -> Figure | None:
    """Return the map of the differences from the GNSS positions; None where there is none."""
    adjusted = [photo for photo in report["photos"] if photo["x"] is not None]
    apart = {kind: [photo for photo in adjusted if photo["position"] == kind] for kind in ("let go", "left out")}
    used = [photo for photo in adjusted if photo["position"] == "used" and photo["residual_m"] is not None]
    used = [photo for photo in used if None not in photo["residual_m"][:2]]
    unit_m = unit_metres(report["project"]["unit"])
    if not used or unit_m is None:
        return None
    shown = [place(photo) for photos in (used, *apart.values()) for photo in photos]
    area = map_of(report["project"], shown).with_room_below()
    off = np.array([photo["residual_m"][:2] for photo in used])
    here = np.array([place(photo) for photo in used])
    times = magnification(np.linalg.norm(off, axis=1), 1.4 * unit_m * spacing(here, area))
    shape, text = reference(area, times / unit_m)
    up = [photo["residual_m"][2] for photo in used]
    most = max((abs(value) for value in up if value is not None), default=0.0) or 1.0
    marker = {
        "size": marker_size(len(used)), "color": up, "colorscale": DIVERGING, "cmin": -most, "cmax": most,
        "colorbar": colour_bar("up (m)"), "line": {"color": "@muted", "width": 1},
    }  # fmt: skip
    data = [
        {"type": "scatter", "mode": "lines", "name": "difference, horizontal", "hoverinfo": "skip",
         "line": {"color": "@ink", "width": 1.2}, **arrows(here, here + off * times / unit_m)},
        photo_markers("position used", used, marker, "residual_m"),
    ]  # fmt: skip
    for kind, photos in apart.items():
        if photos:
            data.append(photo_markers(f"position {kind} (no arrow)", photos, _apart(kind, len(used)), "residual_m"))
    return Figure(
        name="gnss", title="Differences from the GNSS positions", ratio=area.ratio, data=data,
        layout=area.layout(shapes=[shape], annotations=[text]),
        caption="Each arrow points the way from a photo's GNSS position to the adjusted one and is drawn "
        f"{enlarged(times)}; the colour is the difference in height. Arrows without a pattern are noise. Arrows that "
        "agree with their neighbours tell of an offset. Positions that contradict the block were let go of; positions "
        "that were left out took no part. The table of photos tells the differences of both.",
    )  # fmt: skip


def overlap_map(report: dict[str, Any]) -> Figure | None:
    """Return the map of how many photos see each piece of ground; None where it was not computed."""
    found = report["overlap"]
    if "none" in found or not found["rows"]:
        return None
    rows, cell = np.array(found["rows"]), found["cell"]
    sides = cell * np.array(rows.shape[::-1])
    low = np.array([found["x0"], found["y0"]])
    area = map_of(report["project"], [low, low + sides])
    most = len(_OVERLAP_COLOURS)
    steps = [(0, "rgba(0,0,0,0)"), *enumerate(_OVERLAP_COLOURS, 1)]
    scale = [[(k + side) / (most + 1), colour] for k, colour in steps for side in (0, 1)]
    ticks = [*map(str, range(1, most)), f"{most}+"]
    adjusted = [photo for photo in report["photos"] if photo["x"] is not None]
    outlines = np.array([[*photo["outline"], photo["outline"][0]] for photo in adjusted if photo["outline"]])
    dots = {"size": marker_size(len(adjusted), 6.0), "color": "#1c2733", "line": {"color": "#ffffff", "width": 0.7}}
    data = [
        {"type": "heatmap", "z": packed(rows, "u1" if rows.max() < 256 else "i4"), "x0": low[0] + cell / 2, "dx": cell,
         "y0": low[1] + cell / 2, "dy": cell, "zmin": -0.5, "zmax": most + 0.5, "colorscale": scale, "xgap": 0.01,
         "colorbar": colour_bar("photos", tickvals=list(range(1, most + 1)), ticktext=ticks),
         "hovertemplate": "%{z} photos<extra></extra>"},
        photo_markers("photo", adjusted, dots),
    ]  # fmt: skip
    if len(outlines):
        data.append({
            "type": "scatter", "mode": "lines", "name": "outline of a photo on the ground", **line_of(outlines),
            "line": {"color": "@muted", "width": 1}, "hoverinfo": "skip", "visible": "legendonly",
        })  # fmt: skip
    return Figure(
        name="overlap", title="Photos that see each piece of ground", ratio=area.ratio, data=data, layout=area.layout(),
        caption="Where the map is blue, four photos or more see the ground, so that an error in one of them is "
        "noticed. Pale orange is seen by three; orange and dark orange, seen by two and by one, are not to be relied "
        "on. Where it is white, no photo sees the ground.",
    )  # fmt: skip


def place(photo: dict[str, Any]) -> tuple[float, float] | None:
    """Return where a photo stands on a map: where it was adjusted, or else where it was measured."""
    if photo["x"] is not None and photo["y"] is not None:
        return photo["x"], photo["y"]
    measured = photo["measured"]
    return None if measured is None or None in measured[:2] else (measured[0], measured[1])


def _apart(kind: str, count: int) -> dict[str, Any]:
    """Return the marker of photos whose measured position was let go of or left out."""
    symbol = {"let go": "square-open", "left out": "diamond-open"}[kind]
    return {"size": marker_size(count) + 2, "symbol": symbol, "color": ORANGE, "line": {"width": 2}}


def _by_kind(photos: list[dict[str, Any]]) -> Iterable[dict[str, Any]]:
    """Yield the photos in the ways in which they took part, those that were used by their sigma in height."""
    kinds = [_kind(photo) for photo in photos]
    used = [photo for photo, kind in zip(photos, kinds, strict=True) if kind == "used"]
    up = [None if photo["std_m"] is None else photo["std_m"][2] for photo in used]
    size = marker_size(len(photos))
    coloured = {"size": size, "color": BLUE, "line": {"color": "@muted", "width": 1}}
    if any(value is not None for value in up):
        coloured |= {"color": up, "colorscale": "Viridis", "reversescale": True, "colorbar": colour_bar("up (m)")}
    for name, kind, marker in (
        ("adjusted", "used", coloured),
        ("adjusted, no GNSS position", "none", {"size": size, "symbol": "square", "color": BLUE}),
        ("adjusted, GNSS position let go", "let go", _apart("let go", len(photos))),
        ("adjusted, GNSS position left out", "left out position", _apart("left out", len(photos))),
        ("not adjusted", "not adjusted", {"size": size + 1, "symbol": "x", "color": VERMILLION}),
        ("left out", "left out", _apart("left out", len(photos)) | {"symbol": "triangle-down-open", "color": PURPLE}),
    ):
        chosen = [photo for photo, its_kind in zip(photos, kinds, strict=True) if its_kind == kind]
        if chosen:
            yield photo_markers(name, chosen, marker, "std_m")


def _kind(photo: dict[str, Any]) -> str:
    if photo["state"] != "adjusted":
        return str(photo["state"])
    return "left out position" if photo["position"] == "left out" else str(photo["position"])


def photo_markers(name: str, photos: list[dict[str, Any]], marker: dict[str, Any], figures: str = "") -> dict[str, Any]:
    """Return photos as markers that tell their name, and their sigmas or their difference."""
    label = {"std_m": "sigma ", "residual_m": "difference "}.get(figures, "")
    texts = []
    for photo in photos:
        lines = [f"<b>{plain(photo['name'])}</b>", photo["state"]]
        if photo["reason"]:
            lines.append(plain(photo["reason"]))
        if figures and photo[figures] is not None:
            lines.append(label + triple(photo[figures]))
        if not figures:
            lines.append(f"{photo['observations']:,} observations, {photo['partners']} partners")
        texts.append("<br>".join(lines))
    places: list[Any] = [place(photo) for photo in photos]
    return {
        "type": "scatter", "mode": "markers", "name": name, "x": [x for x, _ in places], "y": [y for _, y in places],
        "marker": marker, "text": texts, "hovertemplate": "%{text}<extra></extra>",
    }  # fmt: skip


def _ellipses(
    area: Map, report: dict[str, Any], photos: list[dict[str, Any]]
) -> tuple[list[dict[str, Any]], list[tuple[dict[str, Any], dict[str, Any]]], str]:
    """Return the ellipses, the bar that tells their scale, and what the caption says of them."""
    project = report["project"]
    unit_m = unit_metres(project["unit"])
    if not photos:
        return [], [], "No sigmas of positions were computed, so there are no error ellipses."
    if unit_m is None:
        return (
            [],
            [],
            f"Error ellipses are not drawn, since the length of the unit {project['unit']} is not known here.",
        )
    axes = np.array([photo["ellipse_m"] for photo in photos])
    here = np.array([place(photo) for photo in photos])
    times = round_down(0.45 * spacing(here, area) * unit_m / max(float(np.median(axes[:, 0])), 1e-9))
    angle = np.linspace(0, 2 * np.pi, _ELLIPSE_SIDES + 1)[:, None]
    azimuth = np.radians(axes[:, 2])
    major, minor = axes[:, 0] * np.cos(angle), axes[:, 1] * np.sin(angle)
    east = major * np.sin(azimuth) + minor * np.cos(azimuth)  # the major axis points along the azimuth, from north
    north = major * np.cos(azimuth) - minor * np.sin(azimuth)
    outlines = np.moveaxis(here + np.stack([east, north], axis=-1) * times / unit_m, 0, 1)
    trace = {
        "type": "scatter", "mode": "lines", "name": "error ellipse", "hoverinfo": "skip", "fill": "toself",
        "fillcolor": "rgba(86,180,233,0.22)", "line": {"color": SKY, "width": 1.2}, **line_of(outlines),
    }  # fmt: skip
    text = (
        "An error ellipse shows how well a position is known horizontally, one sigma in each direction, and is "
        f"drawn {enlarged(times)}; the colour is the sigma in height. {report['sigmas'].get('text', '')}".rstrip()
    )
    return [trace], [reference(area, times / unit_m)], text


def _photos(count: int) -> str:
    return f"{count:,} photo" + ("" if count == 1 else "s")
