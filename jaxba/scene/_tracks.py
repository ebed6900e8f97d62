"""Tracks: features of several images that show one point, and the groups of images that tracks join."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int, UInt8


@dataclass(frozen=True, kw_only=True, eq=False)
class Tracks:
    """Tracks as rows of observations, sorted by track, then by image; no track has two features of one image.

    - `track_index`, `image_index`, `feature_index`, `xy_px`: one row an observation; tracks are numbered from 0.
    - `rgb`: mean colour of each track.
    - `components`: image indices of each connected component of the view graph, the largest first; images without an
      edge are components of one.
    - `num_conflicts`: features left out because their track would have had two features of one image.
    """

    track_index: Int[np.ndarray, " observations"]
    image_index: Int[np.ndarray, " observations"]
    feature_index: Int[np.ndarray, " observations"]
    xy_px: Float[np.ndarray, "observations 2"]
    rgb: UInt8[np.ndarray, "tracks 3"]
    components: tuple[tuple[int, ...], ...]
    num_conflicts: int = 0

    @property
    def num_tracks(self) -> int:
        return self.rgb.shape[0]

    @property
    def num_observations(self) -> int:
        return self.track_index.shape[0]
