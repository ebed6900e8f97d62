"""Flight lines: runs of consecutive images along which the flight keeps its heading, and lines put together to parts.

A line ends where the next image lies in another direction than the line has come along lately: at the turn, whether or
not photos were taken in it. Images in the turn are short lines of their own. An orbit, which turns a little at each
image, is one line.
"""

import numpy as np
from jaxtyping import Float, Int

_TURN = np.cos(np.radians(50))  # attitude and wind move a heading by some degrees, a turn by 90
_LATELY = 3  # steps that tell a line's heading
_STANDING = 0.2  # of the median step: shorter ones have no heading


def flight_lines(centers: Float[np.ndarray, "images 3"]) -> Int[np.ndarray, " lines"]:
    """Return where lines begin among the images, which stand in the order of the flight.

    >>> there, back = np.arange(5.0), np.arange(5.0)[::-1]
    >>> flight_lines(np.column_stack([np.repeat([0, 1.0], 5), np.append(there, back), np.zeros(10)])).tolist()
    [0, 5]
    """
    steps = np.linalg.norm(np.diff(centers, axis=0), axis=1)
    shortest = _STANDING * np.median(steps) if len(steps) else 0.0

    def turns(before: Float[np.ndarray, "3"], after: Float[np.ndarray, "3"]) -> bool:
        lengths = np.linalg.norm(before), np.linalg.norm(after)
        return bool(min(lengths) > shortest and before @ after < _TURN * lengths[0] * lengths[1])

    starts = [0]
    for image in range(1, len(centers)):
        heading = centers[image - 1] - centers[max(starts[-1], image - 1 - _LATELY)]
        step = centers[image] - centers[image - 1]
        if turns(heading, step):
            goes_on = image + 1 < len(centers) and not turns(step, centers[image + 1] - centers[image])
            of_turn = image - starts[-1] == 2 and goes_on  # one image in the turn, and the first of the next line
            starts.append(image - 1 if of_turn else image)
    return np.array(starts, np.int32)


def along_lines(
    centers: Float[np.ndarray, "images 3"], sizes: Float[np.ndarray, " images"], most: float
) -> Int[np.ndarray, " images"]:
    """Return the part of each image, counted from 0: of consecutive lines, so many as a part of `most` may hold.

    A line that is larger is cut into like pieces.
    """
    units: list[Int[np.ndarray, " unit"]] = []
    for line in np.split(np.arange(len(centers)), flight_lines(centers)[1:]):
        pieces = packed(sizes[line], most)
        units += [line[pieces == piece] for piece in range(pieces[-1] + 1)]
    part_of_unit = packed(np.array([sizes[unit].sum() for unit in units]), most)
    return np.repeat(part_of_unit, [len(unit) for unit in units])


def packed(sizes: Float[np.ndarray, " lines"], most: float) -> Int[np.ndarray, " lines"]:
    """Return the part of each line: so few parts of at most `most` as consecutive lines allow, of like sizes.

    >>> packed(np.array([4.0, 4, 4, 4, 4]), 13.0).tolist(), packed(np.array([4.0, 4, 4, 4]), 13.0).tolist()
    ([0, 0, 1, 1, 1], [0, 0, 1, 1])
    """
    fewest = _filled(sizes, most)
    reached, num_parts = np.cumsum(sizes), fewest[-1] + 1
    wanted = reached[-1] * np.arange(1, num_parts) / num_parts
    ends = np.argmin(np.abs(reached - wanted[:, None]), axis=1)  # the last line of each part but the last one
    like = np.searchsorted(ends, np.arange(len(sizes))).astype(np.int32)
    of_parts = np.bincount(like, sizes, num_parts)
    return like if of_parts.min() > 0 and of_parts.max() <= most else fewest


def _filled(sizes: Float[np.ndarray, " lines"], most: float) -> Int[np.ndarray, " lines"]:
    """Return the part of each line where each part takes as many lines as it may hold."""
    parts, part, held = np.zeros(len(sizes), np.int32), 0, 0.0
    for line, size in enumerate(sizes):
        if held and held + size > most:
            part, held = part + 1, 0.0
        held += size
        parts[line] = part
    return parts
