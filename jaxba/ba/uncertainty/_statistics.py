"""Statistics of an adjustment, as surveyors judge it: covariances, redundancy, tests of every measurement, weights.

Everything is taken at a problem's present values, which are to be those of a solution. The covariances are those of
`_covariance.py`; what each measurement has to do with them is computed tile by tile (`_leverage.py`), and judged in
numpy (`_reliability.py`, `_variance_components.py`).
"""

import dataclasses
import os
from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Float, Int
from scipy.special import chdtrc

from jaxba._errors import JaxbaError
from jaxba.ba._plan_shape import PlanShape
from jaxba.ba._problem import AbstractPrior, Problem
from jaxba.ba._reweighting import loss_derivatives
from jaxba.ba._tables import (
    DataFrame,
    cameras_table,
    components_table,
    images_table,
    observations_table,
    pairs_table,
    points_table,
    prior_table,
)
from jaxba.ba.groups import ScaleBarPrior
from jaxba.ba.tiles._opened import TILE_OBSERVATIONS
from jaxba.ba.uncertainty._covariance import Covariance, Datum, Independent, marginals_at
from jaxba.ba.uncertainty._leverage import Leverage
from jaxba.ba.uncertainty._reliability import RowStatistics, row_statistics
from jaxba.ba.uncertainty._variance_components import VarianceComponent, components_by, reweighted, variance_components
from jaxba.geometry import AbstractLoss, Linear, require_number


@dataclasses.dataclass(frozen=True)
class Statistics:
    """Statistics of an adjustment; every figure is a priori, of measurements whose sigmas are true.

    - `covariance`: of the unknowns. `problem`: what they are of.
    - `observations`: of the pixels, a row for each of the problem's. `priors`: of each prior, in the problem's order.
    - `components`: how each kind of measurement scatters beside its sigmas.
    - `loss`: of the observations.
    """

    covariance: Covariance
    problem: Problem
    observations: RowStatistics
    priors: tuple[RowStatistics, ...]
    components: tuple[VarianceComponent, ...]
    loss: AbstractLoss

    @property
    def p_value(self) -> float:
        """Of the global test: how often chance alone makes residuals as large as these, if all sigmas are true.

        NaN where a loss is robust, under which the sum of squares follows no distribution that is known, or without
        redundancy.
        """
        covariance, rows = self.covariance, (self.observations, *self.priors)
        if covariance.redundancy <= 0 or not all(np.all(of.weight == 1) for of in rows):
            return np.nan
        return float(chdtrc(covariance.redundancy, covariance.variance_factor * covariance.redundancy))

    def reweighted(self, most: float = 10.0, components: Sequence[VarianceComponent] | None = None) -> Problem:
        """Return the problem with the sigmas that the variance components show, where enough is known of them.

        One step of an iteration: solve it, and take its statistics again. Three steps are mostly enough.

        - `most`: times that a sigma may grow, or shrink, at once. `components`: those of the statistics if None; others
          such as `components_by` gives must not share rows.
        """
        require_number("reweighted: most", most, 1.0, np.finfo(float).max, "give 1 or more, such as 10")
        return reweighted(self.problem, self.components if components is None else components, most)

    def components_by(
        self, labels: Sequence[Any] | np.ndarray, group: str = "observations"
    ) -> tuple[VarianceComponent, ...]:
        """Return variance components of a group's rows by label: of each camera, each flight, each day.

        - `labels`: one a row of the group, `observations` or a prior's name. Positions and control points have a
          component across and one up.

        Raises `JaxbaError` where their number is wrong, and where the problem has no such group.

        >>> import jaxba
        >>> problem = jaxba.synthetic.uav_block(8, num_cameras=2).problem
        >>> found = jaxba.statistics(jaxba.solve(problem).apply(problem))
        >>> camera = problem.camera_index[problem.observations.image_index]
        >>> [component.name for component in found.components_by(camera)]
        ['observations 0', 'observations 1']
        """
        rows = self.observations if group == "observations" else self.prior(group)
        labels = np.asarray(labels)
        if labels.dtype.kind not in "iufUSb" or (labels.dtype.kind == "f" and np.isnan(labels).any()):
            raise JaxbaError("components_by: labels are to be numbers or texts, one a row, none of them missing.")
        if labels.shape != (len(rows.weight),):
            raise JaxbaError(
                f"components_by: {labels.shape} labels for the {len(rows.weight)} rows of {group}; give one a row."
            )
        prior = self.problem.prior(group)
        return components_by(rows, self.loss if prior is None else prior.loss, labels)

    def observations_frame(self) -> DataFrame:
        """Return the table of observations, a row for each of the problem's; its columns: `ba/_tables.py`."""
        return observations_table(self.problem, self.observations)

    def prior_frame(self, name: str) -> DataFrame:
        """Return the table of a prior; raises `JaxbaError` where the problem has none of the name."""
        prior = self.problem.prior(name)
        rows = self.prior(name)
        assert prior is not None  # or there were no rows of it
        return prior_table(self.problem, prior, rows)

    def images_frame(self) -> DataFrame:
        """Return the table of images: places and orientations with their sigmas and ellipses of errors."""
        return images_table(self.problem, self.covariance)

    def points_frame(self) -> DataFrame:
        """Return the table of points, likewise."""
        return points_table(self.problem, self.covariance)

    def pairs_frame(self) -> DataFrame:
        """Return the table of pairs of images that have points in common."""
        return pairs_table(self.problem)

    def cameras_frame(self) -> DataFrame:
        """Return the table of intrinsics: a row for each parameter of each camera."""
        return cameras_table(self.problem, self.covariance)

    def components_frame(self) -> DataFrame:
        """Return the table of variance components."""
        return components_table(self.components)

    def prior(self, name: str) -> RowStatistics:
        """Return the statistics of a prior's rows; raises `JaxbaError` where the problem has none of the name."""
        for rows in self.priors:
            if rows.name == name:
                return rows
        names = ", ".join(rows.name for rows in self.priors) or "none"
        raise JaxbaError(f"statistics: the problem has no prior {name!r}; it has {names}.")


