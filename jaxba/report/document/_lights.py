"""The traffic lights of a report: a figure a row, held against limits that stand beside it, and the verdict.

Limits that belong to a parameter are that parameter's. The others are those that photogrammetrists know from quality
reports: photos adjusted, change of the focal length, matches a photo, and control in ground sample distances.
"""

from collections.abc import Sequence
from typing import Any, Literal

import numpy as np

from jaxba.report._findings import is_to_act_on, sentence
from jaxba.report.document._material import Material
from jaxba.scene import Finding

State = Literal["good", "fair", "poor", "unknown"]
_PHOTOS = 0.95, 0.8
_FOCAL = 0.05, 0.2
_MATCHES = 1000.0, 100.0
_SCATTER = 1.5, 3.0  # times the sigmas that positions were stated with
_CONTROL = 2.0, 4.0  # ground sample distances
_CHECKED = 1.5, 3.0  # times what survey and sigmas predict
_INLIERS, _MEDIAN = 0.1, 2.0  # below the limit of the check, and times it, that are still fair


def lights(material: Material) -> list[dict[str, Any]]:
    """Return the lights in the order of the work."""
    return [
        _photos(material),
        _focal(material),
        _matches(material),
        *_errors(material),
        _positions(material),
        _control(material),
        _checks(material),
    ]


def gsd_m(material: Material) -> float:
    """Return the median ground sample distance of the adjusted photos, metres a pixel; NaN where it is not known."""
    adjusted = material.adjusted
    if adjusted is None or not adjusted.block.is_georeferenced:
        return np.nan
    from jaxba.sfm import height_above_ground

    block = adjusted.block
    return float(np.nanmedian(height_above_ground(block) / block.camera_parameters[block.camera_index, 0]))


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


def _row(name: str, value: str, state: State, text: str, limits: str) -> dict[str, Any]:
    return {"name": name, "value": value, "state": state, "text": text, "limits": limits}


def _unknown(name: str, text: str, limits: str) -> dict[str, Any]:
    return _row(name, "", "unknown", text, limits)


def _low(value: float, limits: tuple[float, float]) -> State:
    """Return the state of a figure that is the better, the lower it is."""
    if not np.isfinite(value):
        return "unknown"
    return "good" if value <= limits[0] else "fair" if value <= limits[1] else "poor"


def _high(value: float, limits: tuple[float, float]) -> State:
    return _low(-value, (-limits[0], -limits[1]))


def _photos(material: Material) -> dict[str, Any]:
    limits = f"good from {_PHOTOS[0]:.0%}, poor under {_PHOTOS[1]:.0%}"
    if material.adjusted is None:
        return _unknown("Photos adjusted", "No photo has been adjusted.", limits)
    count = len(material.photos) + len(material.done.metadata.left_out)
    used = material.adjusted.block.num_images
    text = (
        "All photos of the folder are in the block."
        if used == count
        else (f"{count - used} of the folder's photos are not in the block; the table of photos gives each reason.")
    )
    return _row("Photos adjusted", f"{used} of {count}", _high(used / count, _PHOTOS), text, limits)


def _focal(material: Material) -> dict[str, Any]:
    limits = f"good up to {_FOCAL[0]:.0%}, poor over {_FOCAL[1]:.0%}"
    adjusted = material.adjusted
    if adjusted is None:
        return _unknown("Change of focal length", "No camera has been adjusted.", limits)
    block = adjusted.block
    change, camera = max(_focal_changes(material), default=(np.nan, 0))
    if not np.isfinite(change):
        return _unknown("Change of focal length", "No photo states its focal length.", limits)
    focal = float(block.camera_parameters[camera, 0])
    text = f"{block.camera_names[camera]}: {focal:.0f} px as adjusted, against what the photos' tags lead to."
    return _row("Change of focal length", f"{change:.2%}", _low(change, _FOCAL), text, limits)


def _focal_changes(material: Material) -> list[tuple[float, int]]:
    block = material.adjusted.block
    stated: dict[int, float] = {}
    for index, camera in zip(block.image_index, block.camera_index, strict=True):
        focal = material.photos[int(index)].focal_px
        if focal is not None:
            stated.setdefault(int(camera), focal)
    return [(abs(float(block.camera_parameters[k, 0]) / focal - 1), k) for k, focal in stated.items()]


def _matches(material: Material) -> dict[str, Any]:
    name, limits = "Matches a photo", f"good from {_MATCHES[0]:.0f}, poor under {_MATCHES[1]:.0f}, in the median"
    if material.adjusted is None:
        return _unknown(name, "No photo has been adjusted.", limits)
    block = material.adjusted.block
    median = float(np.median(np.bincount(block.observation_image, minlength=block.num_images)))
    text = "Image points of a photo that take part in the adjustment, which other photos show as well."
    return _row(name, f"{median:,.0f}", _high(median, _MATCHES), text, limits)


