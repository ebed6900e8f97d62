"""Sigmas of an adjusted block, from the covariance of its last solve, or why there are none.

The sigmas of observations are enlarged to how far errors really scatter (`_spread.py`), so the covariance is not scaled
by the variance factor once more; a point's own errors count in its sigma (`with_own_errors`).

Without control, positions are known to the mean of all GNSS positions; an offset that these have in common, metres for
a single receiver, is not in their sigmas, nor here. With control it is an unknown, and its sigma is in all others.

**Each point.** A blurred or slanted feature is measured worse in all its images: squared errors within a track have a
correlation of 0.3 to 0.4. The sums of squared errors of tracks tell how variances are distributed (scaled inverse
chi-square of nu degrees of freedom and scale s^2, by the mean and the variance of their logarithms; Smyth 2004), and
that of a track with the sum S and d = 2n - 3 is then expected to be

    (nu s^2 + S) / (nu + d - 2).

So a point of two images hardly speaks for itself, one of ten does. Intrinsics, which all tracks tell, have the sigmas
of a block in which only tracks are independent of each other.

**Without a place.** Where scale bars alone have told a block's scale, sigmas are those of its shape: under inner
constraints over its points, for who fits the block onto something by six parameters.
"""

import dataclasses
from concurrent.futures import wait
from typing import Any

import numpy as np
from jaxtyping import Float
from scipy.special import digamma, polygamma

from jaxba._errors import JaxbaError
from jaxba.ba import Covariance, Statistics, covariance, statistics
from jaxba.scene import Block, Reference
from jaxba.sfm._adjust import Adjusted
from jaxba.sfm._cores import on_all_cores
from jaxba.sfm._measured import used_positions
from jaxba.sfm._points import pieces
from jaxba.sfm._rays import make_rays
from jaxba.sfm._spread import weighed

_PIECE = 100_000  # observations worked on at a time by a core
_LEAST_TRACKS, _LEAST_FREEDOM = 100, 3  # to tell how variances are distributed
_FREEDOM = np.geomspace(3.0, 1000.0, 400)  # of that distribution; at the last, all tracks are alike


@dataclasses.dataclass(frozen=True)
class Uncertainty:
    """Sigmas, NaN where they were not computed; `why_not` says why.

    - `position_std_m`, `point_std_m`: world. `intrinsics_std`: in the parameters' units, 0 for what is fixed.
    - `variance_factor`: of the residuals, by the sigmas that weighed observations, tails aside; NaN likewise.
    - `covariance`, `statistics`: of the problem with the sigmas that its errors show; the latter where asked for.
    - `is_of_shape`: those of positions and points are of the block's shape, which has no place.
    """

    position_std_m: Float[np.ndarray, "images 3"]
    point_std_m: Float[np.ndarray, "points 3"]
    intrinsics_std: Float[np.ndarray, "cameras parameters"]
    variance_factor: float
    why_not: str | None = None
    covariance: Covariance | None = None
    statistics: Statistics | None = None
    is_of_shape: bool = False


def uncertainty(adjusted: Adjusted, reference: Reference, *, with_statistics: bool = False) -> Uncertainty:
    """Return the sigmas of an adjusted block; NaN along an axis in which no position is measured.

    - `with_statistics`: also those of every measurement, which compile for some seconds more.
    """
    block = adjusted.block
    position, point = np.full((block.num_images, 3), np.nan), np.full((block.num_points, 3), np.nan)
    times = adjusted.spread
    problem = weighed(adjusted.problem, times, block.num_observations)
    loss = dataclasses.replace(adjusted.loss, f_scale=adjusted.loss.f_scale / times)
    try:
        room: dict[str, Any] = {"independent": "tracks", "max_memory": adjusted.max_memory, "like": adjusted.shape}
        if adjusted.compiled is not None:
            wait([adjusted.compiled])  # what cannot be compiled fails below
        of_all = statistics(problem, loss=loss, **room) if with_statistics else None
        found = covariance(problem, loss=loss, **room) if of_all is None else of_all.covariance
    except JaxbaError as error:
        unknown = np.full(block.camera_parameters.shape, np.nan)
        return Uncertainty(position, point, unknown, np.nan, f"Sigmas were not computed. {error}")
    why_not, is_of_shape = None, not block.is_georeferenced and bool(adjusted.bars.is_used.any())
    if is_of_shape:
        try:
            found = covariance(problem, loss=loss, datum="inner", **room)
        except JaxbaError as error:
            is_of_shape, why_not = False, f"Sigmas of positions and points were not computed. {error}"
    if block.is_georeferenced or is_of_shape:
        position = _std(found.centers)
        variance = np.maximum(np.einsum("nii->ni", found.points[: block.num_points]), 0.0)
        point = np.sqrt(with_own_errors(variance, block, adjusted.error_px, times * adjusted.std_px))
    if block.is_georeferenced:
        index = block.image_index[used_positions(block, reference)]
        nowhere = ~np.isfinite(reference.std_m[index]).any(axis=0)
        if adjusted.control is not None:
            nowhere &= ~adjusted.control.determined
        position[:, nowhere], point[:, nowhere] = np.nan, np.nan
    elif not is_of_shape and why_not is None:
        why_not = (
            "Sigmas of positions and points were not computed: without measured positions the block has no place and "
            "no scale to give them in. Add GNSS positions or ground control."
        )
    factor = found.variance_factor * times**2  # positions' part of the cost is small
    return Uncertainty(position, point, _std(found.intrinsics), factor, why_not, found, of_all, is_of_shape)


