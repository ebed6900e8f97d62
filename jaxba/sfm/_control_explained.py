"""Control tested before it may move a block: what photos and positions alone say of its points, against the survey.

Let m be that misclosure, one row a surveyed coordinate, and Q = C + S its covariance: C is that of points intersected
in a block which control does not hold, S that of the survey. Without a blunder `m^T Q^-1 m` is chi-squared. A mistake
adds columns A of its own to m = A d + noise: a wrong point its coordinates, positions off in common a shift of all.
With W = Q^-1 and

    R = W - W A (A^T W A)^-1 A^T W

the test of further columns B, with those of A taken as explained, is (Baarda 1968; Teunissen 2006, chapter 3)

    (B^T R m)^T (B^T R B)^-1 (B^T R m),   chi-squared with as many degrees as B has columns.

For one coordinate it is Baarda's w squared, the same that the adjustment with all of control would give, but nothing
has been bent by it yet. Two labels exchanged change m by no free column: the test is what `m^T R m` becomes smaller by.

Mistakes are tried by name: a point in height or across; what positions have in common, likewise; two labels exchanged;
sigmas of the survey that are too small, all in the same ratio. Each counts by what it explains over the quantile of its
test at 0.1%. The best is taken, the rest tested again, and at the end each once more against all others: one that the
others have made needless goes, and one that another could replace is told with its rivals.
"""

from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np
from jaxtyping import Bool, Float
from scipy.special import chdtri

from jaxba.ba import NONCENTRALITY

SIGNIFICANCE = 1e-3
MOST_SCALE = 10.0
"""Times its stated sigmas that a survey may be worse; beyond that it is wrong and not imprecise."""
_AS_GOOD = 6.0  # twice the logarithm of 20: by that much less a rival explains and cannot be excluded
_UNSEEN = 1e-6  # of a column's own weight, that is left where others take it up
_LEAST_FOR_MOST = 5  # control points
_TURNS = 2  # of searching scale and mistakes in turn
_SCALES = np.geomspace(1.0, MOST_SCALE, 9)
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
    def culprit(self) -> tuple[str, tuple[int, ...]]:
        """Who made it, in whatever axes."""
        return self.kind, self.points


@dataclass(frozen=True, eq=False)
class Explained:
    """What is wrong with control, and with positions in common.

    - `mistakes`: by name. `scale`: times the sigmas of the survey, horizontal and vertical.
    """

    num_points: int
    mistakes: tuple[Mistake, ...] = ()
    scale: tuple[float, float] = (1.0, 1.0)

    @property
    def wrong(self) -> Bool[np.ndarray, "points 3"]:
        """Which coordinates are to be set aside."""
        found = np.zeros((self.num_points, 3), bool)
        for mistake in self.mistakes:
            for point in mistake.points:
                found[point, list(mistake.axes)] = True
        return found

    @property
    def is_shifted(self) -> Bool[np.ndarray, "3"]:
        """Along which axes positions are off in common, beyond their sigmas."""
        found = np.zeros(3, bool)
        for mistake in self.mistakes:
            if mistake.kind == "common":
                found[list(mistake.axes)] = True
        return found

    def same_as(self, other: "Explained") -> bool:
        """Whether both set the same aside, and free the same."""
        same = np.array_equal(self.wrong, other.wrong) and np.array_equal(self.is_shifted, other.is_shifted)
        return bool(same and np.allclose(self.scale, other.scale, rtol=0.3))


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


class _Model:
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
        if np.linalg.eigvalsh(square)[0] < _UNSEEN:
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
                tried.append(replace(mistake, gain=gain, over=gain - _quantile(len(mistake.axes))))
        doubtful = sorted({t.points[0] for t in tried if t.kind == "point" and t.over > 0})
        for first, second in combinations(doubtful, 2):
            known = self.known[first]
            if not np.array_equal(known, self.known[second]) or any((p, 0) in done for p in (first, second)):
                continue
            change = self.exchange(first, second)
            gain = -float(2 * change @ left_off + change @ left @ change)
            axes = tuple(int(axis) for axis in np.flatnonzero(known))
            tried.append(Mistake("swapped", (first, second), axes, gain, gain - _quantile(3)))
        return tried


def explain(given: Misclosure) -> Explained:
    """Return what best explains a misclosure: nothing where chance does."""
    if not np.isfinite(given.off_m).any():
        return Explained(len(given.off_m))
    plain = _searched(_Model(given))
    if len(plain) < 2:
        return Explained(len(given.off_m), tuple(plain))
    # a survey worse than it says, and what is wrong beside that: taken where it says more than mistakes alone
    num_points = int(np.isfinite(given.off_m).any(axis=1).sum())
    best, scale = plain, (1.0, 1.0)
    least = np.inf if _are_most(plain, num_points) else _cost(_Model(given), plain)
    for mistakes in (plain, []):
        for _ in range(_TURNS):
            wider = _likeliest_scale(given, mistakes)
            mistakes = _searched(_Model(given, wider))
            cost = _cost(_Model(given, wider), mistakes)
            if cost < least and not _are_most(mistakes, num_points):
                best, scale, least = mistakes, wider, cost
    return Explained(len(given.off_m), tuple(best), scale)


