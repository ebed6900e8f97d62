"""Sections on what was measured beside the photos: positions, attitudes, control, scale bars, accuracy."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from jaxba.report._accuracy import Accuracy, accuracy, accuracy_row
from jaxba.report._bars import bar_facts
from jaxba.report._control import control_facts
from jaxba.report.document._material import NOT_ADJUSTED, Material
from jaxba.scene import Block, FlightOffsets, LocalFrame

_TOLD = np.sqrt(0.5)  # of a prior's sigma: beyond it measurements tell less than the prior


def positions(material: Material, photos: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Return how the adjusted positions of cameras fit the measured ones; `photos`: the rows of photos."""
    adjusted, reference = material.adjusted, material.reference
    if adjusted is None:
        return {"none": NOT_ADJUSTED}
    residual = adjusted.gnss_residual_m
    used = np.isfinite(residual).any(axis=1)
    if reference is None or not used.any():
        return {"none": "No position of a photo was used."}
    let_go = material.let_go
    used &= np.array([material.photos[i].name not in let_go for i in adjusted.block.image_index])
    stated = np.where(np.isfinite(residual[used]), reference.std_m[adjusted.block.image_index[used]], np.nan)
    median = [float(np.median(c[np.isfinite(c)])) if np.isfinite(c).any() else np.nan for c in stated.T]
    common, common_std = common_offset(material)
    return {
        "num": int(used.sum()),
        "num_let_go": len(let_go),
        "num_left_out": sum(row["position"] == "left out" for row in photos),
        "mean_m": _by_axis(residual[used], np.mean),
        "rms_m": _by_axis(residual[used], lambda values: np.sqrt(np.mean(values**2))),
        "stated_m": median,
        "taken_m": (np.array(median) * adjusted.position_scale).tolist(),
        "common_m": common,
        "common_std_m": common_std,
        "flights": _flights(adjusted.flights),
    }


def _flights(found: FlightOffsets | None) -> list[dict[str, Any]]:
    if found is None:
        return []
    return [
        {
            "number": int(found.number[k]),
            "num_photos": int(found.num_photos[k]),
            "offset_m": (-found.offset_m[k]).tolist(),
            "std_m": found.std_m[k].tolist(),
        }
        for k in range(len(found.number))
    ]


def common_offset(material: Material) -> tuple[list[float] | None, list[float] | None]:
    """Return what all positions have in common, adjusted minus measured, and its sigma, where control tells it.

    NaN along an axis whose sigma is hardly less than the one that was assumed before: nothing has told it there.
    """
    fit, prior = material.adjusted.control, material.adjusted.common
    std_m = fit.gnss_minus_control_std_m
    is_told = np.isfinite(fit.gnss_minus_control_m)
    if prior is not None and fit.method == "adjust":
        is_told &= ~(std_m >= _TOLD * prior.std_m)
    if not is_told.any():
        return None, None
    return np.where(is_told, -fit.gnss_minus_control_m, np.nan).tolist(), np.where(is_told, std_m, np.nan).tolist()


def _by_axis(values: np.ndarray, figure: Any) -> list[float]:
    return [float(figure(c[np.isfinite(c)])) if np.isfinite(c).any() else np.nan for c in values.T]


def attitudes(material: Material) -> dict[str, Any]:
    """Return how the adjusted attitudes differ from those measured: their heading, about up, and then their tilt.

    Angles are on a circle. The mean is the direction of the mean of unit vectors, and the spread about it is the
    circular standard deviation sqrt(-2 ln R) of their length R (Mardia and Jupp 2000, section 2.3).
    """
    from scipy.spatial.transform import Rotation

    adjusted, reference = material.adjusted, material.reference
    if adjusted is None:
        return {"none": NOT_ADJUSTED}
    block: Block = adjusted.block
    if reference is None or not block.is_georeferenced:
        return {"none": "The block has no place on earth, so that attitudes have nothing to be compared with."}
    measured = reference.quaternion[block.image_index]
    known = np.isfinite(measured).all(axis=1)
    if not known.any():
        return {"none": "No photo has an attitude of its camera."}
    one = Rotation.from_quat(block.quaternion[known], scalar_first=True).inv()
    other = Rotation.from_quat(measured[known], scalar_first=True).inv()
    turn: Any = one * other.inv()
    w, _, _, z = turn.as_quat(scalar_first=True).T
    heading = 2 * np.arctan2(z, w)
    tilt = (turn * Rotation.from_rotvec(np.outer(-heading, [0.0, 0.0, 1.0]))).as_rotvec()
    angles = np.exp(1j * np.column_stack([tilt[:, :2], heading])).mean(axis=0)
    contradict = [finding for finding in material.found.findings if finding.kind == "attitudes contradict"]
    return {
        "num": int(known.sum()),
        "names": ["about east", "about north", "about up"],
        "mean_deg": np.degrees(np.angle(angles)).tolist(),
        "spread_deg": np.degrees(np.sqrt(-2 * np.log(np.clip(np.abs(angles), 1e-12, 1.0)))).tolist(),
        "contradict": [name for finding in contradict for name in finding.figures["names"]],
    }


