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

import numpy as np
from jaxtyping import Bool

from jaxba.sfm.control._misclosure import Misclosure, Mistake, Model, quantile

MOST_SCALE = 10.0
"""Times its stated sigmas that a survey may be worse; beyond that it is wrong and not imprecise."""
_AS_GOOD = 6.0  # twice the logarithm of 20: by that much less a rival explains and cannot be excluded
_LEAST_FOR_MOST = 5  # control points
_TURNS = 2  # of searching scale and mistakes in turn
_SCALES = np.geomspace(1.0, MOST_SCALE, 9)


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


def explain(given: Misclosure) -> Explained:
    """Return what best explains a misclosure: nothing where chance does."""
    if not np.isfinite(given.off_m).any():
        return Explained(len(given.off_m))
    plain = _searched(Model(given))
    if len(plain) < 2:
        return Explained(len(given.off_m), tuple(plain))
    # a survey worse than it says, and what is wrong beside that: taken where it says more than mistakes alone
    num_points = int(np.isfinite(given.off_m).any(axis=1).sum())
    best, scale = plain, (1.0, 1.0)
    least = np.inf if _are_most(plain, num_points) else _cost(Model(given), plain)
    for mistakes in (plain, []):
        for _ in range(_TURNS):
            wider = _likeliest_scale(given, mistakes)
            mistakes = _searched(Model(given, wider))
            cost = _cost(Model(given, wider), mistakes)
            if cost < least and not _are_most(mistakes, num_points):
                best, scale, least = mistakes, wider, cost
    return Explained(len(given.off_m), tuple(best), scale)


def _are_most(mistakes: list[Mistake], num_points: int) -> bool:
    """Whether so many points would be wrong that it is the survey, and none of them by itself."""
    return num_points >= _LEAST_FOR_MOST and 2 * len({m.points for m in mistakes if m.kind == "point"}) > num_points


def _searched(model: Model) -> list[Mistake]:
    """Return the mistakes that explain most, each with its rivals."""
    mistakes: list[Mistake] = []
    for _ in range(2 * model.known.size):  # a mistake may go again when others come
        best = max(model.tries(mistakes), key=lambda tried: tried.over, default=None)
        if best is None or best.over <= 0:
            break
        mistakes = _needed(model, [*mistakes, best])
    return [_with_rivals(model, mistakes, k) for k in range(len(mistakes))]


def _cost(model: Model, mistakes: list[Mistake]) -> float:
    """Return minus twice the logarithm of the likelihood, and what mistakes and enlarged sigmas cost."""
    off = model.misclosure(mistakes)
    cost = sum(quantile(mistake.freedom) for mistake in mistakes)
    cost += quantile(1) * sum(value > 1 for value in model.scale)
    return float(off @ model.left(mistakes) @ off) + model.log_size + cost


def _likeliest_scale(given: Misclosure, mistakes: list[Mistake]) -> tuple[float, float]:
    """Return what the survey's sigmas are multiplied by that makes the misclosure likeliest beside some mistakes."""
    found, least = (1.0, 1.0), np.inf
    for axes in (0, 1, 0):
        for value in _SCALES:
            tried = (float(value), found[1]) if axes == 0 else (found[0], float(value))
            cost = _cost(Model(given, tried), mistakes)
            if cost < least:
                found, least = tried, cost
    return found


def _needed(model: Model, mistakes: list[Mistake]) -> list[Mistake]:
    """Return mistakes without those that the others have made needless."""
    kept = list(mistakes)
    for mistake in mistakes[:-1]:
        others = [m for m in kept if m is not mistake]
        again = next((t for t in model.tries(others) if (t.culprit, t.axes) == (mistake.culprit, mistake.axes)), None)
        if again is not None and again.over <= 0:
            kept = others
    return kept


def _with_rivals(model: Model, mistakes: list[Mistake], k: int) -> Mistake:
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
