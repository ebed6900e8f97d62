"""Rounds of solve and reweight: sigmas of each kind of measurement estimated in the adjustment that uses them.

Variance components of one adjustment are a step of an iteration (`_variance_components.py`): with its sigmas as they
show them the problem is solved again, from where it stands, until no sigma changes by more than `_SETTLED`. Kinds whose
redundancy is too small keep theirs, and none changes by more than `most` in all: what would is told.
"""

import dataclasses
from collections.abc import Callable
from typing import Any

import numpy as np

from jaxba.ba._problem import Problem
from jaxba.ba._solution import Solution
from jaxba.ba._solve import solve
from jaxba.ba.uncertainty._statistics import Statistics, statistics
from jaxba.ba.uncertainty._variance_components import reweighted
from jaxba.geometry import AbstractLoss, require_number

_SETTLED = 0.02


@dataclasses.dataclass(frozen=True)
class Reweighted:
    """Result of `solve_and_reweight`.

    - `solutions`: of each round; `solution` is the last one's. `problem`: with the sigmas that it was solved with.
    - `statistics`: at the last solution: what is left of the components is near 1.
    - `times`: by kind of measurement, what its stated sigmas were multiplied by.
    - `at_limit`: kinds that would have changed by more than was allowed. `is_settled`: no sigma still changed.
    """

    solutions: tuple[Solution, ...]
    problem: Problem
    statistics: Statistics
    times: dict[str, float]
    at_limit: tuple[str, ...]
    is_settled: bool

    @property
    def solution(self) -> Solution:
        return self.solutions[-1]


def solve_and_reweight(
    problem: Problem,
    *,
    rounds: int = 6,
    most: float = 10.0,
    loss: AbstractLoss | None = None,
    solver: Callable[..., Solution] = solve,
    max_memory: float | str | None = None,
    **options: Any,
) -> Reweighted:
    """Solve, estimate the sigma of each kind of measurement, and solve again with it, until the sigmas stand.

    - `rounds`: of solving again, at most. `most`: times that the sigmas of a kind may grow, or shrink, in all.
    - `solver`: `solve` or `solve_tiled`, to which the `options` belong; `max_memory`: of the statistics.

    Raises `JaxbaError` as `statistics` does.

    >>> import jaxba
    >>> survey = jaxba.synthetic.uav_block(8)
    >>> found = jaxba.solve_and_reweight(survey.problem)
    >>> round(found.times["tie points"], 1)  # its sigmas are true
    1.0
    """
    require_number("solve_and_reweight: rounds", rounds, 0.0, 1e3, "give a whole number, 0 or more", whole=True)
    require_number("solve_and_reweight: most", most, 1.0, np.finfo(float).max, "give 1 or more, such as 10")
    solutions: list[Solution] = []
    times: dict[str, float] = {}
    at_limit: set[str] = set()
    while True:
        solutions.append(solver(problem, loss=loss, **options))
        problem = solutions[-1].apply(problem)
        found = statistics(problem, loss=loss, max_memory=max_memory)
        steps: dict[str, float] = {}
        for component in found.components:
            before = times.setdefault(component.name, 1.0)
            wanted = before * float(np.sqrt(component.factor)) if component.is_known else before
            allowed = float(np.clip(wanted, 1 / most, most))
            steps[component.name] = allowed / before
            (at_limit.discard if allowed == wanted else at_limit.add)(component.name)
        settled = all(abs(step - 1) <= _SETTLED for step in steps.values())
        interrupted = solutions[-1].result == "interrupted"
        if settled or interrupted or len(solutions) > int(rounds):
            return Reweighted(tuple(solutions), problem, found, times, tuple(sorted(at_limit)), settled)
        limited = [dataclasses.replace(one, factor=steps[one.name] ** 2) for one in found.components]
        problem = reweighted(problem, limited, most**2)
        times = {name: times[name] * step for name, step in steps.items()}