def control(material: Material) -> dict[str, Any]:
    """Return control and check points with what they say of the block, and what would be seen of an error in each.

    The redundancy number r follows from the minimal detectable error d of a test with the noncentrality c, and from the
    sigma s of the survey: d = c s / sqrt(r) (Baarda 1968).
    """
    from jaxba.ba import NONCENTRALITY

    given = None if material.done.control is None else material.done.control.control
    if given is None or not given.num_points:
        return {"none": "No control or check points were given (--gcp, --check)."}
    if material.adjusted is None:
        return {"none": NOT_ADJUSTED}
    fit, frame = material.adjusted.control, material.frame
    facts = control_facts(given, fit)
    surveyed = np.where(np.isfinite(given.std_m), material.in_crs(given.xyz_m), np.nan)
    adjusted = material.in_crs(fit.adjusted_m) if frame is not None else fit.adjusted_m
    points = facts["points"]
    redundancy = (NONCENTRALITY * given.std_m * fit.scale[[0, 0, 1]] / fit.detectable_m) ** 2
    for k, point in enumerate(points):
        point |= {
            "surveyed": surveyed[k].tolist(),
            "adjusted": adjusted[k].tolist(),
            "survey_std_m": given.std_m[k].tolist(),
            "redundancy": redundancy[k].tolist(),
            "detectable_m": ["any" if value == np.inf else value for value in fit.detectable_m[k].tolist()],
        }
    is_check = given.is_check
    shift = None if np.isnan(fit.check_shift_m).all() else fit.check_shift_m.tolist()
    return {
        "method": fit.method,
        "num_control": int((~is_check).sum()),
        "num_check": int(is_check.sum()),
        "control_rms_m": fit.control_rms_m.tolist(),
        "check_rms_m": fit.check_rms_m.tolist(),
        "check_shift_m": shift,
        "check_shift_std_m": None if shift is None else fit.check_shift_std_m.tolist(),
        "points": points,
    }


def bars(material: Material) -> dict[str, Any]:
    """Return the scale bars."""
    given = None if material.done.control is None else material.done.control.bars
    if given is None or not given.num:
        return {"none": "No scale bars were given (--bars)."}
    return {"none": NOT_ADJUSTED} if material.adjusted is None else {"bars": bar_facts(given, material.adjusted.bars)}


def accuracy_section(material: Material) -> dict[str, Any]:
    """Return the accuracy of the product by its check points."""
    if material.adjusted is None or material.done.control is None:
        return {"none": NOT_ADJUSTED}
    params: Any = material.settings["export"]
    target = tuple(np.nan if value is None else float(value) for value in (params.accuracy_h, params.accuracy_v))
    found = accuracy(material.done.control.control, material.adjusted.control, (target[0], target[1]))
    if found is None:
        return {"none": "No check point can be compared with the block, so nothing independent states its accuracy."}
    return {"text": f"{accuracy_row(found.facts())}.", "rows": _rows(found), "blunders": list(found.blunders)}


def _rows(found: Accuracy) -> list[dict[str, Any]]:
    target_h, target_v = found.target_m
    rows = []
    for k, name in enumerate(("east", "north", "up")):
        rows.append((name, found.num[k], found.fit_m[k], found.survey_m[k], found.product_m[k], np.nan))
    fit, survey = (float(np.hypot(*of[:2])) for of in (found.fit_m, found.survey_m))
    rows.append(("horizontal", min(found.num[:2]), fit, survey, found.horizontal_m, target_h))
    rows.append(("vertical", found.num[2], found.fit_m[2], found.survey_m[2], found.vertical_m, target_v))
    return [
        {
            "name": name,
            "num": num,
            "fit_m": float(fit),
            "survey_m": float(survey),
            "product_m": float(product),
            "target_m": float(wanted),
            "state": _state(float(product), float(wanted)),
        }
        for name, num, fit, survey, product, wanted in rows
    ]


def _state(product_m: float, target_m: float) -> str:
    if not (np.isfinite(product_m) and np.isfinite(target_m)):
        return "unknown"
    return "good" if product_m <= target_m else "poor"


def place(frame: LocalFrame | None) -> dict[str, Any]:
    """Return what coordinates are in."""
    return {
        "crs": None if frame is None else frame.crs,
        "crs_name": None if frame is None else frame.crs_name,
        "unit": None if frame is None else frame.unit,
        "height_unit": None if frame is None else frame.height_unit,
        "heights": None if frame is None else frame.height_note,
    }
