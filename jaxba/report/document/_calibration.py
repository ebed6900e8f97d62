"""Sections on what the adjustment says of the cameras and of the measurements: intrinsics, correlations, statistics."""

from typing import Any

import numpy as np

from jaxba.report._statistics import statistics_facts
from jaxba.report.document._material import NOT_ADJUSTED, Material
from jaxba.scene import Block

_LENGTHS = "f", "fx", "fy", "cx", "cy"
_FOCAL_FROM = {
    "given": "metadata.focal",
    "calibrated": "a calibration in the tags",
    "focal_plane": "the tags on the focal plane",
    "sensor_table": "the tags and the size of the sensor",
    "equivalent_35mm": "the tags on 35 mm film",
}
_ASSUMED = "assumed beforehand"


def cameras(material: Material) -> list[dict[str, Any]]:
    """Return each camera with its intrinsics: by the tags, adjusted, the change, and their sigmas."""
    from jaxba.geometry import CAMERAS
    from jaxba.sfm import natural_intrinsics

    adjusted = material.adjusted
    if adjusted is None:
        return []
    block: Block = adjusted.block
    names = CAMERAS[block.camera_model].parameter_names()
    begun: Block = material.done.start.block
    start: dict[str, np.ndarray] = {}
    if begun.camera_model == block.camera_model:
        start = dict(zip(begun.camera_names, natural_intrinsics(begun, material.photos).center, strict=True))
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
                "focal_from": None if photo is None or photo.focal_source is None else _FOCAL_FROM[photo.focal_source],
                "parameters": [
                    _intrinsic(
                        name,
                        np.nan if before is None else float(before[k]),
                        float(block.camera_parameters[number, k]),
                        float(adjusted.intrinsics_std[number, k]),
                    )
                    for k, name in enumerate(names)
                ],
            }
        )
    return found


def _intrinsic(name: str, start: float, value: float, std: float) -> dict[str, Any]:
    return {
        "name": name,
        "unit": "px" if name in _LENGTHS else "",
        "start": start,
        "value": value,
        "change": value - start,
        "std": std,
        "change_over_sigma": (value - start) / std if std > 0 else np.nan,
        "fixed": std == 0,
    }


def correlation(material: Material) -> dict[str, Any]:
    """Return the correlations among what images share."""
    if material.adjusted is None:
        return {"none": NOT_ADJUSTED}
    found = material.adjusted.statistics
    if found is None or not len(found.unknowns):
        return {"none": "Sigmas of what images share were not computed."}
    return {"names": list(found.unknowns), "matrix": found.correlation.tolist()}


def statistics(material: Material) -> dict[str, Any]:
    """Return how each kind of measurement scatters beside what it was taken for."""
    if material.adjusted is None:
        return {"none": NOT_ADJUSTED}
    facts = statistics_facts(material.adjusted.statistics)
    if facts is None:
        return {"none": "Statistics were not computed, as there are no sigmas."}
    factor, found = float(material.adjusted.variance_factor), material.adjusted.statistics
    kinds = list(facts["kinds"])
    if found.assumed_count:
        assumed = {"name": _ASSUMED, "count": found.assumed_count, "redundancy": found.assumed_redundancy}
        kinds.append(dict.fromkeys(kinds[0] if kinds else (), None) | {"unit": ""} | assumed)
    return {"redundancy": facts["redundancy"], "variance_factor": factor, "kinds": kinds}