def statistics(
    problem: Problem,
    *,
    loss: AbstractLoss | None = None,
    datum: Datum = "priors",
    independent: Independent = "observations",
    max_memory: float | str | None = None,
    max_observations: float = TILE_OBSERVATIONS,
    folder: str | os.PathLike[str] | None = None,
    workers: int | None = None,
    like: PlanShape | None = None,
) -> Statistics:
    """Return the statistics at the problem's present values; call it on `solution.apply(problem)`.

    Arguments and errors are those of `covariance`. Under inner constraints there are no priors of poses and
    points, and no reach.

    >>> import jaxba
    >>> survey = jaxba.synthetic.uav_block(8)
    >>> solution = jaxba.solve(survey.problem)
    >>> found = jaxba.statistics(solution.apply(survey.problem))
    >>> found.prior("position").redundancy.shape
    (8, 3)
    """
    loss = Linear() if loss is None else loss
    room: dict[str, Any] = {
        "max_memory": max_memory,
        "max_observations": max_observations,
        "folder": folder,
        "workers": workers,
        "like": like,
    }
    problem, found, leverages, kept = marginals_at("Statistics", problem, loss, datum, independent, "all", **room)
    of_observations = leverages[0]
    std_px = np.repeat(np.asarray(problem.observations.std_px, float)[:, None], 2, axis=1)
    everywhere = Leverage(*(_at(np.asarray(part), kept, problem.num_observations) for part in of_observations))
    std_px[np.setdiff1d(np.arange(len(std_px)), kept)] = np.nan
    observations = row_statistics("observations", std_px, _weight(loss, everywhere), everywhere)
    priors = _of_priors(problem, leverages[1:])
    components = variance_components(problem, loss, observations, priors)
    return Statistics(found, problem, observations, priors, components, loss)


def prior_statistics(
    problem: Problem, *, loss: AbstractLoss | None = None, max_memory: float | str | None = None
) -> tuple[Covariance, tuple[RowStatistics, ...]]:
    """Return the covariances and the statistics of the priors' rows alone, in as much memory as `covariance` takes.

    Arguments and errors are those of `covariance`.
    """
    loss = Linear() if loss is None else loss
    of_all = marginals_at("Statistics", problem, loss, "priors", "observations", "priors", max_memory=max_memory)
    return of_all.covariance, _of_priors(problem, of_all.leverages)


def _of_priors(problem: Problem, leverages: Sequence[Leverage]) -> tuple[RowStatistics, ...]:
    def of_prior(prior: AbstractPrior, rows: Leverage) -> RowStatistics:
        std = _sigmas(prior, np.asarray(rows.residual).shape)
        if isinstance(prior, ScaleBarPrior):
            std, rows = std[::2, :1], _of_bars(rows)
        return row_statistics(prior.name, std, _weight(prior.loss, rows), rows)

    return tuple(map(of_prior, problem.priors, leverages))


def _of_bars(rows: Leverage) -> Leverage:
    """Return those of whole bars, one row each: the row of a length between ends has half of a bar's variance, and half
    of its misclosure and redundancy (`groups/_scale_bar.py`). Reach is not known.
    """
    residual, leverage = np.asarray(rows.residual)[::2, 3:], np.asarray(rows.leverage)[::2, 3:, 3:]
    return Leverage(np.sqrt(2) * residual, 2 * leverage - 1, np.full((len(residual), 3, 1), np.nan))


def _at(part: Float[np.ndarray, "kept *rest"], kept: Int[np.ndarray, " kept"], count: int) -> np.ndarray:
    """Return the rows that took part among all, with zeros for the others."""
    everywhere = np.zeros((count, *part.shape[1:]))
    everywhere[kept] = part
    return everywhere


def _weight(loss: AbstractLoss, rows: Leverage) -> Float[np.ndarray, " rows"]:
    """Return the weight that a loss gives each row."""
    if isinstance(loss, Linear):
        return np.ones(len(rows.residual))
    return np.maximum(loss_derivatives(loss, np.sum(np.asarray(rows.residual, float) ** 2, axis=1))[0], 0.0)


def _sigmas(prior: AbstractPrior, shape: tuple[int, ...]) -> Float[np.ndarray, "rows components"]:
    """Return the sigmas of a prior's components; ones where its fields do not tell them."""
    for field in dataclasses.fields(prior):
        if field.name.startswith("std"):
            std = np.asarray(getattr(prior, field.name), float)
            return np.broadcast_to(std if std.ndim == 2 else std[:, None], shape).copy()
    return np.ones(shape)
