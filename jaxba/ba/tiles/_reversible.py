"""`solve_tiled` under `jax.grad`: its values, and the rule of its gradient, whose work `_reverse.py` does."""

from collections.abc import Callable
from contextlib import AbstractContextManager
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jaxba._errors import JaxbaError
from jaxba.ba._adjoint import NOT_A_MINIMUM
from jaxba.ba._problem import Problem
from jaxba.ba._solution import Solution
from jaxba.ba._system import is_traced, own_unknowns
from jaxba.ba._traced import NOT_DOUBLE
from jaxba.ba.checks import prepare, require_gauge
from jaxba.ba.tiles._dense import NotPositive
from jaxba.ba.tiles._engine import Engine
from jaxba.ba.tiles._reverse import Reverse
from jaxba.geometry import AbstractLoss


def solve_reversibly(
    problem: Problem,
    loss: AbstractLoss,
    solve: Callable[[Problem, AbstractLoss], Solution],
    open_engine: Callable[[Problem, AbstractLoss], AbstractContextManager[Engine]],
) -> Solution:
    """Return the solution of a problem under `jax.grad`, which hands the values themselves to the rule below.

    Raises `JaxbaError` inside `jit` and `vmap`, where there are no values, in single precision, and where the values
    have no derivative.
    """
    numbers, rest = eqx.partition((problem, loss), eqx.is_inexact_array)

    @jax.custom_vjp
    def solved(numbers: Any) -> tuple[Any, ...]:
        return forward(numbers)[0]

    def forward(numbers: Any) -> tuple[tuple[Any, ...], Any]:
        if is_traced(numbers):
            raise JaxbaError(_NO_VALUES)
        if jnp.result_type(float) != jnp.float64:
            raise JaxbaError(NOT_DOUBLE)
        problem, loss = jax.tree.map(np.asarray, eqx.combine(numbers, rest))
        require_gauge(problem, "Derivatives")
        dropped = prepare(problem).dropped
        if dropped.any():  # said before the solve, which may take hours
            raise JaxbaError(f"{_LEFT_OUT} {dropped.summary()}")
        solution = solve(problem, loss)
        if not solution.converged:
            raise JaxbaError(NOT_A_MINIMUM)
        unknowns = own_unknowns(solution.apply(problem))
        costs = solution.initial_cost, solution.final_cost, solution.initial_plain_cost, solution.plain_cost
        found = unknowns, tuple(map(float, costs)), int(solution.status), int(solution.num_steps)
        return jax.tree.map(jnp.asarray, found), (problem, loss, unknowns)

    def backward(kept: Any, cotangents: tuple[Any, ...]) -> tuple[Any]:
        problem, loss, unknowns = kept
        along, costs = jax.tree.map(np.asarray, cotangents[:2])
        if any(float(costs[k]) for k in (0, 2, 3)):
            raise JaxbaError(_FINAL_COST_ALONE)
        with open_engine(problem, loss) as engine:
            try:
                found = Reverse(engine, problem, loss, unknowns).gradient(along, costs[1])
            except NotPositive as error:
                raise JaxbaError(NOT_A_MINIMUM) from error
        asked = jax.tree.map(
            lambda number, of: None if number is None else jnp.asarray(of), numbers, found, is_leaf=_none
        )
        return (asked,)

    solved.defvjp(forward, backward)
    return Solution.of(problem, *solved(numbers))


_NO_VALUES = (
    "solve_tiled: the problem's values are traced, as inside jit and vmap. jax.grad is taken outside of them, or use "
    "solve there."
)
_LEFT_OUT = (
    "Derivatives: solve what is left of the problem, solution.report.problem of a solve before; this one leaves out:"
)
_FINAL_COST_ALONE = "solve_tiled: of the costs only final_cost has a derivative; use solve for the others."


def _none(leaf: Any) -> bool:
    return leaf is None
