"""Tracks completed: with poses known, a point is looked for in every image that it falls into.

Matching finds a point in two images, by one descriptor against thousands. Where the poses foretell its pixel within a
few px, only the few features there compete, and a match that failed the ratio test or the mutual check is found after
all. A feature that belongs to another track joins the two tracks, if no image sees both. Tracks of keypoints without a
descriptor among the features, which an image may have behind them, stay as they are.

A found feature's descriptor must be as near to one of the track's as the features of matched pairs are to each other:
the limit is the 90% quantile of their distances. Whether the found observations fit is for the adjustment to judge,
like that of all others.

Cost: a turn for each point and image, 10 ns, and a projection and a search in a k-d tree for each point that an image
looks towards; the features of as many images as there are cores are open at a time.
"""

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8
from scipy.cluster.hierarchy import DisjointSet
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from jaxba.ba import project_in_cameras
from jaxba.geometry import CAMERAS
from jaxba.scene import Block, Features, Photo, Tracks
from jaxba.sfm._cores import on_all_cores
from jaxba.sfm._rays import make_rays

_NEAREST = 4  # features that compete for a point
_QUANTILE = 0.9
_BORDER, _MARGIN = 17, 1.05  # pixels on each side of an image; of the angle to them
_LEAST_PAIRS = 50  # of matched features, to know how near they are


@dataclass(frozen=True)
class _Links:
    """Features found for points: a track, the image and feature, the track that owns the feature (-1: none)."""

    track: Int[np.ndarray, " links"]
    image: Int[np.ndarray, " links"]
    feature: Int[np.ndarray, " links"]
    owner: Int[np.ndarray, " links"]
    distance: Float[np.ndarray, " links"]
    xy_px: Float[np.ndarray, "links 2"]


def complete_tracks(
    block: Block, tracks: Tracks, features: Mapping[int, Features], photos: tuple[Photo, ...], *, radius_px: float
) -> Tracks:
    """Return the tracks with the features that lie within a radius of where the block's points fall.

    `features`: by image index, opened one after the other. Tracks without a point in the block stay as they are.
    """
    known = _Known.of(block, tracks, features)
    if known is None:
        return tracks
    cos_view = _cos_of_view(block, photos)

    def links_in(row: int) -> _Links:
        return _links_in(
            row, block, tracks, features, photos, known, radius_px, float(cos_view[block.camera_index[row]])
        )

    links = on_all_cores(links_in, range(block.num_images))
    columns = [np.concatenate([getattr(part, name) for part in links]) for name in _Links.__dataclass_fields__]
    return _joined(tracks, _Links(*columns))


@dataclass(frozen=True)
class _Known:
    """The descriptors of each point's first and last observation, and how near those of one point are.

    `is_described`: both are there.
    """

    descriptors: UInt8[np.ndarray, "points 2 length"]
    is_described: Bool[np.ndarray, " points"]
    is_binary: bool
    limit: float

    @staticmethod
    def of(block: Block, tracks: Tracks, features: Mapping[int, Features]) -> "_Known | None":
        point_of_track = np.full(tracks.num_tracks, -1)
        point_of_track[block.track_index] = np.arange(block.num_points)
        starts = np.searchsorted(tracks.track_index, block.track_index)
        ends = np.searchsorted(tracks.track_index, block.track_index, side="right") - 1
        descriptors, is_binary = None, False
        is_described = np.ones(block.num_points, bool)
        for image in np.unique(tracks.image_index[np.concatenate([starts, ends])]):
            found = features[int(image)]
            if descriptors is None:
                descriptors = np.zeros((block.num_points, 2, found.descriptors.shape[1]), np.uint8)
                is_binary = found.detector != "sift"
            for slot, rows in enumerate((starts, ends)):
                here = np.flatnonzero(tracks.image_index[rows] == image)
                has_one = tracks.feature_index[rows[here]] < found.num_keypoints
                is_described[here[~has_one]] = False
                here = here[has_one]
                descriptors[here, slot] = found.descriptors[tracks.feature_index[rows[here]]]
        if descriptors is None or is_described.sum() < _LEAST_PAIRS:
            return None
        between = _distances(descriptors[is_described, 0], descriptors[is_described, 1], is_binary)
        return _Known(descriptors, is_described, is_binary, float(np.quantile(between, _QUANTILE)))


