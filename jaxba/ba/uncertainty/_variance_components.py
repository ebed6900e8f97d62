"""Variance components: by how much each kind of measurement scatters more than its sigmas say (Foerstner 1979).

With v over sigmas and r the redundancy numbers of a kind's measurements, the factor on its variance is

    k^2 = sum v^2 / sum r

and as in `_variance_factor.py` where a loss is robust. It is one step of an iteration: with the sigmas multiplied by k
(`reweighted`) and the adjustment made anew, the next factors are nearer to one. The factor's own sigma is
k^2 sqrt(2 / sum r), of normal errors.
"""

import dataclasses
from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool

from jaxba.ba._problem import Problem
from jaxba.ba.uncertainty._point_marginals import Squares
from jaxba.ba.uncertainty._reliability import RowStatistics
from jaxba.ba.uncertainty._variance_factor import variance_factor
from jaxba.geometry import AbstractLoss

LEAST_REDUNDANCY = 8.0
"""Of a kind, below which its factor is known to less than half of itself."""
_HORIZONTAL, _VERTICAL = [True, True, False], [False, False, True]


@dataclasses.dataclass(frozen=True)
class VarianceComponent:
    """One kind of measurement.

    - `name`: `tie points`, `marks`, `position horizontal`, ... `group`: of `Problem.priors`, or `observations`.
    - `count`, `redundancy`: measured components, and their redundancy numbers summed.
    - `factor`: on the variance, NaN without redundancy. `factor_std`: its sigma.
    - `stated_std`: median of the sigmas, in the group's unit.
    - `rows`, `axes`: of the group that it is about.
    """

    name: str
    group: str
    count: int
    redundancy: float
    factor: float
    factor_std: float
    stated_std: float
    rows: Bool[np.ndarray, " rows"]
    axes: Bool[np.ndarray, " components"]

    @property
    def std(self) -> float:
        """The sigma that the residuals show, in the group's unit."""
        return self.stated_std * float(np.sqrt(self.factor))

    @property
    def is_known(self) -> bool:
        """Whether there is enough redundancy to rely on the factor."""
        return self.redundancy >= LEAST_REDUNDANCY


def variance_components(
    problem: Problem, loss: AbstractLoss, observations: RowStatistics, priors: Sequence[RowStatistics]
) -> tuple[VarianceComponent, ...]:
    """Return the components of the kinds that have measurements: pixels of tie points and of marked points, priors."""
    seen = np.asarray(problem.observations.point_index)
    marked = np.zeros(problem.num_points, bool)
    for prior in problem.priors:
        if hasattr(prior, "point_index"):
            marked[np.asarray(vars(prior)["point_index"])] = True
    kinds: list[tuple[str, AbstractLoss, RowStatistics, np.ndarray, list[bool]]] = [
        ("tie points", loss, observations, ~marked[seen], [True, True]),
        ("marks", loss, observations, marked[seen], [True, True]),
    ]
    for prior, rows in zip(problem.priors, priors, strict=True):
        every = np.ones(len(rows.weight), bool)
        kinds += [(name, prior.loss, rows, every, axes) for name, axes in _kinds_of(rows)]
    found = (_component(name, loss, rows, mine, np.array(axes)) for name, loss, rows, mine, axes in kinds)
    return tuple(component for component in found if component.count)


def components_by(rows: RowStatistics, loss: AbstractLoss, labels: np.ndarray) -> tuple[VarianceComponent, ...]:
    """Return those of a group's rows by label."""
    found = [
        _component(f"{name} {label}", loss, rows, labels == label, np.array(axes))
        for label in np.unique(labels)
        for name, axes in _kinds_of(rows)
    ]
    return tuple(component for component in found if component.count)


def _kinds_of(rows: RowStatistics) -> list[tuple[str, list[bool]]]:
    """Return the names of a group's kinds, and the components of a row that each has."""
    if rows.name in ("position", "control"):
        return [(f"{rows.name} horizontal", _HORIZONTAL), (f"{rows.name} vertical", _VERTICAL)]
    return [(rows.name.replace("_", " "), [True] * rows.std.shape[1])]


def reweighted(problem: Problem, components: Sequence[VarianceComponent], most: float) -> Problem:
    """Return the problem with the sigmas that the residuals show, for the kinds of which enough is known.

    - `most`: times that a sigma may grow, or shrink, at once.
    """
    std_px = np.array(problem.observations.std_px, float)
    priors = list(problem.priors)
    names = [prior.name for prior in priors]
    for component in components:
        if not (component.is_known and component.factor > 0):
            continue
        times = float(np.clip(np.sqrt(component.factor), 1 / most, most))
        if component.group == "observations":
            std_px[component.rows] *= times
            continue
        number = names.index(component.group)
        field = next(f.name for f in dataclasses.fields(priors[number]) if f.name.startswith("std"))
        std = np.array(getattr(priors[number], field), float)
        by_axis = std if std.ndim == 2 else std[:, None]
        of_rows = np.repeat(component.rows, len(by_axis) // len(component.rows))  # a scale bar has two
        by_axis[np.ix_(of_rows, component.axes)] *= times
        priors[number] = dataclasses.replace(priors[number], **{field: std})
    observations = dataclasses.replace(problem.observations, std_px=std_px)
    return dataclasses.replace(problem, observations=observations, priors=tuple(priors))


def _component(
    name: str, loss: AbstractLoss, rows: RowStatistics, mine: Bool[np.ndarray, " rows"], axes: Bool[np.ndarray, " axes"]
) -> VarianceComponent:
    redundancy = rows.redundancy[mine][:, axes]
    used = np.isfinite(redundancy)
    squared = np.where(used, np.nan_to_num(rows.over_sigma[mine][:, axes]) ** 2, 0.0)
    count, total = int(used.sum()), float(np.sum(redundancy[used]))
    groups = [Squares(squared.sum(axis=1), used.sum(axis=1))]
    factor = variance_factor([loss], groups, count - total)[0] if total > 0 else np.nan
    std = rows.std[mine][:, axes][used]
    return VarianceComponent(
        name=name,
        group=rows.name,
        count=count,
        redundancy=total,
        factor=factor,
        factor_std=factor * float(np.sqrt(2 / total)) if total > 0 else np.nan,
        stated_std=float(np.median(std)) if len(std) else np.nan,
        rows=mine,
        axes=axes,
    )
