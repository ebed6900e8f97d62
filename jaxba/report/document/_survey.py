"""Sections on what was measured beside the photos: cameras, positions, attitudes, control, scale bars, statistics."""

from typing import Any

import numpy as np

from jaxba.report._accuracy import Accuracy, accuracy, accuracy_row
from jaxba.report._bars import bar_facts
from jaxba.report._control import control_facts
from jaxba.report._statistics import statistics_facts
from jaxba.report.document._material import NOT_ADJUSTED, Material
from jaxba.scene import Block, FlightOffsets, LocalFrame

_LENGTHS = "f", "fx", "fy", "cx", "cy"


def cameras(material: Material) -> list[dict[str, Any]]:
    """Return each camera with its intrinsics: at the start, adjusted, and their sigmas."""
    from jaxba.geometry import CAMERAS

    adjusted = material.adjusted
    if adjusted is None:
        return []
    block: Block = adjusted.block
    names = CAMERAS[block.camera_model].parameter_names()
    start = {name: row for name, row in zip(*_start(material), strict=True)}
    found = []
    for number, camera in enumerate(block.camera_names):
        mine = np.flatnonzero(block.camera_index == number)
        photo = material.photos[int(block.image_index[mine[0]])] if len(mine) else None
        before = start.get(camera)
        found.append(
            {
                "name": camera,
                "model": block.camera_model,
                "num_photos": len(mine),
                "width_px": None if photo is None else photo.width_px,
                "height_px": None if photo is None else photo.height_px,
                "parameters": [
                    {
                        "name": name,
                        "unit": "px" if name in _LENGTHS else "",
                        "start": None if before is None else float(before[k]),
                        "value": float(block.camera_parameters[number, k]),
                        "std": float(adjusted.intrinsics_std[number, k]),
                        "fixed": bool(adjusted.intrinsics_std[number, k] == 0),
                    }
                    for k, name in enumerate(names)
                ],
            }
        )
    return found


def _start(material: Material) -> tuple[tuple[str, ...], np.ndarray]:
    block = material.done.start.block
    same = block.camera_model == material.adjusted.block.camera_model
    return (block.camera_names, block.camera_parameters) if same else ((), np.zeros((0, 0)))


def correlation(material: Material) -> dict[str, Any]:
    """Return the correlations among what images share."""
    if material.adjusted is None:
        return {"none": NOT_ADJUSTED}
    found = material.adjusted.statistics
    if found is None or not len(found.unknowns):
        return {"none": "Sigmas of what images share were not computed."}
    return {"names": list(found.unknowns), "matrix": found.correlation.tolist()}


def positions(material: Material) -> dict[str, Any]:
    """Return how the adjusted positions of cameras fit the measured ones."""
    adjusted, reference = material.adjusted, material.reference
    if adjusted is None:
        return {"none": NOT_ADJUSTED}
    residual = adjusted.gnss_residual_m
    used = np.isfinite(residual).any(axis=1)
    if reference is None or not used.any():
        return {"none": "No position of a photo was used."}
    stated = np.where(np.isfinite(residual[used]), reference.std_m[adjusted.block.image_index[used]], np.nan)
    median = [float(np.median(c[np.isfinite(c)])) if np.isfinite(c).any() else np.nan for c in stated.T]
    common, common_std = _common(material)
    return {
        "num": int(used.sum()),
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
            "offset_m": found.offset_m[k].tolist(),
            "std_m": found.std_m[k].tolist(),
        }
        for k in range(len(found.number))
    ]


def _common(material: Material) -> tuple[list[float] | None, list[float] | None]:
    """Return what all positions are off in common, measured minus adjusted, and its sigma, where control tells it."""
    fit = material.adjusted.control
    if not np.isfinite(fit.gnss_minus_control_m).any():
        return None, None
    return fit.gnss_minus_control_m.tolist(), fit.gnss_minus_control_std_m.tolist()


def _by_axis(values: np.ndarray, figure: Any) -> list[float]:
    return [float(figure(c[np.isfinite(c)])) if np.isfinite(c).any() else np.nan for c in values.T]


def attitudes(material: Material) -> dict[str, Any]:
    """Return by what small turns the adjusted attitudes differ from those measured, about east, north and up."""
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
    turn_deg = np.degrees((one * other.inv()).as_rotvec())
    return {
        "num": int(known.sum()),
        "names": ["about east", "about north", "about up"],
        "mean_deg": turn_deg.mean(axis=0).tolist(),
        "rms_deg": np.sqrt(np.mean(turn_deg**2, axis=0)).tolist(),
    }


def control(material: Material) -> dict[str, Any]:
    """Return control and check points with what they say of the block, and what would be seen of an error in each."""
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
    for k, point in enumerate(points):
        point |= {
            "surveyed": surveyed[k].tolist(),
            "adjusted": adjusted[k].tolist(),
            "survey_std_m": given.std_m[k].tolist(),
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


def statistics(material: Material) -> dict[str, Any]:
    """Return how each kind of measurement scatters beside what it was taken for."""
    if material.adjusted is None:
        return {"none": NOT_ADJUSTED}
    facts = statistics_facts(material.adjusted.statistics)
    if facts is None:
        return {"none": "Statistics were not computed, as there are no sigmas."}
    factor = float(material.adjusted.variance_factor)
    return {"redundancy": facts["redundancy"], "variance_factor": factor, "kinds": facts["kinds"]}


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