def _links_in(
    row: int,
    block: Block,
    tracks: Tracks,
    features: Mapping[int, Features],
    photos: tuple[Photo, ...],
    known: _Known,
    radius_px: float,
    cos_view: float,
) -> _Links:
    """Return the features of one image that points which it does not see yet have found."""
    image = int(block.image_index[row])
    found = features[image]
    in_image = np.flatnonzero(tracks.image_index == image)
    owner = np.full(found.num_keypoints, -1)
    described = in_image[tracks.feature_index[in_image] < found.num_keypoints]
    owner[tracks.feature_index[described]] = tracks.track_index[described]
    # a keypoint of several orientations stands there several times: all of them belong to the track of one
    place = np.unique(found.xy_px, axis=0, return_inverse=True)[1].reshape(-1)
    of_place = np.full(place.max(initial=-1) + 1, -1)
    np.maximum.at(of_place, place, owner)
    owner = of_place[place]

    sees = np.zeros(tracks.num_tracks, bool)
    sees[tracks.track_index[in_image]] = True
    points = np.flatnonzero(~sees[block.track_index] & known.is_described)
    points, pixel = _pixels(block, row, points, cos_view)
    size = np.array([photos[image].width_px, photos[image].height_px])
    inside = np.isfinite(pixel).all(axis=1) & ((pixel >= 0) & (pixel <= size)).all(axis=1)
    points, pixel = points[inside], pixel[inside]
    nothing = np.zeros(0, np.int64)
    if not len(points) or not found.num_keypoints:
        return _Links(nothing, nothing, nothing, nothing, np.zeros(0), np.zeros((0, 2)))
    near, feature = map(np.asarray, KDTree(found.xy_px).query(pixel, k=_NEAREST, distance_upper_bound=radius_px))
    which, slot = np.nonzero(np.isfinite(near))
    point, feature = points[which], feature[which, slot]
    given = np.asarray(found.descriptors)[feature]
    distance = np.minimum(*(_distances(known.descriptors[point, side], given, known.is_binary) for side in (0, 1)))
    keep = (distance <= known.limit) & _is_first(point, distance)
    keep[keep] = _is_first(place[feature[keep]], distance[keep])
    point, feature = point[keep], feature[keep]
    return _Links(
        block.track_index[point],
        np.full(len(point), image),
        feature,
        owner[feature],
        distance[keep],
        np.asarray(found.xy_px, float)[feature],
    )


def _joined(tracks: Tracks, links: _Links) -> Tracks:
    """Return the tracks with links added, the nearest descriptors first, never two features of one image in a track."""
    linked = np.unique(np.concatenate([links.track, links.owner[links.owner >= 0]])).tolist()
    joined = DisjointSet(linked)
    images: dict[int, set[int]] = {}

    def images_of(track: int) -> set[int]:
        if track not in images:
            first, last = np.searchsorted(tracks.track_index, [track, track + 1])
            images[track] = set(tracks.image_index[first:last].tolist())
        return images[track]

    added = []
    for k in np.lexsort((links.feature, links.image, links.track, links.distance)):
        own = joined[int(links.track[k])]
        if links.owner[k] < 0:
            if int(links.image[k]) not in images_of(own):
                images_of(own).add(int(links.image[k]))
                added.append(k)
            continue
        other = joined[int(links.owner[k])]
        if own != other and images_of(own).isdisjoint(images_of(other)):
            joined.merge(own, other)
            images[joined[own]] = images_of(own) | images_of(other)
    lowest: dict[int, int] = {}  # track of each of the joined ones, which lends them its place and colour
    place = np.arange(tracks.num_tracks)
    place[linked] = [lowest.setdefault(joined[track], track) for track in linked]
    track = np.concatenate([place[tracks.track_index], place[links.track[added]]])
    image = np.concatenate([tracks.image_index, links.image[added].astype(tracks.image_index.dtype)])
    feature = np.concatenate([tracks.feature_index, links.feature[added].astype(tracks.feature_index.dtype)])
    order = np.lexsort((image, track))
    kept, number = np.unique(track[order], return_inverse=True)
    return dataclasses.replace(
        tracks,
        track_index=number.astype(tracks.track_index.dtype),
        image_index=image[order],
        feature_index=feature[order],
        xy_px=np.concatenate([tracks.xy_px, links.xy_px[added]])[order],
        rgb=tracks.rgb[kept],
    )


