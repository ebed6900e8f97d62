"""Start values from the view graph: the sequence of averaging, positioning, alignment and rough adjustment.

1. Rotations of all images from the edges' relative rotations (`_rotations.py`).
2. Centres and points of a few thousand tracks, from the images alone (`_positions.py`).
3. The similarity onto measured positions and attitudes (`_align.py`), if they determine one.
4. A rough adjustment with the focal length and one radial term free (`_rough_adjustment.py`), twice, with wrong
   observations left out in between.
5. Points of all tracks; images that the rotations left out from these points (`_resection.py`), without those that too
   little holds (`_registered.py`).

The same for every survey: measured positions and attitudes place the block, and hold it in the rough adjustment, but
no start value depends on one of them being right.
"""

import dataclasses
import logging
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial.transform import Rotation

from jaxba._errors import JaxbaError
from jaxba.geometry import Similarity
from jaxba.scene import Block, Photo, Reference, Tracks, ViewGraph
from jaxba.sfm._align import align, attitude_rotation, look_down
from jaxba.sfm._points import with_points
from jaxba.sfm._positions import choose_tracks, global_positions, largest_angles
from jaxba.sfm._rays import make_rays
from jaxba.sfm._registered import CONTRADICTION, contradictions, drop_weak, unregistered
from jaxba.sfm._resection import register_more
from jaxba.sfm._rotations import average_rotations
from jaxba.sfm._rough_adjustment import adjust_roughly
from jaxba.sfm._start_cameras import StartCameras, used_cameras

_log = logging.getLogger(__name__)

_MAX_EDGE_ERROR = np.deg2rad(6.0)  # the wrong one of a plane's two poses is off by 10 degrees and more
_RAY_SCALE = 0.01  # radians: an uncalibrated lens's distortion, seen by rays half way out
_LEAST_SHARE, _USUAL_SHARE = 0.1, 0.5  # of measurements that fit: real blocks have 0.9 and more, chance gives 0.01
UNPLACED = "the world is a frame of its own, its unit the median distance from camera to ground."
_COARSE, _FINE = 0.02, 0.005  # errors, as shares of the longer side, before and after the first rough adjustment


def initialise(
    photos: Sequence[Photo],
    reference: Reference,
    view_graph: ViewGraph,
    tracks: Tracks,
    *,
    camera_model: str,
    min_angle_rad: float,
) -> Block:
    """Return start values of poses, cameras and points of the view graph's largest component.

    - `camera_model`: a name in `jaxba.geometry.CAMERAS`; photos of one `Photo.camera` share its parameters.
    - `min_angle_rad`: the largest angle between two rays of a point is at least this.

    The world is the local frame where positions determine it; else its origin lies amid the cameras, its unit is the
    median distance from camera to point, and the cameras look down on average.

    Raises `JaxbaError` where no two images have a relative pose, or nothing can be triangulated.
    """
    component = np.array(sorted(tracks.components[0] if tracks.components else ()), int)
    if len(component) < 2:
        raise JaxbaError(
            f"no two of the {len(photos)} photos are joined by an edge of the view graph; fly more overlap, or lower "
            "match.min_inliers and features.contrast_threshold."
        )
    notes: list[str] = []
    cameras = StartCameras.of(photos, component, camera_model)
    notes += cameras.notes
    _log.info("rotations of %d images", len(component))
    start = _rotations(photos, view_graph, component, notes)
    block = cameras.block(start.image_index, start.quaternion)
    _log.info("positions of %d images", block.num_images)
    chosen, block = _positions(block, tracks, photos, min_angle_rad)
    block = _in_local_frame(block, reference, notes)
    focal_std = cameras.focal_std
    longer = float(max(max(p.width_px, p.height_px) for p in photos))
    for share in (_COARSE, _FINE):
        _log.info("rough adjustment of %d images", block.num_images)
        block = with_points(block, chosen, min_angle_rad=min_angle_rad, max_error_px=share * longer)
        block = drop_weak(block, chosen, reference, start.reasons, min_angle_rad, share * longer, np.inf)
        block = _adjust(block, reference, focal_std)
    _log.info("points of all tracks")
    block = with_points(block, tracks, min_angle_rad=min_angle_rad, max_error_px=_FINE * longer)
    reasons = dict(start.reasons)
    block = register_more(block, tracks, cameras, component, reasons, min_angle_rad, _FINE * longer)
    block = drop_weak(block, tracks, reference, reasons, min_angle_rad, _FINE * longer, CONTRADICTION)
    notes += _share_that_fits(block, tracks, component)
    notes += contradictions(block, reference, photos)
    left = unregistered(photos, tracks, block, reasons)
    return dataclasses.replace(used_cameras(block), notes=tuple(notes), unregistered=left)


