"""Stage match: verified matches of one photo with its candidate partners; the runner calls it once a photo, in workers."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from jaxba.pipeline._parameters import Parameters, parameter
from jaxba.scene import Features, Photo, Reference, ViewGraph


@dataclass(frozen=True, kw_only=True, eq=False)
class Inputs:
    """One photo and those of its candidate partners whose index is larger.

    - `image`: its index. `partners`: theirs, rising. `overlap`: of each pair, NaN where unknown.
    - `photos`: all photos. `reference`: for the planar two-fold ambiguity.
    - `features`: by image index, opened on access; a partner whose features failed is not among `partners`.
    """

    image: int
    partners: Int[np.ndarray, " partners"]
    overlap: Float[np.ndarray, " partners"]
    photos: tuple[Photo, ...]
    reference: Reference
    features: Mapping[int, Features]


@dataclass(frozen=True, kw_only=True)
class Params(Parameters):
    """What the user may set."""

    ratio: float = parameter(0.75, low=0.6, high=0.85, help="nearest over second nearest descriptor distance")
    ransac_threshold: float | None = parameter(
        None, low=0.5, high=5, help="px; none: 2 over 85% overlap, 3 up to 20 MP, 4 at width 3840 and more"
    )
    confidence: float = parameter(0.99, low=0.9, high=0.9999, help="of the sample consensus")
    min_inliers: int = parameter(12, low=8, high=30, help="fewer verified matches make no edge")
    min_good: int = parameter(30, low=8, high=100, help="verified matches of a good pair")
    min_inlier_ratio: float = parameter(0.35, low=0.2, high=0.8, help="verified over putative matches of a good pair")


@dataclass(frozen=True, kw_only=True)
class Outputs:
    """- `view_graph`: the photo's pairs."""

    view_graph: ViewGraph


def run(inputs: Inputs, params: Params) -> Outputs:
    """Match one photo with its partners and verify the matches."""
    raise NotImplementedError
