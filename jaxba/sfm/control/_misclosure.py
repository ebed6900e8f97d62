"""Misclosures of control with their covariance, and the columns that mistakes add to them.

The formulas stand in `_explained.py`, which looks for the mistakes.
"""

from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np
from jaxtyping import Float
from scipy.special import chdtri

from jaxba.sfm._measured import BY_CHANCE

UNSEEN = 1e-6
"""Of a column's own weight, that is left where others take it up."""
_GROUPS = ((2,), (0, 1))  # axes that a mistake is in: height, across


@dataclass(frozen=True, eq=False)
class Misclosure:
    """What a block that control does not hold says of its control points.

    - `off_m`: that minus the survey, NaN where a coordinate was not surveyed. `xyz_m`, `std_m`: the survey.
    - `covariance_m2`: of what the block says, all points together; positions taken to have nothing in common.
    - `common_std_m`: sigma an axis of what positions have in common, which moves all points alike; 0 where none does.
    """

    off_m: Float[np.ndarray, "points 3"]
    xyz_m: Float[np.ndarray, "points 3"]
    std_m: Float[np.ndarray, "points 3"]
    covariance_m2: Float[np.ndarray, "points 3 points 3"]
    common_std_m: Float[np.ndarray, "3"]


@dataclass(frozen=True)
class Mistake:
    """One explanation of a misclosure.

    - `kind`: `point`, `common` or `swapped`. `points`: whose; none of `common`. `axes`: in which.
    - `gain`: what the misclosure's square becomes smaller by. `over`: by how much that exceeds its test's quantile.
    - `rivals`: other mistakes that explain it as well.
    """

    kind: str
    points: tuple[int, ...]
    axes: tuple[int, ...]
    gain: float = 0.0
    over: float = 0.0
    rivals: tuple["Mistake", ...] = ()

    @property
    def freedom(self) -> int:
        """Degrees of freedom that it counts for."""
        return 3 if self.kind == "swapped" else len(self.axes)

    @property
    def culprit(self) -> tuple[str, tuple[int, ...]]:
        """Who made it, in whatever axes."""
        return self.kind, self.points


