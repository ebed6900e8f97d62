"""Points of tracks: every track is triangulated anew from a block's poses and cameras, wrong observations left out.

For the rays of a track (see `_rays.py`) the point minimises the sum of squared reprojection errors,

    sum w_i M_i^T M_i (x - c_i) = 0,   w_i = 1 / rho_i^2,

solved twice with the weights of the time before. A track in which an observation is off by more than `max_error_px`
goes through a consensus: the point of every pair of its rays is judged by all of them (sum of 1 - (e / max)^2 over
those within; Torr and Zisserman 2000), the best one names the good observations, and the track is solved again from
them. So a track with one wrong feature survives, and one that joins two points keeps the larger part.

`jaxba.triangulate` does something else: it minimises distances to rays, takes every view as right, and pads tracks to
one length for jax. Here tracks have any length, errors are in pixels, and wrong observations are found.

Cost: numpy alone beside the rays; 100k tracks with 500k observations take 1.0 s, 1.6 s where 10% of the observations
are wrong.
"""

import dataclasses
import itertools
from collections.abc import Iterator

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxba._errors import JaxbaError
from jaxba.scene import Block, Tracks
from jaxba.sfm._cores import on_all_cores
from jaxba.sfm._rays import Rays, make_rays

_MAX_PAIRS = 45  # of one track's rays: all of them up to ten rays
_CONSENSUS_SIZE = 1_000_000  # errors computed at a time
_PIECE = 100_000  # rows worked on at a time by a core: some 0.6 kB each


@dataclasses.dataclass(frozen=True)
class Triangulated:
    """Points of all tracks of a block's images, and what each observation says to them.

    - `row`: rows of the tracks that lie in registered images and in tracks with two or more of these; `image_row`:
      their images, as rows of the block. `of_track`: their tracks, as positions in `track_index`.
    - `track_index`: the tracks. `point_m`: their points, without meaning where not `is_point`.
    - `error_px`: of every row, used or not; infinite behind the camera. Where no two rays agree it is that to the
      point of all rays; NaN where rays fix none.
    - `is_used`: the row fits. `is_point`: two or more rows fit, and their rays meet at a large enough angle.
    """

    row: Int[np.ndarray, " rows"]
    image_row: Int[np.ndarray, " rows"]
    of_track: Int[np.ndarray, " rows"]
    track_index: Int[np.ndarray, " tracks"]
    point_m: Float[np.ndarray, "tracks 3"]
    error_px: Float[np.ndarray, " rows"]
    is_used: Bool[np.ndarray, " rows"]
    is_point: Bool[np.ndarray, " tracks"]


def with_points(block: Block, tracks: Tracks, *, min_angle_rad: float, max_error_px: float) -> Block:
    """Return the block with the points of all tracks of its images, triangulated from its poses and cameras.

    - `min_angle_rad`: the largest angle between two rays of a point is at least this.
    - `max_error_px`: every observation kept has at most this reprojection error, and its point lies before the camera.

    A point has two observations or more. Points and observations that the block had are replaced.

    >>> import numpy as np
    >>> from jaxba.scene import Block, Tracks
    >>> one = np.ones((1, 3), np.uint8)
    >>> block = Block(
    ...     image_index=np.array([0, 3]), quaternion=np.tile([1.0, 0, 0, 0], (2, 1)),
    ...     translation_m=np.array([[0.0, 0, 0], [-1, 0, 0]]), camera_model="SIMPLE_PINHOLE", camera_names=("a",),
    ...     camera_parameters=np.array([[1000.0, 500, 400]]), camera_index=np.array([0, 0]),
    ...     points_m=np.zeros((0, 3)), track_index=np.zeros(0, int), rgb=one[:0], observation_image=np.zeros(0, int),
    ...     observation_point=np.zeros(0, int), observation_xy_px=np.zeros((0, 2)), is_georeferenced=False)
    >>> tracks = Tracks(
    ...     track_index=np.array([0, 0]), image_index=np.array([0, 3]), feature_index=np.array([7, 9]),
    ...     xy_px=np.array([[550.0, 400], [450, 400]]), rgb=one, components=((0, 3),))
    >>> with_points(block, tracks, min_angle_rad=0.02, max_error_px=2.0).points_m.round(6).tolist()
    [[0.5, 0.0, 10.0]]
    """
    return apply_points(block, tracks, triangulate_tracks(block, tracks, min_angle_rad, max_error_px))


