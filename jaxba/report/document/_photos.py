"""Sections on photos: a row a photo, the pairs between them, what the ground is seen by, and the cloud."""

from typing import Any

import numpy as np

from jaxba.report.document._material import NOT_ADJUSTED, Material, projected
from jaxba.scene import Block, EdgeStatus

_SHOWN_POINTS = 50_000
_CELLS = 90  # of the overlap map, along its longer side
_OVERLAPPING = 2  # photos that see a piece of ground, for it to be measured
_LEAST_DOWN = 0.17  # sine of the angle at which a photo's corner looks down
_FROM_ABOVE = 0.002  # share of the points on each side that may lie outside the overlap map


def photo_rows(material: Material) -> list[dict[str, Any]]:
    """Return a row for each photo, also of those that take no part, in the order of their names."""
    done, block = material.done, material.block
    reasons = {left.name: left.reason for lefts in material.found.failed.values() for left in lefts}
    reasons |= {left.name: left.reason for left in (() if block is None else block.unregistered)}
    adjusted = _adjusted_rows(material)
    keypoints = {} if done.features is None else {i: len(f.xy_px) for i, f in done.features.items()}
    partners = np.zeros(len(material.photos), int)
    if done.match is not None:
        edges = done.match.view_graph
        partners = np.bincount(edges.pairs[edges.is_edge].reshape(-1), minlength=len(material.photos))
    measured, let_go = _measured(material), material.let_go
    rows = []
    for k, photo in enumerate(material.photos):
        row: dict[str, Any] = {
            "name": photo.name,
            "time": photo.time,
            "state": "adjusted" if k in adjusted else "not adjusted",
            "reason": None if k in adjusted else reasons.get(photo.name, "it is not in the adjusted block"),
            "measured": measured[k],
            "position": "none" if measured[k] is None else "left out",
            "keypoints": keypoints.get(k),
            "partners": int(partners[k]),
        }
        if measured[k] is not None and material.reference is not None and material.reference.is_used[k]:
            row["position"] = "let go" if photo.name in let_go else "used"
        rows.append(row | adjusted.get(k, _NOTHING))
    if done.metadata is not None:
        empty = {"time": None, "measured": None, "position": "none", "keypoints": None, "partners": 0} | _NOTHING
        left = [{"name": of.name, "state": "left out", "reason": of.reason} | empty for of in done.metadata.left_out]
        rows += left
    return rows


_NOTHING: dict[str, Any] = {
    "camera": None, "x": None, "y": None, "z": None, "std_m": None, "ellipse_m": None, "residual_m": None,
    "omega_phi_kappa_deg": None, "outline": None, "observations": 0, "median_px": None, "rms_px": None, "max_px": None,
}  # fmt: skip


def _measured(material: Material) -> list[list[float] | None]:
    """Return each photo's measured position in the CRS."""
    if material.reference is None or material.frame is None:
        return [None] * len(material.photos)
    xyz = material.in_crs(material.reference.xyz_m)
    return [place.tolist() if np.isfinite(place).all() else None for place in xyz]


def _adjusted_rows(material: Material) -> dict[int, dict[str, Any]]:
    """Return what the adjustment tells of each photo, by its index."""
    adjusted = material.adjusted
    if adjusted is None:
        return {}
    block: Block = adjusted.block
    xyz = material.mapped(block.centers_m)
    angles, residual_m = _angles(material), _residuals(material)
    std_m, outlines = adjusted.position_std_m, _outlines(material)
    rows = {}
    order = np.argsort(block.observation_image, kind="stable")
    ends = np.cumsum(np.bincount(block.observation_image, minlength=block.num_images))
    for row, errors in enumerate(np.split(adjusted.error_px[order], ends[:-1])):
        known = errors[np.isfinite(errors)]
        rows[int(block.image_index[row])] = {
            "camera": int(block.camera_index[row]),
            **dict(zip("xyz", xyz[row].tolist(), strict=True)),
            "std_m": std_m[row].tolist(),
            "ellipse_m": _ellipse(material, row),
            "residual_m": residual_m[row].tolist(),
            "omega_phi_kappa_deg": None if angles is None else angles[row].tolist(),
            "outline": outlines[row],
            "observations": len(errors),
            "median_px": float(np.median(known)) if len(known) else None,
            "rms_px": float(np.sqrt(np.mean(known**2))) if len(known) else None,
            "max_px": float(known.max()) if len(known) else None,
        }
    return rows