def with_own_errors(
    variance_m2: Float[np.ndarray, "points 3"],
    block: Block,
    error_px: Float[np.ndarray, " observations"],
    std_px: float,
) -> Float[np.ndarray, "points 3"]:
    """Return the variances of points, where the part of their own observations follows these.

    - `variance_m2`: from observations that all have the sigma `std_px`.
    """
    own = np.minimum(own_variance(block, std_px), variance_m2)
    return variance_m2 + (own_factors(block, error_px)[:, None] - 1) * own


def own_variance(block: Block, std_px: float) -> Float[np.ndarray, "points 3"]:
    """Return the variances of points that their own observations account for, poses and cameras known, in m^2."""
    order = np.argsort(block.observation_point, kind="stable")
    variance = np.zeros((block.num_points, 3))
    counts = np.bincount(block.observation_point, minlength=block.num_points)

    def of_piece(points: slice, rows: slice) -> None:
        seen = order[rows]
        rays = make_rays(block, block.observation_image[seen], block.observation_xy_px[seen])
        distance = rays.errors_px(block.points_m[block.observation_point[seen]].T)[1]
        by_point = rays.by_point / (distance * std_px)
        starts = np.cumsum(counts[points]) - counts[points]
        normal = np.add.reduceat(np.einsum("cin,cjn->nij", by_point, by_point), starts, axis=0)
        normal[~np.isfinite(normal).all(axis=(1, 2))] = 0.0
        inverse = np.linalg.pinv(normal, hermitian=True)
        variance[points] = np.maximum(np.einsum("nii->ni", inverse), 0.0)

    on_all_cores(of_piece, *zip(*pieces(counts, _PIECE), strict=True))
    return variance


def own_factors(block: Block, error_px: Float[np.ndarray, " observations"]) -> Float[np.ndarray, " points"]:
    """Return the variance of each point's observations over that of all."""
    views = np.bincount(block.observation_point, minlength=block.num_points)
    total = np.bincount(block.observation_point, error_px**2, minlength=block.num_points)
    freedom = np.maximum(2 * views - 3, 1)
    use = (freedom >= _LEAST_FREEDOM) & (total > 0)
    if use.sum() < _LEAST_TRACKS:
        return np.ones(block.num_points)
    level = np.log(total[use]) - digamma(freedom[use] / 2) - np.log(2.0)
    between = level.var() - polygamma(1, freedom[use] / 2).mean()
    nu = _FREEDOM[np.argmin(np.abs(polygamma(1, _FREEDOM / 2) - between))]
    if nu == _FREEDOM[-1]:
        return np.ones(block.num_points)
    scale = np.exp(level.mean() + digamma(nu / 2) - np.log(nu / 2))
    variance = (nu * scale + total) / (nu + freedom - 2)
    return variance * freedom.sum() / np.sum(variance * freedom)


def _std(blocks: Float[np.ndarray, "n k k"]) -> Float[np.ndarray, "n k"]:
    return np.sqrt(np.maximum(np.einsum("nii->ni", blocks), 0.0))
