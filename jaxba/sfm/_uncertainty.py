"""Sigmas of an adjusted block, from the covariance of its last solve, or why there are none.

The sigmas of observations are enlarged to how far errors really scatter (see `_spread.py`), so the covariance is not
scaled by the variance factor once more; a point's own errors count in its sigma.

Positions are known to the mean of all GNSS positions; an offset that these have in common, metres for a single
receiver, is not in their sigmas, nor here.
"""

import dataclasses

import numpy as np
from jaxtyping import Float

from jaxba._errors import JaxbaError
from jaxba.ba import Covariance, covariance
from jaxba.scene import Reference
from jaxba.sfm._adjust import Adjusted
from jaxba.sfm._problem import used_positions
from jaxba.sfm._spread import spread, with_own_errors


@dataclasses.dataclass(frozen=True)
class Uncertainty:
    """Sigmas, NaN where they were not computed; `why_not` says why.

    - `position_std_m`, `point_std_m`: world. `intrinsics_std`: in the parameters' units, 0 for what is fixed.
    - `variance_factor`: twice the cost over the redundancy, by the sigmas that weighed observations; NaN likewise.
    """

    position_std_m: Float[np.ndarray, "images 3"]
    point_std_m: Float[np.ndarray, "points 3"]
    intrinsics_std: Float[np.ndarray, "cameras parameters"]
    variance_factor: float
    why_not: str | None = None
    covariance: Covariance | None = None


def uncertainty(adjusted: Adjusted, reference: Reference) -> Uncertainty:
    """Return the sigmas of an adjusted block; NaN along an axis in which no position is measured."""
    block = adjusted.block
    position, point = np.full((block.num_images, 3), np.nan), np.full((block.num_points, 3), np.nan)
    times = spread(adjusted)
    observations = adjusted.problem.observations
    own = adjusted.block.num_observations
    std_px = np.concatenate([observations.std_px[:own] * times, observations.std_px[own:]])  # those of marks stand
    observations = dataclasses.replace(observations, std_px=std_px)
    problem = dataclasses.replace(adjusted.problem, observations=observations)
    loss = dataclasses.replace(adjusted.loss, f_scale=adjusted.loss.f_scale / times)
    try:
        found = covariance(problem, loss=loss)
    except JaxbaError as error:
        unknown = np.full(block.camera_parameters.shape, np.nan)
        return Uncertainty(position, point, unknown, np.nan, f"Sigmas were not computed. {error}")
    why_not = None
    if block.is_georeferenced:
        position = _std(found.centers)
        variance = np.maximum(np.einsum("nii->ni", found.points[: block.num_points]), 0.0)
        point = np.sqrt(with_own_errors(variance, block, adjusted.error_px, times * adjusted.std_px))
        index = block.image_index[used_positions(block, reference)]
        nowhere = ~np.isfinite(reference.std_m[index]).any(axis=0)
        if adjusted.control is not None:
            nowhere &= ~adjusted.control.determined
        position[:, nowhere], point[:, nowhere] = np.nan, np.nan
    else:
        why_not = (
            "Sigmas of positions and points were not computed: without measured positions the block has no place and "
            "no scale to give them in. Add GNSS positions or ground control."
        )
    factor = found.variance_factor * times**2  # positions' part of the cost is small
    return Uncertainty(position, point, _std(found.intrinsics), factor, why_not, found)


def _std(blocks: Float[np.ndarray, "n k k"]) -> Float[np.ndarray, "n k"]:
    return np.sqrt(np.maximum(np.einsum("nii->ni", blocks), 0.0))