def _errors(material: Material) -> list[dict[str, Any]]:
    params: Any = material.settings["verify"]
    median, rate = params.max_median_px, params.min_inlier_rate
    of_median = f"good up to {median:g} px, poor over {_MEDIAN * median:g} px"
    of_rate = f"good from {rate:.0%}, poor under {rate - _INLIERS:.0%}"
    adjusted = material.adjusted
    if adjusted is None:
        return [
            _unknown("Reprojection error", "Nothing has been adjusted.", of_median),
            _unknown("Image points that fit", "Nothing has been adjusted.", of_rate),
        ]
    return [
        _row(
            "Reprojection error",
            f"{adjusted.median_px:.2f} px",
            _low(adjusted.median_px, (median, _MEDIAN * median)),
            "Median distance between a measured image point and where the result has it.",
            of_median,
        ),
        _row(
            "Image points that fit",
            f"{adjusted.inlier_rate:.1%}",
            _high(adjusted.inlier_rate, (rate, rate - _INLIERS)),
            "Share of the image points that were judged and not rejected as errors.",
            of_rate,
        ),
    ]


def _positions(material: Material) -> dict[str, Any]:
    name = "Positions of photos"
    limits = f"good up to {_SCATTER[0]:g} times, poor over {_SCATTER[1]:g} times their sigmas"
    adjusted, reference = material.adjusted, material.reference
    if adjusted is None or reference is None or adjusted.gnss_rms_m is None:
        return _unknown(name, "No measured position was used.", limits)
    block, residual = adjusted.block, adjusted.gnss_residual_m
    with np.errstate(invalid="ignore", divide="ignore"):
        middle = np.array([np.median(c[np.isfinite(c)]) if np.isfinite(c).any() else np.nan for c in residual.T])
        times = (residual - middle) / reference.std_m[block.image_index]
    known = np.isfinite(times)
    ratio = float(np.sqrt(np.mean(times[known] ** 2))) if known.any() else np.nan
    rms = ", ".join("unknown" if np.isnan(value) else f"{value:.3f}" for value in adjusted.gnss_rms_m)
    text = (
        f"Measured positions scatter by {ratio:.2f} times the sigmas they were given, about what they have in common; "
        f"their differences have an RMS of {rms} m east, north, up."
    )
    return _row(name, f"{ratio:.2f} sigma", _low(ratio, _SCATTER), text, limits)


def _control(material: Material) -> dict[str, Any]:
    name, limits = "Control points", f"good up to {_CONTROL[0]:g} pixels on the ground, poor over {_CONTROL[1]:g}"
    given = None if material.done.control is None else material.done.control.control
    if given is None or not (~given.is_check).any():
        return _unknown(name, "No control points were given.", limits)
    if material.adjusted is None:
        return _unknown(name, "Nothing has been adjusted.", limits)
    fit, gsd = material.adjusted.control, gsd_m(material)
    rms = fit.control_rms_m[np.isfinite(fit.control_rms_m)]
    if not len(rms) or not np.isfinite(gsd):
        return _unknown(name, "The control points could not be compared with the block.", limits)
    times, aside = float(rms.max() / gsd), int(fit.is_set_aside.any(axis=1).sum())
    text = f"The largest RMS of an axis is {rms.max():.3f} m, {times:.2f} pixels on the ground."
    state = _low(times, _CONTROL)
    if aside:
        text = f"{text} Points set aside for contradicting all else: {aside}."
        most = 2 * aside >= int((~given.is_check).sum())  # the RMS of the few that agree with each other says little
        state = "poor" if most else "fair" if state == "good" else state
    return _row(name, f"{rms.max():.3f} m", state, text, limits)


def _checks(material: Material) -> dict[str, Any]:
    name = "Check points"
    limits = f"good up to {_CHECKED[0]:g} times, poor over {_CHECKED[1]:g} times what their sigmas predict"
    given = None if material.done.control is None else material.done.control.control
    if given is None or not given.is_check.any():
        return _unknown(name, "No check points were given: nothing independent states the accuracy.", limits)
    if material.adjusted is None:
        return _unknown(name, "Nothing has been adjusted.", limits)
    fit = material.adjusted.control
    variance = np.where(given.is_check[:, None], fit.std_m**2 + given.std_m**2, np.nan)
    known = np.isfinite(fit.residual_m) & np.isfinite(variance)
    if not known.any():
        return _unknown(name, "The check points could not be compared with the block, or have no sigmas.", limits)
    times = float(np.sqrt(np.mean(fit.residual_m[known] ** 2 / variance[known])))
    rms = ", ".join("unknown" if np.isnan(value) else f"{value:.3f}" for value in fit.check_rms_m)
    text = f"Differences have an RMS of {rms} m east, north, up: {times:.2f} times what survey and block predict."
    suspect = int((fit.is_suspect & given.is_check).sum())
    state = _low(times, _CHECKED)
    if suspect:
        text = f"{text} Points beyond chance: {suspect}."
        state = "fair" if state == "good" else state
    return _row(name, f"{times:.2f} sigma", state, text, limits)