def apply_points(block: Block, tracks: Tracks, found: Triangulated) -> Block:
    """Return the block with these points and the observations that fit them."""
    number = np.cumsum(found.is_point, dtype=np.int32) - 1
    keep = found.is_used & found.is_point[found.of_track]
    index = found.track_index[found.is_point]
    return dataclasses.replace(
        block,
        points_m=found.point_m[found.is_point],
        track_index=index,
        rgb=tracks.rgb[index],
        observation_image=found.image_row[keep],
        observation_point=number[found.of_track[keep]],
        observation_xy_px=tracks.xy_px[found.row[keep]],
    )


def triangulate_tracks(
    block: Block, tracks: Tracks, min_angle_rad: float, max_error_px: float, *, by_redundancy: bool = False
) -> Triangulated:
    """Return the points of all tracks that two or more of the block's images see.

    `by_redundancy`: `max_error_px` is for an error in a long track; others' get one that as many exceed (`tail_root`).
    """
    if not max_error_px > 0 or not 0 <= min_angle_rad < np.pi:
        raise JaxbaError(
            f"max_error_px={max_error_px:g}, min_angle_rad={min_angle_rad:g}: give a positive error and an angle from "
            "0 to 3.1, such as 2 px and 0.026."
        )
    row, image_row, of_track, track_index = track_rows(block, tracks)
    counts, middle_m = np.bincount(of_track, minlength=len(track_index)), block.centers_m.mean(axis=0)
    limit_px = np.full(len(row), float(max_error_px))
    if by_redundancy:
        limit_px /= tail_root(counts)[of_track]
    point, error = np.zeros((3, len(counts))), np.zeros(len(row))
    is_used, is_point = np.zeros(len(row), bool), np.zeros(len(counts), bool)

    def triangulate(piece: slice, rows: slice) -> None:
        rays = make_rays(block, image_row[rows], tracks.xy_px[row[rows]])
        found = _Tracks.of(rays, counts[piece], middle_m, limit_px[rows]).triangulated(min_angle_rad)
        point[:, piece], error[rows], is_used[rows], is_point[piece] = found

    on_all_cores(triangulate, *zip(*pieces(counts, _PIECE), strict=True))
    return Triangulated(row, image_row, of_track, track_index, point.T.copy(), error, is_used, is_point)


def pieces(counts: Int[np.ndarray, " groups"], most: int) -> Iterator[tuple[slice, slice]]:
    """Cut groups of rows, one after the other, into pieces of about `most` rows: slices of the groups, and of the rows.

    >>> [(groups.stop, rows.stop) for groups, rows in pieces(np.array([2, 2, 5, 1]), 4)]
    [(2, 4), (3, 9), (4, 10)]
    """
    ends = np.cumsum(counts)
    first = first_row = 0
    while first < len(counts):
        last = max(int(np.searchsorted(ends, first_row + most, side="right")), first + 1)
        yield slice(first, last), slice(first_row, int(ends[last - 1]))
        first, first_row = last, int(ends[last - 1])


def redundancy_root(views: Int[np.ndarray, " tracks"]) -> Float[np.ndarray, " tracks"]:
    """Return what an error in a track of so many views is to be multiplied by, to compare with one in a long track.

    A point takes up 3 of the 2n measured coordinates, so that errors are smaller than those of measuring by the root of
    `(2n - 3) / 2n`: by 2 in a track of two views.
    """
    views = np.maximum(views, 2)
    return np.sqrt(2 * views / (2 * views - 3))


def tail_root(views: Int[np.ndarray, " tracks"]) -> Float[np.ndarray, " tracks"]:
    """Return what an error in a track of so many views is to be multiplied by, for a limit beyond which as many lie.

    Errors of two views are all along one direction, and of a few nearly so: longer tails than `redundancy_root` makes
    alike. Of normal errors 1.4% in tracks of two views, and 0.5% of three, were over 3.5 sigmas, where 0.2% are in long
    ones; 0.7% of the observations of simulated blocks were cut for it, and 0.3% are now. The factor is from simulated
    rays of 2 to 8 views, good to 1%.
    """
    return redundancy_root(views) * (1 - 0.19 / (2 * np.maximum(views, 2) - 3))


