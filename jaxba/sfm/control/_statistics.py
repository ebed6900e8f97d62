"""Statistics of control points where mistakes have been explained: tests, reliability, residuals without the point."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from jaxba.ba import NONCENTRALITY
from jaxba.sfm.control._explained import Explained
from jaxba.sfm.control._misclosure import UNSEEN, Misclosure, Mistake, Model


@dataclass(frozen=True, eq=False)
class Tested:
    """Statistics of control points, NaN where a coordinate was not surveyed.

    - `test`: each coordinate against all others that stand, over its sigma (Baarda's w).
    - `without_m`, `without_std_m`: where all others place a point, minus the survey, and the sigma of that: the
      residual of an adjustment without the point.
    - `detectable_m`: the smallest error that a test of 0.1% finds in four of five cases; infinite where nothing checks
      the coordinate. `reach_m`: by how much such an error moves the point.
    - `shift_m`: what positions are off in common.
    """

    test: Float[np.ndarray, "points 3"]
    without_m: Float[np.ndarray, "points 3"]
    without_std_m: Float[np.ndarray, "points 3"]
    detectable_m: Float[np.ndarray, "points 3"]
    reach_m: Float[np.ndarray, "points 3"]
    shift_m: Float[np.ndarray, "3"]

    @staticmethod
    def nothing(num_points: int) -> "Tested":
        """Return the statistics of points that could not be tested."""
        unknown = np.full((num_points, 3), np.nan)
        return Tested(unknown, unknown, unknown, unknown, unknown, np.zeros(3))


def control_statistics(given: Misclosure, explained: Explained) -> Tested:
    """Return the statistics of every coordinate, where `explained` stands."""
    model = Model(given, explained.scale)
    apart = [m for m in explained.mistakes if m.kind == "common"]
    apart += _apart(explained, model)
    placed = model.of_block + (model.common * given.common_std_m**2) @ model.common.T  # of points, without the survey
    shape = given.off_m.shape
    test, without, spread, detectable, reach = (np.full(shape, np.nan) for _ in range(5))
    for point in range(len(given.off_m)):
        axes = np.flatnonzero(model.known[point])
        for axis in axes:
            others = [m for m in apart if (m.points, m.axes) != ((point,), (int(axis),))]
            left, row = model.left(others), model.row[point, axis]
            if left[row, row] < UNSEEN * model.weight[row, row]:
                detectable[point, axis] = reach[point, axis] = np.inf
                continue
            test[point, axis] = left[row] @ model.off / np.sqrt(left[row, row])
            detectable[point, axis] = NONCENTRALITY / np.sqrt(left[row, row])
            reach[point, axis] = placed[row] @ left[:, row] * detectable[point, axis]
        rows = model.row[point, axes]
        others = [m for m in apart if m.points != (point,)]
        left = model.left(others)
        square = left[np.ix_(rows, rows)]
        if len(rows) and np.linalg.eigvalsh(square)[0] > UNSEEN * np.linalg.eigvalsh(square)[-1]:
            inverse = np.linalg.inv(square)
            without[point, axes] = inverse @ left[rows] @ model.off
            spread[point, axes] = np.sqrt(np.diagonal(inverse))
    return Tested(test, without, spread, detectable, reach, _shift(given, explained, model))


def _apart(explained: Explained, model: Model) -> list[Mistake]:
    """Return what is set aside, coordinate by coordinate."""
    rows = zip(*np.nonzero(explained.wrong & model.known), strict=True)
    return [Mistake("point", (int(point),), (int(axis),)) for point, axis in rows]


def _shift(given: Misclosure, explained: Explained, model: Model) -> Float[np.ndarray, "3"]:
    """Return what positions are off in common: free where that is a mistake, by its sigma elsewhere."""
    moves = np.flatnonzero(model.is_movable)
    shift = np.zeros(3)
    if not len(moves):
        return shift
    columns = model.common[:, moves]
    free = explained.is_shifted[moves]
    apart = _apart(explained, model)
    # out of the weights with what is in common: W0 = (Q - G s^2 G^T)^-1 = W + W G (s^-2 - G^T W G)^-1 G^T W
    left = model.left(apart)
    by = left @ columns
    inner = np.diag(given.common_std_m[moves] ** -2.0)
    without = left + by @ np.linalg.pinv(inner - columns.T @ by) @ by.T
    normal = columns.T @ without @ columns + np.diag(np.where(free, 0.0, np.diagonal(inner)))
    shift[moves] = np.linalg.lstsq(normal, columns.T @ without @ model.off, rcond=None)[0]
    return shift
