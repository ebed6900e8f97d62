"""Stage adjust: the bundle adjustment in rounds, with rejection, pruning of edges and triangulation anew."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from jaxba.pipeline._parameters import Parameters, parameter
from jaxba.scene import Block, Photo, Reference, Tracks, ViewGraph


@dataclass(frozen=True, kw_only=True)
class Inputs:
    """- `photos`, `reference`, `view_graph`, `tracks`, `block`: of the stages before."""

    photos: tuple[Photo, ...]
    reference: Reference
    view_graph: ViewGraph
    tracks: Tracks
    block: Block


@dataclass(frozen=True, kw_only=True)
class Params(Parameters):
    """What the user may set."""

    loss: str = parameter(
        "huber",
        choices=("linear", "soft_l1", "huber", "cauchy", "arctan", "tukey", "geman_mcclure"),
        help="robust loss of the reprojections",
    )
    f_scale: float = parameter(1.0, low=0.5, high=5, help="where the loss turns robust, px")
    max_nfev: int = parameter(500, low=100, high=5000, help="the most steps of a solve")
    ftol: float = parameter(1e-8, low=1e-12, high=1e-6, help="stop when the cost changes by less than this share")
    xtol: float = parameter(1e-8, low=1e-12, high=1e-6, help="stop when the unknowns change by less than this share")
    track_threshold: float = parameter(2.0, low=1, high=4, help="acceptance of a triangulated track, px")
    mad_factor: float = parameter(2.5, low=2, high=5, help="reject over median + factor x MAD")
    edge_median_limit: float = parameter(3.0, low=2, high=6, help="edges of the view graph over it are pruned, px")


@dataclass(frozen=True, kw_only=True, eq=False)
class Outputs:
    """The adjusted block and its errors.

    - `block`: what was adjusted; its observations are those used.
    - `error_px`: reprojection error of each observation. `point_error_px`: mean over each point's observations.
    - `position_std_m`: sigma of each registered image's position, east, north, up; NaN where it was not computed.
    - `point_std_m`: sigma of each point; NaN likewise.
    - `intrinsics_std`: sigma of each intrinsic.
    - `median_px`, `inlier_rate`, `variance_factor`, `num_rejected`, `rounds`: figures of the adjustment.
    - `gnss_rms_m`: RMS of adjusted minus measured position an axis over the `num_gnss` positions that are no outliers.
    - `findings`: what a surveyor should know, in sentences: ambiguities, contradictions, bounds reached.
    """

    block: Block
    error_px: Float[np.ndarray, " observations"]
    point_error_px: Float[np.ndarray, " points"]
    position_std_m: Float[np.ndarray, "images 3"]
    point_std_m: Float[np.ndarray, "points 3"]
    intrinsics_std: Float[np.ndarray, "cameras parameters"]
    gnss_residual_m: Float[np.ndarray, "images 3"]
    gnss_rms_m: tuple[float, float, float] | None
    num_gnss: int
    median_px: float
    inlier_rate: float
    variance_factor: float
    num_rejected: int
    rounds: int
    findings: tuple[str, ...] = ()


def run(inputs: Inputs, params: Params) -> Outputs:
    """Adjust the block."""
    raise NotImplementedError
