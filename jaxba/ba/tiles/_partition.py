"""Partition: a block cut into problems that overlap, each to be adjusted on its own."""

import dataclasses

import numpy as np
from jaxtyping import Bool, Int

from jaxba.ba._problem import Problem


@dataclasses.dataclass(frozen=True)
class BlockTile:
    """A tile of a block, a problem of its own.

    - `images`, `points`: the numbers, in the block, of the tile's images and points, ascending.
    - `own`: which of its images are the tile's own; the others overlap into it. Each image of the block is the own one
      of exactly one tile.
    """

    problem: Problem
    images: Int[np.ndarray, " images"]
    points: Int[np.ndarray, " points"]
    own: Bool[np.ndarray, " images"]
