"""What the sigmas of points and cameras hold: whether what the whole block may be off in common is in them.

Positions of photos hold a block to their mean. What all of them are off in common (a single receiver's error, a base
beside its mark, another datum) shows in no residual. It is in the sigmas only where control points make it an unknown
of the adjustment.
"""

from typing import Any

import numpy as np

from jaxba.report._accuracy import accuracy
from jaxba.report.document._material import NOT_ADJUSTED, Material

_PLAIN_M = 1.0  # sigma beyond which a position is that of a single receiver
_WITHIN = "within the block"


def sigmas(material: Material) -> dict[str, Any]:
    """Return what sigmas are of, their medians, and what is known of the absolute accuracy."""
    adjusted = material.adjusted
    if adjusted is None:
        return {"none": NOT_ADJUSTED}
    cameras, points = (_median(std_m) for std_m in (adjusted.position_std_m, adjusted.point_std_m))
    if not np.isfinite([cameras, points]).any():
        return {"none": "There are no sigmas of points and cameras: too little holds the block, as the findings tell."}
    scope, text = _scope(material)
    absolute_m, told = _absolute(material, scope, points)
    return {
        "scope": scope,
        "text": text,
        "camera_m": cameras.tolist(),
        "point_m": points.tolist(),
        "absolute_m": absolute_m,
        "absolute_text": told,
    }


def _median(std_m: np.ndarray) -> np.ndarray:
    known = np.isfinite(std_m)
    return np.array([np.median(c[k]) if k.any() else np.nan for c, k in zip(std_m.T, known.T, strict=True)])


def _scope(material: Material) -> tuple[str, str]:
    adjusted = material.adjusted
    if not adjusted.block.is_georeferenced:
        return "of the shape", "The block has no place on earth: sigmas tell how well its shape is known."
    fit = adjusted.control
    if fit.method == "adjust" and np.isfinite(fit.used_std_m).any():
        return (
            "absolute",
            "Sigmas are absolute, in the frame of the control points: what the whole block may be off in common is in "
            "them.",
        )
    return (
        _WITHIN,
        "Sigmas are those within the block: what all measured positions of photos are off in common is not in them.",
    )


def _absolute(material: Material, scope: str, points: np.ndarray) -> tuple[list[float] | None, str]:
    """Return the absolute accuracy of a point along east, north and up, as far as something tells it, and by what."""
    adjusted, reference = material.adjusted, material.reference
    found = None
    if material.done.control is not None:
        found = accuracy(material.done.control.control, adjusted.control)
    if found is not None:
        return found.product_m.tolist(), "RMSE of the check points, the sigma of their survey included."
    if scope == "absolute":
        return points.tolist(), "By the sigmas of the adjustment; no check point confirms it."
    if scope != _WITHIN or reference is None:
        return None, "The block has no place on earth."
    used = np.isfinite(adjusted.gnss_residual_m).any(axis=1)
    if not used.any():
        return None, "Nothing measured tells it."
    stated = _median(np.where(np.isfinite(reference.std_m), reference.std_m, np.nan)[adjusted.block.image_index[used]])
    if not (stated > _PLAIN_M).any():
        return None, (
            "Not known: a base beside its mark or another datum would move the whole block, and no check point tells. "
            "As far as the positions have no error in common, the sigmas hold."
        )
    return np.hypot(points, stated).tolist(), (
        "About the sigma of one position: a single receiver's positions have most of their error in common, and "
        "nothing here tells it. Only control, check points or a differential receiver do."
    )
