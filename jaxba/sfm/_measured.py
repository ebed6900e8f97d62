"""Measured positions of a block: which are used, and what they have in common."""

import numpy as np
from jaxtyping import Bool, Float

from jaxba.scene import Block, Reference

PLAIN_M = 1.0
"""Sigma of a position beyond which it is that of a single receiver."""
LEAST_POSITIONS = 3
"""Positions that place a block."""
_LEAST_COMMON = 0.1  # of a good position's sigma: what all of them have in common, unless control tells it


def used_positions(block: Block, reference: Reference) -> Bool[np.ndarray, " images"]:
    """Return which of the block's images have a position that is a prior."""
    index = block.image_index
    measured = np.isfinite(reference.xyz_m[index]) & np.isfinite(reference.std_m[index])
    return reference.is_used[index] & measured.any(axis=1) & block.is_georeferenced


def common_std(block: Block, reference: Reference) -> Float[np.ndarray, "3"] | None:
    """Return the sigma an axis of what positions have in common; None of too few positions.

    Positions of a single receiver (a sigma over `PLAIN_M`) have as large an offset in common as they scatter. Better
    ones are taken at their word, and hold the height and with it the focal length: over flat ground, seen straight
    down, an offset of their heights looks like another focal length and does not show.
    """
    index = block.image_index[used_positions(block, reference)]
    if len(index) < LEAST_POSITIONS:
        return None
    std_m = np.median(reference.std_m[index], axis=0)
    return np.where(np.isfinite(std_m), np.where(std_m > PLAIN_M, std_m, _LEAST_COMMON * std_m), 0.0)


def median_offset(block: Block, reference: Reference) -> Float[np.ndarray, "3"]:
    """Return the median of block minus measured position, an axis; NaN where none is measured."""
    index = block.image_index
    known = reference.is_used[index, None] & np.isfinite(reference.std_m[index]) & np.isfinite(reference.xyz_m[index])
    off = block.centers_m - reference.xyz_m[index]
    return np.array([np.median(column[k]) if k.any() else np.nan for column, k in zip(off.T, known.T, strict=True)])
