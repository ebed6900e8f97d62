"""The key figures of a report: what a customer asks first, each with its unit."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from jaxba.report.document._material import Material, gsd_m

_AXES = ("east", "north", "up")


def key_figures(material: Material, facts: Mapping[str, Any]) -> list[dict[str, str]]:
    """Return name and value of each; `facts`: the sections `project`, `overlap` and `sigmas`."""
    adjusted = material.adjusted
    if adjusted is None:
        return _named([("Photos", f"{len(material.photos):,}"), *_flown(facts["project"])])
    block = adjusted.block
    views = np.bincount(block.observation_point, minlength=block.num_points)
    rows = [
        ("Photos adjusted", f"{block.num_images:,} of {len(material.photos):,}"),
        *_flown(facts["project"]),
        *_ground(material, facts["overlap"]),
        ("Cameras", f"{len(block.camera_names)}"),
        ("Points", f"{block.num_points:,}"),
        ("Points in three photos or more", f"{int((views > 2).sum()):,}"),
        ("Image points", f"{block.num_observations:,}"),
        ("Image points rejected", f"{adjusted.num_rejected:,}"),
        ("Median reprojection error", f"{adjusted.median_px:.2f} px"),
        ("Sigma of an image coordinate", f"{adjusted.std_px * adjusted.spread:.2f} px"),
        ("Rounds of adjustment", f"{adjusted.rounds}"),
        *_sigmas(facts["sigmas"]),
    ]
    return _named(rows)


def _flown(project: Mapping[str, Any]) -> list[tuple[str, str]]:
    """Return the day of the flight, or its first and last."""
    days = [time[:10] for time in (project["first_photo"], project["last_photo"]) if time]
    return [("Date of the flight", " to ".join(dict.fromkeys(days)))] if days else []


def _ground(material: Material, overlap: Mapping[str, Any]) -> list[tuple[str, str]]:
    from jaxba.sfm import height_above_ground

    block, rows = material.adjusted.block, []
    if "none" not in overlap:
        area_m2 = overlap["area_m2"]
        rows += [
            ("Area seen by two photos or more", f"{area_m2:,.0f} m\u00b2 ({area_m2 / 1e4:,.2f} ha)"),
            ("Overlap, median", f"{overlap['median']:.0f} photos"),
        ]
    if block.is_georeferenced:
        height_m = float(np.nanmedian(height_above_ground(block)))
        rows.append(("Flying height above ground, median", f"{height_m:.1f} m"))
    gsd = gsd_m(material)
    if np.isfinite(gsd):
        rows.append(("Ground sample distance", f"{100 * gsd:.2f} cm/px"))
    return rows


def _sigmas(found: Mapping[str, Any]) -> list[tuple[str, str]]:
    if "none" in found:
        return []
    is_absolute = found["scope"] == "absolute"
    rows = [
        (f"Absolute sigma of a {what}" if is_absolute else f"Sigma of a {what} {found['scope']}", _along(found[key]))
        for what, key in (("camera", "camera_m"), ("point", "point_m"))
    ]
    absolute = "not known" if found["absolute_m"] is None else _along(found["absolute_m"])
    return [*rows, ("Absolute accuracy of a point", absolute)]


def _along(values: Sequence[float]) -> str:
    digits = 3 if np.nanmin(np.append(values, np.inf)) < 1 else 1  # of metres, which one position may be off
    known = [(f"{value:.{digits}f}", axis) for value, axis in zip(values, _AXES, strict=True) if np.isfinite(value)]
    return (
        f"{', '.join(value for value, _ in known)} m {', '.join(axis for _, axis in known)}" if known else "not known"
    )


def _named(rows: Sequence[tuple[str, str]]) -> list[dict[str, str]]:
    return [{"name": name, "value": value} for name, value in rows]