def track_rows(block: Block, tracks: Tracks) -> tuple[Int[np.ndarray, " rows"], ...]:
    """Return rows of tracks that two or more registered images see, their image rows, tracks and track indices."""
    size = max(block.image_index.max(initial=-1), tracks.image_index.max(initial=-1)) + 1
    row_of_image = np.full(size, -1, np.int32)
    row_of_image[block.image_index] = np.arange(block.num_images)
    image_row = row_of_image[tracks.image_index]
    times = np.bincount(tracks.track_index[image_row >= 0], minlength=tracks.num_tracks)
    row = np.flatnonzero((image_row >= 0) & (times[tracks.track_index] >= 2)).astype(np.int32)
    track_index, of_track = np.unique(tracks.track_index[row], return_inverse=True)
    return row, image_row[row], of_track.astype(np.int32), track_index.astype(np.int64)


@dataclasses.dataclass(frozen=True)
class _Tracks:
    """Rays ordered by track, and what is done with them."""

    rays: Rays
    of_track: Int[np.ndarray, " rows"]
    starts: Int[np.ndarray, " tracks"]
    counts: Int[np.ndarray, " tracks"]
    middle_m: Float[np.ndarray, "3"]
    limit_px: Float[np.ndarray, " rows"]

    @staticmethod
    def of(
        rays: Rays,
        counts: Int[np.ndarray, " tracks"],
        middle_m: Float[np.ndarray, "3"],
        limit_px: Float[np.ndarray, " rows"],
    ) -> "_Tracks":
        return _Tracks(
            rays, np.repeat(np.arange(len(counts)), counts), np.cumsum(counts) - counts, counts, middle_m, limit_px
        )

    def triangulated(self, min_angle_rad: float) -> tuple[np.ndarray, ...]:
        """Return points, errors, which rows are used and which tracks have a point, as `Triangulated` has them."""
        starts, limit_px = self.starts, self.limit_px
        used = np.isfinite(self.rays.direction[0])
        usable, agree = used, np.ones(len(used), bool)
        point, error = self.solve(used)
        with np.errstate(invalid="ignore"):
            doubtful = np.logical_or.reduceat(used & ~(error <= limit_px), starts) & (self.counts > 2)
        if doubtful.any():
            used = self.consensus(np.flatnonzero(doubtful), used)
            for _ in range(2):
                point, error = self.solve(used)
                used = error <= limit_px  # all are judged anew: what was left out may fit the better point
            agree = (np.add.reduceat(used, starts) >= 2)[self.of_track]
            point, error = self.solve(np.where(agree, used, usable))
        is_used = (error <= limit_px) & agree
        is_point = (np.add.reduceat(is_used, starts) >= 2) & np.isfinite(point).all(axis=0)
        is_point &= self.largest_angle(is_used) >= min_angle_rad
        return point, error, is_used, is_point

    def solve(
        self, used: Bool[np.ndarray, " rows"]
    ) -> tuple[Float[np.ndarray, "3 tracks"], Float[np.ndarray, " rows"]]:
        """Return the point of each track from the rays used (NaN if they fix none), and the error of every ray."""
        matrix, right = _normal_parts(self.rays, self.middle_m)
        weight = used.astype(float)
        matrix, right = np.where(used, matrix, 0.0), np.where(used, right, 0.0)
        point, error = np.empty((3, len(self.starts))), np.empty(len(used))
        for _ in range(3):
            total = np.add.reduceat(matrix * weight, self.starts, axis=1)
            point = _solve(total, np.add.reduceat(right * weight, self.starts, axis=1)) + self.middle_m[:, None]
            error, distance = self.rays.errors_px(point[:, self.of_track])
            with np.errstate(all="ignore"):
                weight = np.where(np.isfinite(distance) & (distance > 0), 1 / distance**2, 0.0)
            largest = np.maximum.reduceat(np.where(used, weight, 0.0), self.starts)[self.of_track]
            weight = np.where(largest > 0, weight / np.where(largest > 0, largest, 1.0), 1.0)
        return point, error

    def consensus(
        self, tracks: Int[np.ndarray, " doubtful"], used: Bool[np.ndarray, " rows"]
    ) -> Bool[np.ndarray, " rows"]:
        """Return the rows used, where these tracks use what agrees with their best pair of rays."""
        used = used.copy()
        for count in np.unique(self.counts[tracks]):
            pairs = np.array(list(itertools.combinations(range(count), 2)))
            if len(pairs) > _MAX_PAIRS:
                pairs = pairs[np.linspace(0, len(pairs) - 1, _MAX_PAIRS).round().astype(int)]
            alike = tracks[self.counts[tracks] == count]
            size = max(1, _CONSENSUS_SIZE // (count * len(pairs)))
            for first in range(0, len(alike), size):
                rows = self.starts[alike[first : first + size], None] + np.arange(count)
                used[rows] &= self._best_pair(rows, pairs)
        return used

    def _best_pair(self, rows: Int[np.ndarray, "t n"], pairs: Int[np.ndarray, "p 2"]) -> Bool[np.ndarray, "t n"]:
        """Return which rays of each track agree with its best pair."""
        rays = self.rays.take(rows)
        matrix, right = _normal_parts(rays, self.middle_m)  # (6 t n), (3 t n)
        of_pair = [part[:, :, pairs[:, 0]] + part[:, :, pairs[:, 1]] for part in (matrix, right)]
        point = _solve(of_pair[0], of_pair[1]) + self.middle_m[:, None, None]  # (3 t p)
        offset = point[:, :, :, None] - rays.center_m[:, :, None]  # (3 t p n)
        distance = np.einsum("ktn,ktpn->tpn", rays.direction, offset)
        with np.errstate(all="ignore"):
            squared = sum(np.einsum("ktn,ktpn->tpn", m, offset) ** 2 for m in rays.by_point)
            share = squared / (distance * self.limit_px[rows][:, None]) ** 2
            share = np.where((distance > 0) & (share <= 1), share, 1.0)
        best = np.argmax(np.sum(1 - share, axis=2), axis=1)
        return share[np.arange(len(rows)), best] < 1

    def largest_angle(self, used: Bool[np.ndarray, " rows"]) -> Float[np.ndarray, " tracks"]:
        """Return the largest angle between two rays used of each track, from the chord; 0 with fewer than two."""
        chord2 = np.zeros(len(self.starts))
        for count in np.unique(self.counts):
            alike = np.flatnonzero(self.counts == count)
            rows = self.starts[alike, None] + np.arange(count)
            direction = np.where(used[rows], self.rays.direction[:, rows], np.nan)
            for i in range(1, count):
                apart = np.sum((direction[:, :, i:] - direction[:, :, :-i]) ** 2, axis=0)
                chord2[alike] = np.fmax(chord2[alike], np.fmax.reduce(apart, axis=1))
        return 2 * np.arcsin(np.minimum(np.sqrt(chord2) / 2, 1.0))


_UPPER = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))