def _cos_of_view(block: Block, photos: tuple[Photo, ...]) -> Float[np.ndarray, " cameras"]:
    """Return the cosine of the angle from each camera's axis beyond which its images see nothing; -1 where unknown."""
    found = np.full(len(block.camera_parameters), -1.0)
    along = np.linspace(0.0, 1.0, _BORDER)
    ends = np.zeros_like(along), np.ones_like(along)
    border = np.concatenate([np.stack(side, axis=1) for end in ends for side in ((along, end), (end, along))])
    for camera in np.unique(block.camera_index):
        row = int(np.flatnonzero(block.camera_index == camera)[0])
        photo = photos[block.image_index[row]]
        rays = make_rays(block, np.full(len(border), row), border * [photo.width_px, photo.height_px])
        axis = Rotation.from_quat(block.quaternion[row], scalar_first=True).as_matrix()[2]
        angle = np.arccos(np.clip(axis @ rays.direction, -1.0, 1.0)).max()
        found[camera] = np.cos(min(_MARGIN * angle, np.pi)) if np.isfinite(angle) else -1.0
    return found


def _pixels(
    block: Block, row: int, points: Int[np.ndarray, " points"], cos_view: float
) -> tuple[Int[np.ndarray, " seen"], Float[np.ndarray, "seen 2"]]:
    """Return which of the points an image looks towards, before the camera, and where they fall in it."""
    rotation = Rotation.from_quat(block.quaternion[row], scalar_first=True).as_matrix()
    in_cam = rotation @ block.points_m[points].T + block.translation_m[row][:, None]
    ahead = (in_cam[2] > 0) & (in_cam[2] >= cos_view * np.sqrt(np.einsum("kn,kn->n", in_cam, in_cam)))
    points, in_cam = points[ahead], in_cam[:, ahead]
    camera = CAMERAS[block.camera_model](*block.camera_parameters.T)
    return points, project_in_cameras(camera, np.full(len(points), block.camera_index[row]), in_cam).T


def _distances(
    first: UInt8[np.ndarray, "n length"], second: UInt8[np.ndarray, "n length"], is_binary: bool
) -> Float[np.ndarray, " n"]:
    """Return distances of descriptors: bits that differ, or of SIFT's square roots (unit length)."""
    if is_binary:
        return np.bitwise_count(first ^ second).sum(axis=1, dtype=np.float64)
    product = np.sqrt(first.astype(np.float32) * second).sum(axis=1, dtype=np.float64)
    total = first.sum(axis=1, dtype=np.float64) * second.sum(axis=1, dtype=np.float64)
    return np.sqrt(np.maximum(2 - 2 * product / np.sqrt(np.maximum(total, 1.0)), 0.0))


def _is_first(group: Int[np.ndarray, " n"], value: Float[np.ndarray, " n"]) -> Bool[np.ndarray, " n"]:
    """Return which entry of each group has the least value; the first of equal ones."""
    order = np.lexsort((np.arange(len(group)), value, group))
    mask = np.zeros(len(group), bool)
    mask[order[np.unique(group[order], return_index=True)[1]]] = True
    return mask
