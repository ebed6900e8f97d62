"""Footprints: what a photo sees of a level ground below it, and how far two footprints overlap.

With a known attitude the footprint is the frame's outline followed down its rays; rays that reach the ground farther
off than `_MAX_TILT_RAD` from the vertical, or never, end there. Without one it is the circle around the nadir through
the frame's corners, which holds every yaw. 1000 photos with 80% forward and 60% side overlap take 0.5 s.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

_MAX_TILT_RAD = np.deg2rad(70.0)  # beyond, the ground is seen under 20 degrees: too flat to match with other views
_SIDE_POINTS = 4  # of the frame's outline, so that a side cut off by the tilt keeps its shape
_CIRCLE_POINTS = 24


@dataclass(frozen=True, kw_only=True, eq=False)
class Footprints:
    """One polygon a photo, on the ground, (east, north) in metres, as its corners in no certain order.

    - `outline_m`: points whose convex hull is the footprint; NaN where it is unknown.
    - `margin_m`: how far it may be off.
    """

    outline_m: Float[np.ndarray, "photos corners 2"]
    margin_m: Float[np.ndarray, " photos"]

    @property
    def is_known(self) -> Bool[np.ndarray, " photos"]:
        return np.asarray(np.isfinite(self.outline_m).all(axis=(1, 2)))


def ground_footprints(
    size_px: Float[np.ndarray, "photos 2"],
    focal_px: Float[np.ndarray, " photos"],
    xyz_m: Float[np.ndarray, "photos 3"],
    quaternion: Float[np.ndarray, "photos 4"],
    height_m: Float[np.ndarray, " photos"],
    margin_m: Float[np.ndarray, " photos"],
) -> Footprints:
    """Return the footprints of photos at `xyz_m` (east, north, up), `height_m` above a level ground.

    - `size_px`: width and height. `focal_px`: the principal point is taken in the middle, lens distortion as none.
    - `quaternion`: `cam_from_world`, scalar first, NaN where unknown.
    - `margin_m`: how far the footprint may be off, horizontally.

    A value that is not finite, other than an attitude's, makes the footprint unknown, and so does a view over the
    horizon.

    >>> level = np.array([[0.0, 1, 0, 0]])  # looks straight down, north at the top
    >>> one, zero = np.ones(1), np.zeros(1)
    >>> footprints = ground_footprints(np.array([[400.0, 300]]), 100 * one, np.zeros((1, 3)), level, 10 * one, zero)
    >>> footprints.outline_m[0].max(axis=0).tolist()
    [20.0, 15.0]
    """
    from scipy.spatial.transform import Rotation

    half = size_px / 2 / focal_px[:, None]
    has_attitude = np.asarray(np.isfinite(quaternion).all(axis=1))
    outline = np.full((len(size_px), 4 * _SIDE_POINTS, 2), np.nan)
    turned = np.flatnonzero(has_attitude)
    if len(turned):
        border = half[turned, None] * _unit_border()
        rays = np.concatenate([border, np.ones_like(border[..., :1])], axis=-1)
        world_from_cam = Rotation.from_quat(quaternion[turned], scalar_first=True).inv().as_matrix()
        outline[turned] = _down(np.einsum("nij,nkj->nki", world_from_cam, rays))
    circle = 2 * np.pi * np.arange(_CIRCLE_POINTS) / _CIRCLE_POINTS
    reach = np.hypot(half[:, 0], half[:, 1])[:, None, None]
    round_ = reach * np.stack([np.cos(circle), np.sin(circle)], axis=-1)
    corners = max(outline.shape[1], _CIRCLE_POINTS)
    outline = np.concatenate([outline, np.repeat(outline[:, -1:], corners - outline.shape[1], axis=1)], axis=1)
    outline = np.where(has_attitude[:, None, None], outline, round_)
    outline = xyz_m[:, None, :2] + height_m[:, None, None] * outline
    outline[~(np.isfinite(outline).all(axis=(1, 2)) & (height_m > 0) & np.isfinite(margin_m))] = np.nan
    return Footprints(outline_m=outline, margin_m=margin_m)


def footprint_pairs(
    footprints: Footprints, min_overlap: float
) -> tuple[Int[np.ndarray, "pairs 2"], Float[np.ndarray, " pairs"]]:
    """Return the pairs, rising, whose footprints may overlap by `min_overlap` of the smaller one, and by how much.

    Each pair is judged with one footprint moved towards the other by what both may be off, the square root of the sum
    of the squared margins.
    """
    import shapely

    known = np.flatnonzero(footprints.is_known)
    outline, margin = footprints.outline_m[known], footprints.margin_m[known]
    low, high = outline.min(axis=1) - margin[:, None], outline.max(axis=1) + margin[:, None]
    boxes = shapely.box(*low.T, *high.T)
    pairs = np.asarray(shapely.STRtree(boxes).query(boxes)).T
    pairs = known[pairs[pairs[:, 0] < pairs[:, 1]]]
    pairs = pairs[np.lexsort((pairs[:, 1], pairs[:, 0]))]
    overlap = _overlaps(footprints, pairs, is_widest=True)
    return pairs[overlap >= min_overlap], overlap[overlap >= min_overlap]


def footprint_overlaps(footprints: Footprints, pairs: Int[np.ndarray, "pairs 2"]) -> Float[np.ndarray, " pairs"]:
    """Return the overlap of each pair as a share of the smaller footprint; NaN where one of them is unknown."""
    return _overlaps(footprints, pairs, is_widest=False)


def _overlaps(
    footprints: Footprints, pairs: Int[np.ndarray, "pairs 2"], *, is_widest: bool
) -> Float[np.ndarray, " pairs"]:
    import shapely

    result = np.full(len(pairs), np.nan)
    rows = np.flatnonzero(footprints.is_known[pairs].all(axis=1))
    used, ends = np.unique(pairs[rows], return_inverse=True)
    outline = footprints.outline_m[used]
    polygons = np.asarray(shapely.convex_hull(shapely.multipoints(outline)))
    i, j = ends.reshape(-1, 2).T
    area = np.asarray(shapely.area(polygons))
    second = polygons[j]
    margin = footprints.margin_m[used]
    moving = np.flatnonzero(np.hypot(margin[i], margin[j]) > 0) if is_widest else np.zeros(0, int)
    if len(moving):
        a, b = i[moving], j[moving]
        center = (outline.min(axis=1) + outline.max(axis=1)) / 2
        step = center[a] - center[b]
        distance = np.maximum(np.linalg.norm(step, axis=1), 1e-9)
        share = np.minimum(1.0, np.hypot(margin[a], margin[b]) / distance)
        second[moving] = shapely.convex_hull(shapely.multipoints(outline[b] + (share[:, None] * step)[:, None]))
    result[rows] = shapely.area(shapely.intersection(polygons[i], second)) / np.minimum(area[i], area[j])
    return result


def _unit_border() -> Float[np.ndarray, "border 2"]:
    """Return points on the border of the square of side 2, in order, corners among them."""
    along = np.linspace(-1.0, 1.0, _SIDE_POINTS, endpoint=False)
    one = np.ones_like(along)
    sides = [(along, -one), (one, along), (-along, one), (-one, -along)]
    return np.concatenate([np.stack(side, axis=-1) for side in sides])


def _down(rays: Float[np.ndarray, "photos border 3"]) -> Float[np.ndarray, "photos border 2"]:
    """Return where rays (east, north, up) from a unit height meet the ground, or the farthest place that counts.

    NaN for a photo of which no ray meets the ground before.
    """
    farthest = np.linalg.norm(rays[..., :2], axis=-1) / np.tan(_MAX_TILT_RAD)
    depth = np.maximum(-rays[..., 2], farthest)
    depth[np.all(-rays[..., 2] <= farthest, axis=1)] = np.nan
    return rays[..., :2] / depth[..., None]