def _normal_parts(rays: Rays, middle_m: Float[np.ndarray, "3"]) -> tuple[Float[np.ndarray, "..."], ...]:
    """Return `M^T M` (six numbers, components first) and `M^T M (c - middle)` of each ray."""
    (u, v), shape = rays.by_point, rays.center_m.shape[1:]
    matrix = np.stack([u[i] * u[j] + v[i] * v[j] for i, j in _UPPER])
    offset = rays.center_m - middle_m.reshape(3, *(1 for _ in shape))
    along = [sum(m[k] * offset[k] for k in range(3)) for m in (u, v)]
    return matrix, np.stack([u[i] * along[0] + v[i] * along[1] for i in range(3)])


def _solve(matrix: Float[np.ndarray, "6 *n"], right: Float[np.ndarray, "3 *n"]) -> Float[np.ndarray, "3 *n"]:
    """Solve symmetric 3x3 systems by cofactors; NaN where one is singular to within rounding."""
    a, b, c, d, e, f = matrix
    ca, cb, cc = d * f - e * e, c * e - b * f, b * e - c * d
    cd, ce, cf = a * f - c * c, b * c - a * e, a * d - b * b
    determinant = a * ca + b * cb + c * cc
    with np.errstate(all="ignore"):
        scale = np.where(determinant > 1e-14 * ((a + d + f) / 3) ** 3, 1 / determinant, np.nan)
    x, y, z = right
    return scale * np.stack([ca * x + cb * y + cc * z, cb * x + cd * y + ce * z, cc * x + ce * y + cf * z])