def control_statistics(given: Misclosure, explained: Explained) -> Tested:
    """Return the statistics of every coordinate, where `explained` stands."""
    model = _Model(given, explained.scale)
    apart = [m for m in explained.mistakes if m.kind == "common"]
    apart += _apart(explained, model)
    shape = given.off_m.shape
    test, without, spread, detectable, reach = (np.full(shape, np.nan) for _ in range(5))
    for point in range(len(given.off_m)):
        axes = np.flatnonzero(model.known[point])
        for axis in axes:
            others = [m for m in apart if (m.points, m.axes) != ((point,), (int(axis),))]
            left, row = model.left(others), model.row[point, axis]
            if left[row, row] < _UNSEEN * model.weight[row, row]:
                detectable[point, axis] = reach[point, axis] = np.inf
                continue
            test[point, axis] = left[row] @ model.off / np.sqrt(left[row, row])
            detectable[point, axis] = NONCENTRALITY / np.sqrt(left[row, row])
            # C with what positions have in common
            moves = (model.of_block + (model.common * given.common_std_m**2) @ model.common.T) @ left
            reach[point, axis] = moves[row, row] * detectable[point, axis]
        rows = model.row[point, axes]
        others = [m for m in apart if m.points != (point,)]
        left = model.left(others)
        square = left[np.ix_(rows, rows)]
        if len(rows) and np.linalg.eigvalsh(square)[0] > _UNSEEN * np.linalg.eigvalsh(square)[-1]:
            inverse = np.linalg.inv(square)
            without[point, axes] = inverse @ left[rows] @ model.off
            spread[point, axes] = np.sqrt(np.diagonal(inverse))
    return Tested(test, without, spread, detectable, reach, _shift(given, explained, model))


def _are_most(mistakes: list[Mistake], num_points: int) -> bool:
    """Whether so many points would be wrong that it is the survey, and none of them by itself."""
    return num_points >= _LEAST_FOR_MOST and 2 * len({m.points for m in mistakes if m.kind == "point"}) > num_points


def _searched(model: _Model) -> list[Mistake]:
    """Return the mistakes that explain most, each with its rivals."""
    mistakes: list[Mistake] = []
    for _ in range(2 * model.known.size):  # a mistake may go again when others come
        best = max(model.tries(mistakes), key=lambda tried: tried.over, default=None)
        if best is None or best.over <= 0:
            break
        mistakes = _needed(model, [*mistakes, best])
    return [_with_rivals(model, mistakes, k) for k in range(len(mistakes))]


def _cost(model: _Model, mistakes: list[Mistake]) -> float:
    """Return minus twice the logarithm of the likelihood, and what mistakes and enlarged sigmas cost."""
    off = model.misclosure(mistakes)
    cost = sum(_quantile(3 if m.kind == "swapped" else len(m.axes)) for m in mistakes)
    cost += _quantile(1) * sum(value > 1 for value in model.scale)
    return float(off @ model.left(mistakes) @ off) + model.log_size + cost


def _likeliest_scale(given: Misclosure, mistakes: list[Mistake]) -> tuple[float, float]:
    """Return what the survey's sigmas are multiplied by that makes the misclosure likeliest beside some mistakes."""
    found, least = (1.0, 1.0), np.inf
    for axes in (0, 1, 0):
        for value in _SCALES:
            tried = (float(value), found[1]) if axes == 0 else (found[0], float(value))
            cost = _cost(_Model(given, tried), mistakes)
            if cost < least:
                found, least = tried, cost
    return found


def _needed(model: _Model, mistakes: list[Mistake]) -> list[Mistake]:
    """Return mistakes without those that the others have made needless."""
    kept = list(mistakes)
    for mistake in mistakes[:-1]:
        others = [m for m in kept if m is not mistake]
        again = next((t for t in model.tries(others) if (t.culprit, t.axes) == (mistake.culprit, mistake.axes)), None)
        if again is not None and again.over <= 0:
            kept = others
    return kept


def _with_rivals(model: _Model, mistakes: list[Mistake], k: int) -> Mistake:
    """Return a mistake with others of which one in its place explains as much."""
    others = mistakes[:k] + mistakes[k + 1 :]
    mistake, named = mistakes[k], {m.culprit for m in mistakes}
    best: dict[tuple[str, tuple[int, ...]], Mistake] = {}
    for tried in model.tries(others):
        if tried.culprit in named or tried.over <= max(mistake.over - _AS_GOOD, 0.0):
            continue
        if tried.culprit not in best or best[tried.culprit].over < tried.over:
            best[tried.culprit] = tried
    return replace(mistake, rivals=tuple(sorted(best.values(), key=lambda tried: -tried.over)))


def _apart(explained: Explained, model: _Model) -> list[Mistake]:
    """Return what is set aside, coordinate by coordinate."""
    rows = zip(*np.nonzero(explained.wrong & model.known), strict=True)
    return [Mistake("point", (int(point),), (int(axis),)) for point, axis in rows]


def _shift(given: Misclosure, explained: Explained, model: _Model) -> Float[np.ndarray, "3"]:
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


def _quantile(freedom: int) -> float:
    return float(chdtri(freedom, SIGNIFICANCE))
