"""Measured positions of a block: which are used, how they scatter, and what they have in common."""

from collections.abc import Callable
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.special import chdtrc, stdtrit

from jaxba.scene import Block, Reference

PLAIN_M = 1.0
"""Sigma of a position beyond which it is that of a single receiver."""
LEAST_POSITIONS = 3
"""Positions that place a block."""
OUTLIER = 3.29
"""Sigmas that one of a thousand normal errors exceeds by chance."""
_FREEDOM = 0.45  # times n: of Student's t that the residuals of n values over their robust sigma follow (simulated)
_LEAST_TO_SCATTER = 6  # positions
_TAKEN = 2, 2, 3  # degrees of freedom of a similarity: shift, scale and heading across, shift and tilts up
_LEAST_SCATTER = 0.1  # of a plain receiver's sigma, most of which its positions have in common
BY_CHANCE = 1e-3
"""Level of tests."""
_LEAST_COMMON = 0.1  # of a good position's sigma: what all of them have in common, unless control tells it


def used_positions(block: Block, reference: Reference) -> Bool[np.ndarray, " images"]:
    """Return which of the block's images have a position that is a prior."""
    index = block.image_index
    measured = np.isfinite(reference.xyz_m[index]) & np.isfinite(reference.std_m[index])
    return reference.is_used[index] & measured.any(axis=1) & block.is_georeferenced


def flights_of(
    block: Block, reference: Reference
) -> tuple[Int[np.ndarray, " flights"], Int[np.ndarray, " positions"]] | None:
    """Return the numbers of the flights of positions that are priors, and which of these each position has.

    None where flights are not told apart, where there is but one, and of too few positions.
    """
    if reference.flight is None:
        return None
    found = reference.flight[block.image_index[used_positions(block, reference)]]
    numbers, index = np.unique(found, return_inverse=True)
    return None if len(numbers) < 2 or len(found) < LEAST_POSITIONS else (numbers, index)


def common_std(block: Block, reference: Reference) -> Float[np.ndarray, "3"] | None:
    """Return the sigma an axis of what positions have in common; None of too few positions, or of flights' own offsets.

    Positions of a single receiver (a sigma over `PLAIN_M`) have as large an offset in common as they scatter. Better
    ones are taken at their word, and hold the height and with it the focal length: over flat ground, seen straight
    down, an offset of their heights looks like another focal length and does not show.
    """
    index = block.image_index[used_positions(block, reference)]
    if len(index) < LEAST_POSITIONS or flights_of(block, reference) is not None:
        return None
    std_m = np.median(reference.std_m[index], axis=0)
    return np.where(np.isfinite(std_m), np.where(std_m > PLAIN_M, std_m, _LEAST_COMMON * std_m), 0.0)


def robust_limit(count: int) -> float:
    """Return how many robust sigmas a residual of as many values exceeds by chance in one of a thousand."""
    return float(max(-stdtrit(max(_FREEDOM * count, 1.0), 5e-4), OUTLIER))


def position_scale(block: Block, reference: Reference) -> Float[np.ndarray, "3"]:
    """Return what the sigmas of positions are multiplied by, an axis, from how the positions scatter about the block.

    Stated sigmas stand, unless the residuals about their mean contradict them (chi-squared, 0.1%); then they are what
    the residuals show. Sigmas of more than `PLAIN_M` are those of a single receiver, mostly an offset that all
    positions of a flight have in common; their scatter alone tells their weight against each other, down to a tenth.
    Outliers do not count, and under six positions it is 1. A similarity has fitted the block to the positions, which
    takes `_TAKEN` degrees of freedom from the axes. A sigma that f degrees of freedom tell is itself uncertain: what
    follows from it errs as Student's t does, whose sigma is sqrt(f / (f - 2)) times as large.
    """
    used = used_positions(block, reference)
    index = block.image_index[used]
    scale = np.ones(3)
    flights = flights_of(block, reference)
    flight = np.zeros(len(index), int) if flights is None else flights[1]
    for axis in range(3):
        std = reference.std_m[index, axis]
        known = np.isfinite(std)
        if known.sum() < _LEAST_TO_SCATTER:
            continue
        residual = ((block.centers_m[used, axis] - reference.xyz_m[index, axis]) / std)[known]
        of_flight = flight[known]
        residual = residual - by_flight(np.median, residual, of_flight)
        robust = 1.4826 * np.median(np.abs(residual))
        is_kept = np.abs(residual) <= robust_limit(len(residual)) * robust
        kept, of_flight = residual[is_kept], of_flight[is_kept]
        freedom = len(kept) - _TAKEN[axis] - (len(np.unique(of_flight)) - 1)
        if freedom <= 2:
            continue
        total = float(np.sum((kept - by_flight(np.mean, kept, of_flight)) ** 2))
        shown = np.sqrt(total / (freedom - 2))
        if np.median(std[known]) > PLAIN_M:
            scale[axis] = max(shown, _LEAST_SCATTER)
        elif shown > 1 and chdtrc(freedom, total) < BY_CHANCE:
            scale[axis] = shown
    return scale


def by_flight(
    average: Callable[[np.ndarray], Any], values: Float[np.ndarray, " n"], flight: Int[np.ndarray, " n"]
) -> Float[np.ndarray, " n"]:
    """Return, for each value, the average of those of its flight."""
    found = np.zeros(len(values))
    for number in np.unique(flight):
        found[flight == number] = average(values[flight == number])
    return found


def median_offset(block: Block, reference: Reference) -> Float[np.ndarray, "3"]:
    """Return the median of block minus measured position, an axis; NaN where none is measured."""
    index = block.image_index
    known = reference.is_used[index, None] & np.isfinite(reference.std_m[index]) & np.isfinite(reference.xyz_m[index])
    off = block.centers_m - reference.xyz_m[index]
    return np.array([np.median(column[k]) if k.any() else np.nan for column, k in zip(off.T, known.T, strict=True)])
