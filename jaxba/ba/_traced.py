"""Solve a problem whose values are traced: inside `jit`, `vmap` or a derivative.

Under `jax.grad` alone jax hands the values themselves to the rule of a derivative, so the steps are those of an
ordinary solve, compiled once for both; under `jit` and `vmap` they run in `optimistix.least_squares`. Values have
jax's default type; derivatives are refused in single precision.
"""

import functools
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jax import Array
from jaxtyping import Float
from threadpoolctl import threadpool_limits

from jaxba._errors import JaxbaError
from jaxba.ba._adjoint import Adjoint, Found, optimum, polish
from jaxba.ba._descend import descend
from jaxba.ba._linearise import costs
from jaxba.ba._plan import LinearSolver, Plan, make_plan
from jaxba.ba._plan_shape import PlanShape
from jaxba.ba._problem import Problem
from jaxba.ba._solution import HistoryStep, Solution
from jaxba.ba._solvers import AbstractSchurSolver, SchurLevenbergMarquardt, residuals
from jaxba.ba._system import System, initial_unknowns, is_traced, make_system, restore, structured
from jaxba.ba._unknowns import Unknowns
from jaxba.ba.checks import require_gauge
from jaxba.geometry import AbstractLoss

NOT_DOUBLE = (
    "Derivatives of solve are computed in double precision: call jax.config.update('jax_enable_x64', True) before "
    "anything else of jax."
)


def solve_traced(
    problem: Problem,
    loss: AbstractLoss,
    solver: AbstractSchurSolver,
    plan: Plan | PlanShape | None,
    linear_solver: LinearSolver,
    adjoint: Adjoint,
    max_nfev: int,
    callback: Callable[[HistoryStep], None] | None,
) -> Solution:
    """Return the solution, which can be differentiated as `adjoint` says."""
    with jax.ensure_compile_time_eval():  # what is known is looked at now, also inside a jit
        problem, plan = _structure(problem, plan, linear_solver)
    dtype = jnp.result_type(float)

    def forward(system: System, start: Unknowns) -> Found:
        if is_traced((system, start)):
            return _descend_traced(system, start, solver, max_nfev, optx.ImplicitAdjoint())
        reached = descend(solver, start, system, max_nfev, callback)
        if reached.interrupted:
            raise KeyboardInterrupt
        return Found(reached.unknowns, reached.state.status, reached.state.num_steps)

    def require() -> None:
        if dtype != jnp.float64:
            raise JaxbaError(NOT_DOUBLE)
        if not is_traced(problem):
            with jax.ensure_compile_time_eval():
                require_gauge(problem, "Derivatives")

    with threadpool_limits(1, user_api="blas"):
        system, start = _lay_out(problem, plan, loss, dtype)
        if adjoint == "unrolled":
            found = _descend_traced(system, start, solver, max_nfev, optx.RecursiveCheckpointAdjoint())
        else:
            found = optimum(system, start, forward=forward, exact=adjoint == "implicit", require=require)
        values, costs = _result(system, start, found.unknowns, problem, plan)
    return Solution.of(problem, values, costs, found.status, found.num_steps)


def solve_to_the_last_digits(
    problem: Problem, loss: AbstractLoss, plan: Plan, *, ftol: float, xtol: float, gtol: float, max_nfev: int
) -> Solution:
    """Return the optimum to rounding: the solver's own end, then Newton steps. Needs float64 switched on."""
    solver = SchurLevenbergMarquardt(rtol=ftol, atol=gtol, xtol=xtol)
    system, start = _lay_out(problem, plan, loss, np.float64)
    reached = descend(solver, start, system, max_nfev)
    unknowns = reached.unknowns
    for _ in range(3):
        unknowns = polish(system, unknowns)
    values, costs = _result(system, start, unknowns, problem, plan)
    return Solution.of(problem, values, costs, reached.state.status, reached.state.num_steps)


def _structure(problem: Problem, plan: Plan | PlanShape | None, linear_solver: LinearSolver) -> tuple[Problem, Plan]:
    """Return the problem that can be solved, as far as its values are known, and its plan."""
    if not is_traced(problem):
        prepared, plan = structured(problem, plan, linear_solver)
        return prepared.problem, plan
    indices = (problem.observations.image_index, problem.observations.point_index, problem.camera_index, problem.free)
    if not isinstance(plan, Plan):
        if is_traced((indices, problem.lower, problem.upper)):
            raise JaxbaError(
                "solve: the problem's indices are traced, as arguments of jit are; give it "
                "plan=jaxba.make_plan(problem), made outside."
            )
        plan = make_plan(problem, linear_solver=linear_solver)
    return problem, plan


@eqx.filter_jit
def _lay_out(problem: Problem, plan: Plan, loss: AbstractLoss, dtype: Any) -> tuple[System, Unknowns]:
    system, start = make_system(problem, plan, loss, dtype), initial_unknowns(problem, plan, dtype)
    within = jnp.clip(start.intrinsics, system.lower, system.upper)  # nobody has checked what was traced
    within = jnp.where(system.free.intrinsics > 0, within, start.intrinsics)
    return system, eqx.tree_at(lambda u: u.intrinsics, start, within)


@eqx.filter_jit
def _result(
    system: System, start: Unknowns, found: Unknowns, problem: Problem, plan: Plan
) -> tuple[Unknowns, tuple[Float[Array, ""], ...]]:
    """Return the unknowns in the problem's order, and the cost before and after, with and without losses."""
    before_and_after = jax.tree.map(lambda *both: jnp.stack(both), start, found)
    of_both = jax.vmap(functools.partial(costs, system))(before_and_after)
    return restore(found, plan), tuple(of_both[plain][end] for plain in (0, 1) for end in (0, 1))


@eqx.filter_jit
def _descend_traced(
    system: System, start: Unknowns, solver: AbstractSchurSolver, max_nfev: int, adjoint: optx.AbstractAdjoint
) -> Found:
    found = optx.least_squares(residuals, solver, start, args=system, max_steps=max_nfev, throw=False, adjoint=adjoint)
    return Found(found.value, found.stats["status"], found.stats["num_steps"])
