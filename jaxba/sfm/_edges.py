"""Edges of the view graph that an adjusted block contradicts, and the tracks without them.

A match of two images is wrong by the largest of three distances: the reprojection error of either feature to the point
of their track, and the distance of one feature from the other's epipolar line. The last one finds a wrong edge whose
features no third image sees, where both errors share the distance. With sigma s of a coordinate the median over a good
edge is near 1.6 s.
"""

import dataclasses
from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy import sparse
from scipy.sparse.csgraph import connected_components

from jaxba.scene import Block, Photo, PrunedEdge, Tracks, ViewGraph
from jaxba.sfm._cores import on_all_cores
from jaxba.sfm._points import Triangulated, pieces
from jaxba.sfm._rays import Rays, make_rays

_LEAST_MATCHES = 5  # fewer have no median to speak of
_MAX_PRUNED = 0.3  # of the edges: more of them over the limit speak of the block, not of the edges
_PIECE = 100_000  # matches worked on at a time by a core
_FAR = 10.0  # times the limit of an edge: no bent block explains it


@dataclasses.dataclass(frozen=True)
class MatchRows:
    """Matches of a view graph as pairs of rows of tracks; only those whose features are in one track.

    - `edge`: of each match. `first`, `second`: rows in the tracks.
    """

    edge: Int[np.ndarray, " matches"]
    first: Int[np.ndarray, " matches"]
    second: Int[np.ndarray, " matches"]

    def select(self, keep: Bool[np.ndarray, " matches"]) -> "MatchRows":
        """Return some of the matches."""
        return MatchRows(self.edge[keep], self.first[keep], self.second[keep])


def match_rows(view_graph: ViewGraph, tracks: Tracks) -> MatchRows:
    """Return the matches as rows of the tracks."""
    edge = np.repeat(np.arange(len(view_graph.pairs), dtype=np.int32), view_graph.num_inliers)
    size = 1 + max(tracks.feature_index.max(initial=0), view_graph.matches.max(initial=0))
    key = tracks.image_index.astype(np.int64) * size + tracks.feature_index
    order = np.argsort(key, kind="stable").astype(np.int32)
    key, rows = key[order], []
    for side in range(2):
        wanted = view_graph.pairs[edge, side].astype(np.int64) * size + view_graph.matches[:, side]
        place = np.minimum(np.searchsorted(key, wanted), max(len(key) - 1, 0))
        rows.append(
            np.where(key[place] == wanted, order[place], np.int32(-1)) if len(key) else np.full(len(edge), -1, np.int32)
        )
    inside = (rows[0] >= 0) & (rows[1] >= 0)
    inside[inside] = tracks.track_index[rows[0][inside]] == tracks.track_index[rows[1][inside]]
    return MatchRows(edge[inside], rows[0][inside], rows[1][inside])