def _residuals(material: Material) -> np.ndarray:
    """Return adjusted minus measured positions, also of those that took no part, less what their flight is off."""
    from jaxba.sfm import without_offsets

    adjusted, reference = material.adjusted, material.reference
    residual_m = adjusted.gnss_residual_m
    if reference is None or not adjusted.block.is_georeferenced:
        return residual_m
    index = adjusted.block.image_index
    measured_m = without_offsets(reference, adjusted.flights).xyz_m[index]
    left_out = ~reference.is_used[index, None] & np.isfinite(reference.std_m[index])
    return np.where(left_out, adjusted.block.centers_m - measured_m, residual_m)


def _angles(material: Material) -> np.ndarray | None:
    """Return omega, phi and kappa of each adjusted camera in the grid of the CRS, degrees; None without a CRS."""
    from scipy.spatial.transform import Rotation

    from jaxba import geo
    from jaxba.io import omega_phi_kappa_deg

    if material.frame is None:
        return None
    block: Block = material.adjusted.block
    rotation = Rotation.from_quat(block.quaternion, scalar_first=True).as_matrix()
    return omega_phi_kappa_deg(geo.grid_from_local(material.frame, block.centers_m) @ np.swapaxes(rotation, 1, 2))


def _outlines(material: Material) -> list[list[list[float]] | None]:
    """Return what each photo shows of a level ground at the median height of its points: four corners, x and y.

    Lens distortion is taken as none. None where a corner looks less than some ten degrees down, or nothing tells which
    way is down.
    """
    from scipy.spatial.transform import Rotation

    block: Block = material.adjusted.block
    if not block.is_georeferenced:
        return [None] * block.num_images
    turn = Rotation.from_quat(block.quaternion, scalar_first=True)
    order = np.argsort(block.observation_image, kind="stable")
    heights = np.split(
        block.points_m[block.observation_point[order], 2],
        np.cumsum(np.bincount(block.observation_image, minlength=block.num_images))[:-1],
    )
    found: list[list[list[float]] | None] = []
    for row, (center, ground) in enumerate(zip(block.centers_m, heights, strict=True)):
        fx, fy, cx, cy = _pinhole(block, row)
        width, height = _size(material, row)
        corners = np.array([[0.0, 0.0], [width, 0.0], [width, height], [0.0, height]])
        rays = np.column_stack([(corners - [cx, cy]) / [fx, fy], np.ones(4)])
        rays = turn[row].inv().apply(rays / np.linalg.norm(rays, axis=1, keepdims=True))
        if not len(ground) or rays[:, 2].max() > -_LEAST_DOWN or center[2] <= np.median(ground):
            found.append(None)
            continue
        places = center + rays * ((np.median(ground) - center[2]) / rays[:, 2])[:, None]
        found.append(material.mapped(places)[:, :2].tolist())
    return found


def _pinhole(block: Block, row: int) -> tuple[float, float, float, float]:
    """Return focal lengths and principal point of an image's camera, pixels."""
    from jaxba.geometry import CAMERAS

    names = CAMERAS[block.camera_model].parameter_names()
    values = dict(zip(names, block.camera_parameters[block.camera_index[row]].tolist(), strict=True))
    fx, fy = (values[name] if name in values else values["f"] for name in ("fx", "fy"))
    return fx, fy, values["cx"], values["cy"]


def _ellipse(material: Material, row: int) -> list[float] | None:
    """Return semi-axes and azimuth (clockwise from north) of the ellipse of one sigma; None where it is not known."""
    covariance = material.adjusted.position_covariance_m2
    if covariance is None or not np.isfinite(covariance[row, :2, :2]).all():
        return None
    values, vectors = np.linalg.eigh(covariance[row, :2, :2])
    semi_axes = np.sqrt(np.maximum(values, 0.0))
    return [semi_axes[1], semi_axes[0], float(np.degrees(np.arctan2(vectors[0, 1], vectors[1, 1])) % 180.0)]


