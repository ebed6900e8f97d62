"""The traffic lights of a report: a figure a row, held against limits that stand beside it, and the verdict.

Limits that belong to a parameter are that parameter's. The others are those that photogrammetrists know from quality
reports: photos adjusted, change of the focal length, tie points a photo, and control and check points in ground sample
distances. Points are held to no less than their survey is good to.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np

from jaxba.report._findings import is_to_act_on, sentence
from jaxba.report.document._light import high, low, row, unknown
from jaxba.report.document._material import Material
from jaxba.report.document._survey_lights import check_light, control_light, positions_light
from jaxba.scene import Finding

_PHOTOS = 0.95, 0.8
_FOCAL = 0.05, 0.2
_TIE_POINTS = 1000.0, 100.0
_INLIERS, _MEDIAN = 0.1, 2.0  # below the limit of the check, and times it, that are still fair


def lights(material: Material) -> list[dict[str, Any]]:
    """Return the lights in the order of the work."""
    return [
        _photos(material),
        _focal(material),
        _tie_points(material),
        *_errors(material),
        positions_light(material),
        control_light(material),
        check_light(material),
    ]


def verdict(material: Material, rows: Sequence[dict[str, Any]]) -> dict[str, str]:
    """Return what all of it comes to: no better than the poorest light, and poor where a finding says so."""
    findings: tuple[Finding, ...] = material.found.findings
    if material.adjusted is None:
        return {"state": "unknown", "text": "There is no adjusted block to judge yet."}
    refused = [sentence(finding) for finding in findings if finding.kind == "do not use"]
    if refused:
        return {"state": "poor", "text": refused[0]}
    poor, fair = ([row["name"].lower() for row in rows if row["state"] == state] for state in ("poor", "fair"))
    acts = sum(is_to_act_on(finding) for finding in findings)
    asks = f" Findings that ask for action: {acts}." if acts else ""
    if poor:
        return {"state": "poor", "text": f"Poor by its limits: {', '.join(poor)}.{asks}"}
    if fair or acts:
        said = f"Fair by its limits: {', '.join(fair)}." if fair else "Every figure is within its limits."
        return {"state": "fair", "text": f"{said}{asks}"}
    return {
        "state": "good",
        "text": "Every figure that could be judged is within its limits, and no finding asks for action.",
    }


def _photos(material: Material) -> dict[str, Any]:
    limits = f"good from {_PHOTOS[0]:.0%}, poor under {_PHOTOS[1]:.0%}"
    if material.adjusted is None:
        return unknown("Photos adjusted", "No photo has been adjusted.", limits)
    count = len(material.photos) + len(material.done.metadata.left_out)
    used = material.adjusted.block.num_images
    text = (
        "All photos of the folder are in the block."
        if used == count
        else (f"{count - used} of the folder's photos are not in the block; the table of photos gives each reason.")
    )
    return row("Photos adjusted", f"{used} of {count}", high(used / count, _PHOTOS), text, limits)


def _focal(material: Material) -> dict[str, Any]:
    limits = f"good up to {_FOCAL[0]:.0%}, poor over {_FOCAL[1]:.0%}"
    adjusted = material.adjusted
    if adjusted is None:
        return unknown("Change of focal length", "No camera has been adjusted.", limits)
    block = adjusted.block
    change, camera = max(_focal_changes(material), default=(np.nan, 0))
    if not np.isfinite(change):
        return unknown("Change of focal length", "No photo states its focal length.", limits)
    focal = float(block.camera_parameters[camera, 0])
    text = f"{block.camera_names[camera]}: {focal:.0f} px as adjusted, against what the photos' tags lead to."
    return row("Change of focal length", f"{change:.2%}", low(change, _FOCAL), text, limits)


def _focal_changes(material: Material) -> list[tuple[float, int]]:
    block = material.adjusted.block
    stated: dict[int, float] = {}
    for index, camera in zip(block.image_index, block.camera_index, strict=True):
        focal = material.photos[int(index)].focal_px
        if focal is not None:
            stated.setdefault(int(camera), focal)
    return [(abs(float(block.camera_parameters[k, 0]) / focal - 1), k) for k, focal in stated.items()]


def _tie_points(material: Material) -> dict[str, Any]:
    name, limits = (
        "Tie points a photo",
        f"good from {_TIE_POINTS[0]:.0f}, poor under {_TIE_POINTS[1]:.0f}, in the median",
    )
    if material.adjusted is None:
        return unknown(name, "No photo has been adjusted.", limits)
    block = material.adjusted.block
    median = float(np.median(np.bincount(block.observation_image, minlength=block.num_images)))
    text = "Points in a photo that take part in the adjustment, and that other photos show as well."
    return row(name, f"{median:,.0f}", high(median, _TIE_POINTS), text, limits)


def _errors(material: Material) -> list[dict[str, Any]]:
    params: Any = material.settings["verify"]
    median, rate = params.max_median_px, params.min_inlier_rate
    of_median = f"good up to {median:g} px, poor over {_MEDIAN * median:g} px"
    of_rate = f"good from {rate:.0%}, poor under {rate - _INLIERS:.0%}"
    adjusted = material.adjusted
    if adjusted is None:
        return [
            unknown("Reprojection error", "Nothing has been adjusted.", of_median),
            unknown("Image points that fit", "Nothing has been adjusted.", of_rate),
        ]
    return [
        row(
            "Reprojection error",
            f"{adjusted.median_px:.2f} px",
            low(adjusted.median_px, (median, _MEDIAN * median)),
            "Median distance between a measured image point and where the result has it.",
            of_median,
        ),
        row(
            "Image points that fit",
            f"{adjusted.inlier_rate:.1%}",
            high(adjusted.inlier_rate, (rate, rate - _INLIERS)),
            "Share of the image points that were judged and not rejected as errors.",
            of_rate,
        ),
    ]
