"""Tracks completed: with poses known, a point is looked for in every image that it falls into.

Matching finds a point in two images, by one descriptor against thousands. Where the poses foretell its pixel within a
few px, only the few features there compete, and a match that failed the ratio test or the mutual check is found after
all. A feature that belongs to another track joins the two tracks, if no image sees both. Tracks of keypoints without a
descriptor among the features, which an image may have behind them, stay as they are.

A found feature's descriptor must be as near to one of the track's as the features of matched pairs are to each other:
the limit is the 90% quantile of their distances. Whether the found observations fit is for the adjustment to judge,
like that of all others.

Cost: a projection and a search in a k-d tree for each point that an image looks towards (see `_views.py`); the features
of as many images as there are cores are open at a time.
"""

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8
from scipy.cluster.hierarchy import DisjointSet
from scipy.spatial import KDTree

from jaxba.scene import Block, DescriptorKind, Features, Photo, Tracks, descriptor_distances
from jaxba.sfm._cores import on_all_cores
from jaxba.sfm._views import Views

_NEAREST = 4  # features that compete for a point
_QUANTILE = 0.9
_BORDER, _MARGIN = 17, 1.05  # pixels on each side of an image; of the angle to them
_PIECE = 50_000  # points, of which distances are computed at a time
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
    views = Views(block, photos)
    by_image = np.argsort(tracks.image_index, kind="stable")
    ends = np.searchsorted(tracks.image_index, block.image_index, side="right", sorter=by_image)
    starts = np.searchsorted(tracks.image_index, block.image_index, sorter=by_image)

    def links_in(row: int) -> _Links:
        return _links_in(row, by_image[starts[row] : ends[row]], block, tracks, features, known, views, radius_px)

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
    kind: DescriptorKind
    limit: float

    @staticmethod
    def of(block: Block, tracks: Tracks, features: Mapping[int, Features]) -> "_Known | None":
        point_of_track = np.full(tracks.num_tracks, -1)
        point_of_track[block.track_index] = np.arange(block.num_points)
        starts = np.searchsorted(tracks.track_index, block.track_index)
        ends = np.searchsorted(tracks.track_index, block.track_index, side="right") - 1
        descriptors, kind = None, None
        is_described = np.ones(block.num_points, bool)
        for image in np.unique(tracks.image_index[np.concatenate([starts, ends])]):
            found = features[int(image)]
            if descriptors is None:
                descriptors = np.zeros((block.num_points, 2, found.descriptors.shape[1]), np.uint8)
                kind = found.kind
            for slot, rows in enumerate((starts, ends)):
                here = np.flatnonzero(tracks.image_index[rows] == image)
                has_one = tracks.feature_index[rows[here]] < found.num_keypoints
                is_described[here[~has_one]] = False
                here = here[has_one]
                descriptors[here, slot] = found.descriptors[tracks.feature_index[rows[here]]]
        if descriptors is None or kind is None or is_described.sum() < _LEAST_PAIRS:
            return None
        described = np.flatnonzero(is_described)
        between = [
            descriptor_distances(descriptors[some, 0], descriptors[some, 1], kind)
            for some in np.array_split(described, len(described) // _PIECE + 1)
        ]
        return _Known(descriptors, is_described, kind, float(np.quantile(np.concatenate(between), _QUANTILE)))


def _links_in(
    row: int,
    in_image: Int[np.ndarray, " seen"],
    block: Block,
    tracks: Tracks,
    features: Mapping[int, Features],
    known: _Known,
    views: Views,
    radius_px: float,
) -> _Links:
    """Return the features of one image that points which it does not see yet have found.

    - `in_image`: its rows in the tracks.
    """
    image = int(block.image_index[row])
    found = features[image]
    owner = np.full(found.num_keypoints, -1)
    described = in_image[tracks.feature_index[in_image] < found.num_keypoints]
    owner[tracks.feature_index[described]] = tracks.track_index[described]
    # a keypoint of several orientations stands there several times: all of them belong to the track of one
    place = np.unique(found.xy_px, axis=0, return_inverse=True)[1].reshape(-1)
    of_place = np.full(place.max(initial=-1) + 1, -1)
    np.maximum.at(of_place, place, owner)
    owner = of_place[place]

    points = views.towards(row)
    points = points[known.is_described[points]]
    points = points[~np.isin(block.track_index[points], tracks.track_index[in_image])]
    points, pixel = views.pixels(row, points)
    nothing = np.zeros(0, np.int64)
    if not len(points) or not found.num_keypoints:
        return _Links(nothing, nothing, nothing, nothing, np.zeros(0), np.zeros((0, 2)))
    near, feature = map(np.asarray, KDTree(found.xy_px).query(pixel, k=_NEAREST, distance_upper_bound=radius_px))
    which, slot = np.nonzero(np.isfinite(near))
    point, feature = points[which], feature[which, slot]
    given = np.asarray(found.descriptors)[feature]
    distance = np.minimum(*(descriptor_distances(known.descriptors[point, side], given, known.kind) for side in (0, 1)))
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


def _is_first(group: Int[np.ndarray, " n"], value: Float[np.ndarray, " n"]) -> Bool[np.ndarray, " n"]:
    """Return which entry of each group has the least value; the first of equal ones."""
    order = np.lexsort((np.arange(len(group)), value, group))
    mask = np.zeros(len(group), bool)
    mask[order[np.unique(group[order], return_index=True)[1]]] = True
    return mask
