"""Matches of a pair whose geometry is known: each feature is looked for near its place in the other image.

A search among all features passes over a match whose descriptor has a double anywhere in the other image, on another
tree or roof. Verified matches foretell the place: a homography through them, off by no more than the relief shows, and
the epipolar line. A match is the nearest on the line; for the ratio test all features compete that are near the place,
those off the line, too, or a line with few features would let anything pass. Products are 3% to 10% of those of all
features: rows and columns are compared by cells of the second image, each with its eight neighbours.

A feature may be alone in its place, where the ratio test asks nothing of it: a match's descriptors must also be nearer
to each other than half of what such are apart that have nothing in common.
"""

from collections.abc import Iterator

import numpy as np
from jaxtyping import Float, Int

from jaxba.vision._nearest import Descriptors, one_of_a_position

_BLOCK = 256
_CELLS = 12  # of the longer side
_RELIEF, _QUANTILE = 1.5, 0.98  # times that of verified matches
_FARTHEST = 0.5
_NOTHING = np.float32(-1e9)  # product of what does not compete


def guided_matches(
    first: Descriptors,
    second: Descriptors,
    first_px: Float[np.ndarray, "rows 2"],
    second_px: Float[np.ndarray, "columns 2"],
    size_px: tuple[int, int],
    verified: Int[np.ndarray, "matches 2"],
    fundamental: Float[np.ndarray, "3 3"],
    *,
    line_px: float,
    ratio: float,
) -> tuple[Int[np.ndarray, "found 2"], Float[np.ndarray, " found"]]:
    """Return matches and how distinct each is, as `match_descriptors` does.

    - `size_px`: width and height of the second image. `verified`: matches that are right, four or more.
    - `fundamental`: `y^T F x = 0`; NaN where only the homography is known. `line_px`: how far from its line a match is.
    """
    import cv2

    x, y = (np.asarray(xy_px, np.float64) for xy_px in (first_px, second_px))
    known_x, known_y = x[verified[:, 0]], y[verified[:, 1]]
    homography, _ = cv2.findHomography(known_x, known_y, 0)
    nothing = np.zeros((0, 2), np.int64), np.zeros(0)
    if homography is None:
        return nothing
    ahead = x @ homography[2, :2] + homography[2, 2]
    with np.errstate(divide="ignore", invalid="ignore"):
        foretold = (x @ homography[:2, :2].T + homography[:2, 2]) / ahead[:, None]
    off_px = np.linalg.norm(foretold[verified[:, 0]] - known_y, axis=1)
    reach_px = max(max(size_px) / _CELLS, _RELIEF * float(np.quantile(off_px, _QUANTILE)))
    if not np.isfinite(reach_px):
        return nothing
    near = np.all((foretold > -reach_px) & (foretold < np.array(size_px) + reach_px), axis=1)
    near &= ahead * np.median(ahead[verified[:, 0]]) > 0
    lines = None
    if np.isfinite(fundamental).all():
        lines = x @ fundamental[:, :2].T + fundamental[:, 2]
        lines = (lines / np.maximum(np.linalg.norm(lines[:, :2], axis=1, keepdims=True), 1e-300)).astype(np.float32)

    index = np.zeros(len(x), np.int64)
    best, next_best = np.full((2, len(x)), _NOTHING)
    column_best = np.full(len(y), _NOTHING)
    for rows, columns in _neighbourhoods(foretold, np.flatnonzero(near), y, reach_px):
        product = first.values[rows] @ second.values[columns].T
        on_line = product
        if lines is not None:
            distance = lines[rows, :2] @ y[columns].astype(np.float32).T
            distance += lines[rows, 2:]
            on_line = np.where(np.abs(distance, out=distance) > line_px, _NOTHING, product)
        at = np.arange(len(rows)), on_line.argmax(axis=1)
        index[rows], best[rows] = columns[at[1]], on_line[at]
        column_best[columns] = np.maximum(column_best[columns], on_line.max(axis=0))
        product[at] = _NOTHING
        next_best[rows] = product.max(axis=1)

    farthest = _FARTHEST * float(first.distances(np.zeros(1))[0])
    nearest, following = first.distances(best), first.distances(next_best)
    is_near = np.linalg.norm(foretold - y[index], axis=1) < reach_px
    rows = np.flatnonzero(near & is_near & (best == column_best[index]))
    rows = rows[(nearest[rows] < ratio * following[rows]) & (nearest[rows] < farthest)]
    rows = rows[np.sort(np.unique(index[rows], return_index=True)[1])]  # columns of equal products
    return one_of_a_position(first, second, np.stack([rows, index[rows]], axis=1), 1 - nearest[rows] / following[rows])


def _neighbourhoods(
    foretold: Float[np.ndarray, "rows 2"],
    near: Int[np.ndarray, " near"],
    second_px: Float[np.ndarray, "columns 2"],
    cell_px: float,
) -> Iterator[tuple[Int[np.ndarray, " some"], Int[np.ndarray, " others"]]]:
    """Yield rows foretold to lie in one cell, and the columns that lie in it or in a neighbour of it."""
    # a ring of empty cells about those of the columns, so that each has eight neighbours
    of_column = np.floor(second_px / cell_px).astype(np.int64)
    low, high = of_column.min(axis=0) - 1, of_column.max(axis=0) + 1
    width = int(high[0] - low[0]) + 1

    def number(cells: Int[np.ndarray, "n 2"]) -> Int[np.ndarray, " n"]:
        return (cells[:, 1] - low[1]) * width + cells[:, 0] - low[0]

    cells = np.floor(foretold[near] / cell_px).astype(np.int64)
    inside = np.all((cells >= low) & (cells <= high), axis=1)
    near, cells = near[inside], cells[inside]
    order, column_order = np.argsort(number(cells), kind="stable"), np.argsort(number(of_column), kind="stable")
    near, of_row, of_column = near[order], number(cells)[order], number(of_column)[column_order]
    found, starts = np.unique(of_row, return_index=True)
    for cell, rows in zip(found.tolist(), np.split(near, starts[1:]), strict=False):  # a part also where there are none
        spans = [np.searchsorted(of_column, [cell + step - 1, cell + step + 2]) for step in (-width, 0, width)]
        columns = np.concatenate([column_order[start:end] for start, end in spans])
        if len(columns):
            for start in range(0, len(rows), _BLOCK):
                yield rows[start : start + _BLOCK], columns