def edge_medians_px(
    matches: MatchRows, found: Triangulated, block: Block, tracks: Tracks, num_edges: int
) -> Float[np.ndarray, " edges"]:
    """Return the median error of each edge's matches between registered images, pixels; NaN where there are few.

    - `found`: of the block's images and the tracks.
    """
    place = np.full(tracks.num_observations, -1, np.int32)
    place[found.row] = np.arange(len(found.row), dtype=np.int32)
    first, second = place[matches.first], place[matches.second]
    both = (first >= 0) & (second >= 0)
    edge, first, second = matches.edge[both], first[both], second[both]
    error = np.zeros(len(edge))

    def of_piece(_: slice, here: slice) -> None:
        rows, (one, other) = np.unique((first[here], second[here]), return_inverse=True)
        rays = make_rays(block, found.image_row[rows], tracks.xy_px[found.row[rows]])
        error[here] = epipolar_px(rays.take(one), rays.take(other))

    on_all_cores(of_piece, *zip(*pieces(np.bincount(edge, minlength=num_edges), _PIECE), strict=True))
    for side in (first, second):
        of_point = np.where(found.is_point[found.of_track[side]], found.error_px[side], 0.0)
        error = np.fmax(error, of_point)
    order = np.lexsort((error, edge))
    counts = np.bincount(edge, minlength=num_edges)
    start = np.cumsum(counts) - counts
    some = counts >= _LEAST_MATCHES
    median = np.full(num_edges, np.nan)
    median[some] = error[order][(start + (counts - 1) // 2)[some]]
    return median


def epipolar_px(first: Rays, second: Rays) -> Float[np.ndarray, " n"]:
    """Return the distance of each feature from the epipolar line of its partner, the mean of both sides, pixels."""
    base = second.center_m - first.center_m
    normal = np.cross(first.direction, base, axis=0)
    total = np.zeros(base.shape[1])
    for here, other in ((first, second), (second, first)):
        normal = np.cross(other.direction, base, axis=0)
        total += _distance_px(here, normal)
    return total / 2


def _distance_px(rays: Rays, normal: Float[np.ndarray, "3 n"]) -> Float[np.ndarray, " n"]:
    """Return how far the rays lie from the planes through their centres with these normals, pixels.

    `n . d` changes by `n . dd` for a small turn `dd` of the ray, which moves its pixel by `e = M dd`: of all pixels e
    on the line the nearest one is `|n . d| / |g|`, g the gradient of `n . d` by the pixel, `M^T g = n` across the ray.
    """
    u, v = rays.by_point
    uu, uv, vv = (np.einsum("kn,kn->n", a, b) for a, b in ((u, u), (u, v), (v, v)))
    nu, nv = np.einsum("kn,kn->n", normal, u), np.einsum("kn,kn->n", normal, v)
    with np.errstate(all="ignore"):
        determinant = uu * vv - uv * uv
        gu, gv = (vv * nu - uv * nv) / determinant, (uu * nv - uv * nu) / determinant
        return np.abs(np.einsum("kn,kn->n", normal, rays.direction)) / np.hypot(gu, gv)


def without_edges(tracks: Tracks, matches: MatchRows, pruned: Bool[np.ndarray, " edges"]) -> tuple[Tracks, MatchRows]:
    """Return the tracks that the other edges join, and their matches; features that nothing joins any more are gone."""
    matches = matches.select(~pruned[matches.edge])
    count = tracks.num_observations
    ones = np.ones(len(matches.edge), bool)
    graph = sparse.coo_array((ones, (matches.first, matches.second)), shape=(count, count))
    label = connected_components(graph, directed=False)[1]
    kept = np.flatnonzero(np.bincount(label)[label] >= 2)
    # numbered by their first row, which keeps the order of the tracks
    _, first_row, number = np.unique(label[kept], return_index=True, return_inverse=True)
    rank = np.argsort(np.argsort(first_row))
    new_index = rank[number]
    order = np.lexsort((tracks.image_index[kept], new_index))
    rgb = np.empty((len(first_row), 3), np.uint8)
    rgb[rank] = tracks.rgb[tracks.track_index[kept[first_row]]]
    rows = kept[order]
    moved = np.full(count, -1, np.int32)
    moved[rows] = np.arange(len(rows), dtype=np.int32)
    changed = dataclasses.replace(
        tracks,
        track_index=new_index[order],
        image_index=tracks.image_index[rows],
        feature_index=tracks.feature_index[rows],
        xy_px=tracks.xy_px[rows],
        rgb=rgb,
    )
    return changed, MatchRows(matches.edge, moved[matches.first], moved[matches.second])


def edges_to_prune(
    view_graph: ViewGraph, median_px: Float[np.ndarray, " edges"], limit_px: float, photos: Sequence[Photo]
) -> tuple[dict[int, PrunedEdge], list[str]]:
    """Return the edges over the limit with their figures, or none of them and a warning where they are too many.

    A wrong edge pulls its two images off, and right edges of theirs go over the limit with it: of those near the limit
    only the worst one at each image is pruned in a round.
    """
    over = np.flatnonzero(median_px > limit_px)
    judged = int(np.isfinite(median_px).sum())
    if len(over) > max(_MAX_PRUNED * judged, 1):
        return {}, [
            f"{len(over)} of {judged} edges are off by more than {limit_px:g} px in their median: the "
            "block does not fit together, so none was left out. Check the focal length against the sensor's "
            "specification, and that photos of different cameras or zooms are not mixed."
        ]
    pruned, touched = {}, set[int]()
    for k in over[np.argsort(-median_px[over], kind="stable")]:
        images = {int(i) for i in view_graph.pairs[k]}
        if touched & images and median_px[k] < _FAR * limit_px:
            continue
        touched |= images
        first, second = (photos[i].name for i in view_graph.pairs[k])
        pruned[int(k)] = PrunedEdge(
            name=f"{first}, {second}",
            num_matches=int(view_graph.num_inliers[k]),
            median_px=float(median_px[k]),
            limit_px=limit_px,
        )
    return pruned, []