@dataclasses.dataclass(frozen=True, eq=False)
class _Start:
    """Images with a rotation, and the reasons of the component's others, by image."""

    image_index: Int[np.ndarray, " images"]
    quaternion: Float[np.ndarray, "images 4"]
    reasons: dict[int, str]


def _rotations(
    photos: Sequence[Photo], view_graph: ViewGraph, component: Int[np.ndarray, " n"], notes: list[str]
) -> _Start:
    inside = np.zeros(len(photos), bool)
    inside[component] = True
    edge = np.logical_and(view_graph.is_edge, inside[view_graph.pairs].all(axis=1))
    posed = np.logical_and(edge, np.isfinite(view_graph.quaternion).all(axis=1))
    if not posed.any():
        raise JaxbaError(
            f"none of the {np.count_nonzero(edge)} edges among {len(component)} photos has a relative pose, so there "
            "are no start values. The focal length is the usual cause: check it, or set metadata.focal."
        )
    quaternion, used, error = average_rotations(
        len(photos),
        view_graph.pairs[posed].astype(np.int64),
        view_graph.quaternion[posed],
        np.minimum(view_graph.num_inliers[posed], 300).astype(float),
        max_error_rad=_MAX_EDGE_ERROR,
    )
    known = np.isfinite(quaternion).all(axis=1)
    wrong = np.count_nonzero(~used)
    notes.append(
        f"Rotations of {np.count_nonzero(known)} of {len(component)} images from {np.count_nonzero(used)} of "
        f"{len(used)} relative poses, median error {np.rad2deg(np.median(error[used])):.2f} degrees"
        + (f"; {wrong} off by more than {np.rad2deg(_MAX_EDGE_ERROR):g} degrees are not used." if wrong else ".")
    )
    reasons: dict[int, str] = {}
    num_posed, num_edges = (np.bincount(view_graph.pairs[k].ravel(), minlength=len(photos)) for k in (posed, edge))
    for image in np.setdiff1d(component, np.flatnonzero(known)).tolist():
        reasons[image] = (
            f"none of its {num_posed[image]} relative poses agrees with the others"
            if num_posed[image]
            else f"none of its {num_edges[image]} edges has a relative pose"
        )
    return _Start(np.flatnonzero(known), quaternion[known], reasons)