class Model:
    """A misclosure as rows and weights, with the columns of mistakes."""

    def __init__(self, given: Misclosure, scale: tuple[float, float] = (1.0, 1.0)) -> None:
        self.scale = scale
        self.known = np.isfinite(given.off_m) & np.isfinite(given.std_m)
        self.row = np.full(given.off_m.shape, -1)
        self.row[self.known] = np.arange(self.known.sum())
        flat = self.known.ravel()
        size = len(flat)
        self.common = np.tile(np.eye(3), (len(given.off_m), 1))[flat]
        self.of_block = given.covariance_m2.reshape(size, size)[np.ix_(flat, flat)]
        std_m = (given.std_m * np.array(scale)[[0, 0, 1]])[self.known]
        covariance = self.of_block + (self.common * given.common_std_m**2) @ self.common.T + np.diag(std_m**2)
        unit = np.sqrt(np.diagonal(covariance))
        values, vectors = np.linalg.eigh(covariance / np.outer(unit, unit))
        values = np.maximum(values, 1e-14 * values[-1])
        half = vectors / np.sqrt(values) / unit[:, None]
        self.weight = half @ half.T
        self.log_size = float(np.sum(np.log(values)) + 2 * np.sum(np.log(unit)))
        self.off = given.off_m[self.known]
        self.xyz_m = given.xyz_m
        self.is_movable = (given.common_std_m > 0) & self.known.any(axis=0)

    def columns(self, mistakes: list[Mistake]) -> Float[np.ndarray, "rows columns"]:
        """Return the columns that mistakes add, none of labels exchanged."""
        parts = [np.zeros((len(self.off), 0))]
        taken: set[int] = set()
        for mistake in mistakes:
            if mistake.kind == "common":
                parts.append(self.common[:, list(mistake.axes)])
            elif mistake.kind == "point":
                rows = self.row[mistake.points[0], list(mistake.axes)]
                rows = [row for row in rows if row >= 0 and row not in taken]
                taken.update(rows)
                parts.append(np.eye(len(self.off))[:, rows])
        return np.concatenate(parts, axis=1)

    def left(self, mistakes: list[Mistake]) -> Float[np.ndarray, "rows rows"]:
        """Return R: the weights of what mistakes do not explain."""
        columns = self.columns(mistakes)
        if not columns.shape[1]:
            return self.weight
        by = self.weight @ columns
        return self.weight - by @ np.linalg.pinv(columns.T @ by, rcond=1e-12, hermitian=True) @ by.T

    def misclosure(self, mistakes: list[Mistake]) -> Float[np.ndarray, " rows"]:
        """Return m, with labels exchanged where mistakes say so."""
        off = self.off.copy()
        for mistake in mistakes:
            if mistake.kind == "swapped":
                off += self.exchange(*mistake.points)
        return off

    def exchange(self, first: int, second: int) -> Float[np.ndarray, " rows"]:
        """Return what exchanging two labels changes m by."""
        change = np.zeros(len(self.off))
        by_m = self.xyz_m[first] - self.xyz_m[second]
        rows = self.row[first], self.row[second]
        change[rows[0][rows[0] >= 0]] = by_m[rows[0] >= 0]
        change[rows[1][rows[1] >= 0]] = -by_m[rows[1] >= 0]
        return change

    def seen(self, matrix: Float[np.ndarray, "rows rows"], mistake: Mistake) -> Float[np.ndarray, "q q"]:
        """Return `B^T M B`, B being the columns of a mistake."""
        if mistake.kind == "common":
            columns = self.common[:, list(mistake.axes)]
            return columns.T @ matrix @ columns
        rows = self.row[mistake.points[0], list(mistake.axes)]
        return matrix[np.ix_(rows, rows)]

    def gain(self, mistake: Mistake, left: np.ndarray, left_off: np.ndarray) -> float | None:
        """Return the test of a further mistake from R and R m; None where nothing is left to tell it by."""
        own = np.sqrt(np.diagonal(self.seen(self.weight, mistake)))
        square = self.seen(left, mistake) / np.outer(own, own)
        if np.linalg.eigvalsh(square)[0] < UNSEEN:
            return None
        axes = list(mistake.axes)
        is_common = mistake.kind == "common"
        right = self.common[:, axes].T @ left_off if is_common else left_off[self.row[mistake.points[0], axes]]
        right = right / own
        return float(right @ np.linalg.solve(square, right))

    def tries(self, mistakes: list[Mistake]) -> list[Mistake]:
        """Return all further mistakes that may be, with what each would explain."""
        left, off = self.left(mistakes), self.misclosure(mistakes)
        left_off = left @ off
        done = {(point, axis) for m in mistakes for point in m.points for axis in m.axes}
        shifted = {axis for m in mistakes if m.kind == "common" for axis in m.axes}
        found = []
        for axes in _GROUPS:
            if all(self.is_movable[axis] and axis not in shifted for axis in axes):
                found.append(Mistake("common", (), axes))
            for point in range(len(self.known)):
                if all(self.known[point, axis] and (point, axis) not in done for axis in axes):
                    found.append(Mistake("point", (point,), axes))
        tried = []
        for mistake in found:
            gain = self.gain(mistake, left, left_off)
            if gain is not None:
                tried.append(replace(mistake, gain=gain, over=gain - quantile(mistake.freedom)))
        doubtful = sorted({t.points[0] for t in tried if t.kind == "point" and t.over > 0})
        for first, second in combinations(doubtful, 2):
            known = self.known[first]
            if not np.array_equal(known, self.known[second]) or any((p, 0) in done for p in (first, second)):
                continue
            change = self.exchange(first, second)
            gain = -float(2 * change @ left_off + change @ left @ change)
            axes = tuple(int(axis) for axis in np.flatnonzero(known))
            swapped = Mistake("swapped", (first, second), axes, gain)
            tried.append(replace(swapped, over=gain - quantile(swapped.freedom)))
        return tried


def quantile(freedom: int) -> float:
    """Return what a test of so many degrees of freedom exceeds by chance in one of a thousand."""
    return float(chdtri(freedom, BY_CHANCE))
