"""Judging observations: the limit of a round's errors, and the sigma of an observation.

Errors are compared as if all were in long tracks, times `redundancy_root` of theirs: in a track of two views a point
takes up three quarters of the errors. What is over the limit is told by `tail_root`. The limit is median + factor x MAD
over all observations, those left out before included, so that what was left out returns when it fits and the tail is
cut once and not anew in each round. It is at most `track_threshold`, unless the median is still so large that this
would leave nothing, and not below `f_scale`: what the loss counts in full is no outlier.

Nor is it below 3.5 sigmas, as normal errors of that median have them. Median + 2.5 MAD cuts these at 2.3 sigmas: the
variances of the result grow by a third, which no covariance shows, and the block remembers where it started, since what
its first camera did not fit stays out: over 32 simulated blocks k2 ended 2 sigmas from the truth on the average (0.1
with this limit), and errors of points squared were 1.6 times what their sigmas say (1.16).
"""

import numpy as np
from jaxtyping import Float, Int

from jaxba.scene import Block, Tracks
from jaxba.sfm._points import Triangulated, redundancy_root, triangulate_tracks
from jaxba.sfm._rounds import Settings

_SETTLED = 0.1  # change of the limit between rounds that is none
_GROSS = 2.2  # times the limit
_LEAST = 3.5 / np.sqrt(2 * np.log(2))  # times the median: 3.5 sigmas of errors of two normal coordinates
_STD_PX = (0.05, 5.0)


def judge(
    block: Block, tracks: Tracks, error_px: Float[np.ndarray, " observations"], before: float | None, settings: Settings
) -> tuple[Triangulated, float]:
    """Return all tracks triangulated with the limit that the errors of all their observations give, and the limit.

    `before`: the last round's limit, kept where the new one is near it, so that rounds settle.
    """
    views = np.bincount(block.observation_point, minlength=block.num_points)
    limit_px = before or _limit(error_px * redundancy_root(views)[block.observation_point], settings)
    for _ in range(2):
        found = triangulate_tracks(block, tracks, settings.min_angle_rad, limit_px, by_redundancy=True)
        better = _limit(_comparable_px(found), settings)
        if abs(better - limit_px) <= _SETTLED * limit_px:
            return found, limit_px
        limit_px = better
    return triangulate_tracks(block, tracks, settings.min_angle_rad, limit_px, by_redundancy=True), limit_px


def estimate_std(found: Triangulated, limit_px: float, block: Block) -> float:
    """Return the sigma of a coordinate, from the sum of squared errors of each track.

    In a track of n views it is sigma^2 times a chi-square of 2n - 3 degrees of freedom: the median over all tracks of
    the sum over that distribution's median gives sigma. Gross errors are left out (beyond some 5 sigma), the tail that
    a round rejects is not, or sigma would come out too small. The poses take up a further share.
    """
    error = found.error_px
    use = found.is_point[found.of_track] & (_comparable_px(found) <= _GROSS * limit_px)
    views = np.bincount(found.of_track[use], minlength=len(found.track_index))
    total = np.bincount(found.of_track[use], error[use] ** 2, minlength=len(found.track_index))
    freedom = 2 * views[views >= 2] - 3
    middle = freedom * (1 - 2 / (9 * freedom)) ** 3  # of a chi-square (Wilson and Hilferty 1931)
    if not len(middle):
        return 1.0
    of_points = 2 * block.num_observations - 3 * block.num_points
    share = max(1 - 6 * block.num_images / max(of_points, 1), 0.1)
    return float(np.clip(np.sqrt(np.median(total[views >= 2] / middle) / share), *_STD_PX))


def used_in_track(found: Triangulated) -> Int[np.ndarray, " rows"]:
    """Return how many rows of the track of each row are used."""
    used = np.bincount(found.of_track[found.is_used], minlength=len(found.track_index))
    return used[found.of_track]


def _comparable_px(found: Triangulated) -> Float[np.ndarray, " rows"]:
    """Return errors as if all were in long tracks."""
    return found.error_px * redundancy_root(np.bincount(found.of_track))[found.of_track]


def _limit(error_px: Float[np.ndarray, " n"], settings: Settings) -> float:
    error_px = error_px[np.isfinite(error_px)]
    if not len(error_px):
        return settings.track_threshold
    median = float(np.median(error_px))
    by_mad = max(median + settings.mad_factor * float(np.median(np.abs(error_px - median))), _LEAST * median)
    return max(min(by_mad, max(settings.track_threshold, 1.5 * median)), settings.f_scale)