def _positions(block: Block, tracks: Tracks, photos: Sequence[Photo], min_angle_rad: float) -> tuple[Tracks, Block]:
    """Return the chosen tracks, and the block with centres from them (the unit is the mean distance to a point)."""
    row_of_image = np.full(len(photos), -1)
    row_of_image[block.image_index] = np.arange(block.num_images)
    row = row_of_image[tracks.image_index]
    seen = np.flatnonzero(row >= 0)
    ray = make_rays(block, row[seen], tracks.xy_px[seen]).direction.T
    fine = np.isfinite(ray).all(axis=1)
    seen, ray = seen[fine], ray[fine]
    track, image = tracks.track_index[seen], row[seen]
    angle = largest_angles(ray, track, tracks.num_tracks)
    size = np.array([[photos[i].width_px, photos[i].height_px] for i in block.image_index], float)
    keep = choose_tracks(track, image, tracks.xy_px[seen] / size[image], angle, min_angle_rad=min_angle_rad)
    seen, ray, image = seen[keep], ray[keep], image[keep]
    if len(seen) == 0:
        raise JaxbaError(
            f"no track of the {tracks.num_tracks} has two rays that differ by {np.rad2deg(min_angle_rad):g} degrees or "
            "more: the photos were taken from nearly one place. Fly a longer base, or lower start.min_angle."
        )
    _, point = np.unique(tracks.track_index[seen], return_inverse=True)
    centers, _, _ = global_positions(block.num_images, ray, image, point, scale_rad=_RAY_SCALE)
    chosen = dataclasses.replace(
        tracks,
        track_index=tracks.track_index[seen],
        image_index=tracks.image_index[seen],
        feature_index=tracks.feature_index[seen],
        xy_px=tracks.xy_px[seen],
    )
    return chosen, _posed(block, _matrices(block.quaternion), centers)


def _in_local_frame(block: Block, reference: Reference, notes: list[str]) -> Block:
    """Return the block in the local frame, if positions determine it; else with the cameras looking down."""
    index, rotations = block.image_index, _matrices(block.quaternion)
    similarity = None
    if reference.frame is not None:
        similarity = align(
            block.centers_m,
            rotations,
            reference.xyz_m[index],
            reference.std_m[index],
            reference.is_used[index],
            reference.quaternion[index],
            reference.attitude_std_rad[index],
        )
    placed = similarity is not None
    if similarity is None:
        turn = attitude_rotation(rotations, reference.quaternion[index])
        turn = look_down(rotations) if turn is None else turn
        similarity = Similarity(scale=1.0, rotation=turn, shift=np.zeros(3))
        num = np.count_nonzero(reference.is_used[index])
        notes.append(
            f"{num} of {block.num_images} images have a trusted position, too few or too near each other to place the "
            f"block on earth: {UNPLACED}"
        )
    block = _posed(block, similarity.rotations(rotations), similarity.points(block.centers_m))
    return dataclasses.replace(block, is_georeferenced=placed)


def _adjust(block: Block, reference: Reference, focal_std: Float[np.ndarray, " cameras"]) -> Block:
    index = block.image_index
    use = reference.is_used[index] & block.is_georeferenced
    xyz = np.where(use[:, None], reference.xyz_m[index], np.nan)
    return adjust_roughly(block, xyz_m=xyz, std_m=reference.std_m[index], focal_std=focal_std)


def _share_that_fits(block: Block, tracks: Tracks, component: Int[np.ndarray, " n"]) -> list[str]:
    """Refuse a block that hardly any measurement fits, and note one that many do not fit."""
    total = np.count_nonzero(np.isin(tracks.image_index, component))
    share = block.num_observations / max(total, 1)
    text = (
        f"{block.num_observations} of {total} measurements ({share:.0%}) fit the start values of {block.num_images} "
        f"images. Usual causes are a wrong focal length (camera {block.camera_names[0]}: "
        f"{block.camera_parameters[0, 0]:.0f} px), mixed cameras and wrong matches"
    )
    if share < _LEAST_SHARE:
        raise JaxbaError(f"start values failed: {text}; check the photos, or set metadata.focal.")
    return [f"Only {text}."] if share < _USUAL_SHARE else []


def _matrices(quaternion: Float[np.ndarray, "images 4"]) -> Float[np.ndarray, "images 3 3"]:
    return Rotation.from_quat(quaternion, scalar_first=True).as_matrix()


def _posed(block: Block, rotations: Float[np.ndarray, "images 3 3"], centers: Float[np.ndarray, "images 3"]) -> Block:
    quaternion = Rotation.from_matrix(rotations).as_quat(canonical=True, scalar_first=True)
    return dataclasses.replace(block, quaternion=quaternion, translation_m=-np.einsum("nij,nj->ni", rotations, centers))
