"""The section on residuals: their histogram, and what they have in common over the sensor of each camera."""

from typing import Any

import numpy as np
from jaxtyping import Float, Int

from jaxba.report.document._material import NOT_ADJUSTED, Errors, Material

_BINS, _RINGS = 60, 20
_CELLS = 16  # of the sensor, along its longer side
_LEAST = 10  # residuals of a cell, to tell their mean
_WIDEST = 1.5  # times the limit that the histogram reaches; the last bin holds what lies beyond


def residuals(material: Material) -> dict[str, Any]:
    """Return the histogram of residual lengths, and the systematic part of residuals over each sensor."""
    errors, adjusted = material.errors, material.adjusted
    if errors is None:
        return {"none": NOT_ADJUSTED}
    length = errors.length_px
    known = np.isfinite(length)
    used = length[known & errors.is_used]
    median = float(np.median(used))
    mad = float(np.median(np.abs(used - median)))
    limit = float(adjusted.limit_px)
    edges = np.linspace(0.0, _WIDEST * (limit if np.isfinite(limit) else float(length[known].max())), _BINS + 1)
    inside = np.minimum(length, edges[-1] * (1 - 1e-12))
    counts, rejected = (np.histogram(inside[known & of], edges)[0].tolist() for of in (errors.is_used, ~errors.is_used))
    block = adjusted.block
    camera = block.camera_index[errors.image]
    photos = [material.photos[i] for i in block.image_index]
    sensors = []
    for number in range(len(block.camera_names)):
        mine = (camera == number) & known & errors.is_used
        if mine.any():
            photo = photos[int(np.flatnonzero(block.camera_index == number)[0])]
            sensors.append({"camera": number} | _sensor(errors, mine, photo.width_px, photo.height_px))
    return {
        "histogram": {
            "edges_px": edges.tolist(),
            "counts": counts,
            "rejected": rejected,
            "threshold_px": limit,
            "median_px": median,
            "mad_px": mad,
        },
        "sensors": sensors,
    }


def _sensor(errors: Errors, mine: np.ndarray, width_px: int, height_px: int) -> dict[str, Any]:
    """Return mean residuals by cell of the sensor, and along the radius from its middle."""
    xy, off = errors.xy_px[mine], errors.off_px[mine]
    cell = max(width_px, height_px) / _CELLS
    nx, ny = max(round(width_px / cell), 1), max(round(height_px / cell), 1)
    column = np.clip((xy[:, 0] / width_px * nx).astype(int), 0, nx - 1)
    row = np.clip((xy[:, 1] / height_px * ny).astype(int), 0, ny - 1)
    count = np.bincount(row * nx + column, minlength=nx * ny)
    dx, dy = (_means(row * nx + column, part, count).reshape(ny, nx).tolist() for part in off.T)
    from_middle = xy - [width_px / 2, height_px / 2]
    radius = np.hypot(*from_middle.T)
    outward = np.sum(off * from_middle, axis=1) / np.maximum(radius, 1e-9)
    ring = np.minimum((radius / np.hypot(width_px, height_px) * 2 * _RINGS).astype(int), _RINGS - 1)
    of_ring = np.bincount(ring, minlength=_RINGS)
    square = _means(ring, np.sum(off**2, axis=1), of_ring)
    return {
        "width_px": width_px,
        "height_px": height_px,
        "dx_px": dx,
        "dy_px": dy,
        "count": count.reshape(ny, nx).tolist(),
        "radial": {
            "radius_px": ((np.arange(_RINGS) + 0.5) * np.hypot(width_px, height_px) / 2 / _RINGS).tolist(),
            "mean_px": _means(ring, outward, of_ring).tolist(),
            "rms_px": np.sqrt(square).tolist(),
            "count": of_ring.tolist(),
        },
    }


def _means(
    group: Int[np.ndarray, " rows"], values: Float[np.ndarray, " rows"], count: Int[np.ndarray, " groups"]
) -> Float[np.ndarray, " groups"]:
    """Return the mean of each group; NaN of those with too few values to tell one."""
    total = np.bincount(group, values, minlength=len(count))
    return np.where(count >= _LEAST, total / np.maximum(count, 1), np.nan)