def pairs(material: Material) -> dict[str, Any]:
    """Return the pairs that were matched, a list a figure; `rejected` ones have no edge, the block refutes `pruned`.

    A block of 500 photos has 10,000 pairs and more: as an object each they would be most of the report.
    """
    done = material.done
    if done.match is None:
        return {"none": "Photos have not been matched."}
    graph = done.match.view_graph
    pruned = set() if material.adjusted is None else {edge.name for edge in material.adjusted.pruned}
    names = [photo.name for photo in material.photos]
    words = {EdgeStatus.REJECTED: "rejected", EdgeStatus.WEAK: "weak", EdgeStatus.GOOD: "good"}
    states = [words[EdgeStatus(status)] for status in graph.status.tolist()]
    for k, (first, second) in enumerate(graph.pairs.tolist()):
        if f"{names[first]}, {names[second]}" in pruned:
            states[k] = "pruned"
    return {
        "first": graph.pairs[:, 0].tolist(),
        "second": graph.pairs[:, 1].tolist(),
        "matches": graph.num_inliers.tolist(),
        "putative": graph.num_putative.tolist(),
        "state": states,
        "median_px": np.round(graph.residual_px, 3).astype(float).tolist(),
        "angle_deg": np.round(np.degrees(graph.angle_rad), 3).astype(float).tolist(),
    }


def cloud(material: Material) -> dict[str, Any]:
    """Return the points of the block, thinned evenly where they are many."""
    adjusted = material.adjusted
    if adjusted is None:
        return {"none": NOT_ADJUSTED}
    block: Block = adjusted.block
    step = max(1, -(-block.num_points // _SHOWN_POINTS))
    shown = np.arange(0, block.num_points, step)
    xyz = material.mapped(block.points_m[shown])
    return {
        "num_points": block.num_points,
        "num_shown": len(shown),
        **{axis: np.round(xyz[:, k], 3).tolist() for k, axis in enumerate("xyz")},
        "rgb": block.rgb[shown].tolist(),
        "error_px": np.round(adjusted.point_error_px[shown], 3).tolist(),
        "std_z_m": np.round(adjusted.point_std_m[shown, 2], 4).tolist(),
    }


def overlap(material: Material) -> dict[str, Any]:
    """Return how many adjusted photos see each cell of the ground: its middle, at the median height of near points."""
    from scipy.ndimage import distance_transform_edt

    if material.adjusted is None:
        return {"none": NOT_ADJUSTED}
    block: Block = material.adjusted.block
    if not block.is_georeferenced:
        return {"none": "The block has no place on earth, so that nothing tells which way is down."}
    low, high = np.percentile(block.points_m[:, :2], [100 * _FROM_ABOVE, 100 - 100 * _FROM_ABOVE], axis=0)
    cell = float(max(np.max(high - low) / _CELLS, 1e-6))
    nx, ny = (int(count) for count in np.maximum(np.ceil((high - low) / cell), 1))
    column, row = np.floor((block.points_m[:, :2] - low) / cell).astype(int).T
    inside = (column >= 0) & (column < nx) & (row >= 0) & (row < ny)
    number = (row * nx + column)[inside]
    order = np.lexsort((block.points_m[inside, 2], number))
    counts = np.bincount(number, minlength=nx * ny)
    heights = np.full(nx * ny, np.nan)
    middle = (np.cumsum(counts) - counts + counts // 2)[counts > 0]
    heights[counts > 0] = block.points_m[inside, 2][order][middle]
    heights = heights.reshape(ny, nx)
    nearest: Any = distance_transform_edt(np.isnan(heights), return_distances=False, return_indices=True)
    heights = heights[tuple(nearest)]
    x, y = np.meshgrid(low[0] + cell * (np.arange(nx) + 0.5), low[1] + cell * (np.arange(ny) + 0.5))
    ground = np.stack([x, y, heights], axis=2).reshape(-1, 3)
    seen = np.zeros(len(ground), int)
    for image in range(block.num_images):
        width, height = _size(material, image)
        xy_px = projected(block, np.full(len(ground), image), ground)
        with np.errstate(invalid="ignore"):
            seen += ((xy_px >= 0) & (xy_px <= [width, height])).all(axis=1)
    corners = material.mapped(np.array([[*low, 0.0], [low[0] + cell, low[1], 0.0]]))
    return {
        "x0": float(corners[0, 0]),
        "y0": float(corners[0, 1]),
        "cell": float(np.hypot(*(corners[1] - corners[0])[:2])),
        "area_m2": float((seen >= _OVERLAPPING).sum() * cell**2),
        "median": float(np.median(seen[seen > 0])) if (seen > 0).any() else np.nan,
        "rows": seen.reshape(ny, nx).tolist(),
    }


def _size(material: Material, image: int) -> tuple[int, int]:
    photo = material.photos[int(material.adjusted.block.image_index[image])]
    return photo.width_px, photo.height_px
