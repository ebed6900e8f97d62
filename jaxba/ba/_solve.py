"""`solve`: adjust a problem from its start values.

On concrete values a host loop calls the solver's compiled `init` and `step`: it reports progress, can be interrupted
with what was reached kept, and times every step without the compile. With traced values (inside `jit`, `vmap` or a
derivative) the same solver runs in `optimistix.least_squares`; the structure must then be known beforehand, as a `Plan`
made with `make_plan`.
"""

import dataclasses
import time
from collections.abc import Callable
from typing import Any, Literal

import equinox.internal as eqxi
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from threadpoolctl import threadpool_limits

from jaxba._errors import JaxbaError
from jaxba.ba._check import prepare
from jaxba.ba._compiled import compiled
from jaxba.ba._linearise import cost
from jaxba.ba._plan import LinearSolver, Plan, make_plan
from jaxba.ba._problem import Problem
from jaxba.ba._rows import Unknowns
from jaxba.ba._solution import HistoryStep, Report, Solution, to_host
from jaxba.ba._solvers import RUNNING, AbstractSchurSolver, SchurDogleg, SchurLevenbergMarquardt, State, residuals
from jaxba.ba._system import System, initial_unknowns, is_traced, make_system, restore
from jaxba.geometry import AbstractLoss, Linear

Method = Literal["lm", "dogleg"]
_SOLVERS: dict[str, type[SchurLevenbergMarquardt] | type[SchurDogleg]] = {
    "lm": SchurLevenbergMarquardt,
    "dogleg": SchurDogleg,
}

# optimistix's implicit adjoint would invert a Hessian that the length of each quaternion makes singular: no gradient is
# better than a wrong one
_NO_DERIVATIVE = (
    "jaxba.solve cannot be differentiated yet. Use jaxba.covariance for the effect of measurement errors, or "
    "finite differences of solves."
)


def solve(
    problem: Problem,
    *,
    loss: AbstractLoss | None = None,
    method: Method = "lm",
    linear_solver: LinearSolver = "auto",
    max_nfev: int = 500,
    ftol: float = 1e-8,
    xtol: float = 1e-8,
    gtol: float = 1e-10,
    dtype: Any = np.float64,
    plan: Plan | None = None,
    callback: Callable[[HistoryStep], None] | None = None,
) -> Solution:
    """Adjust a problem and return the solution; the problem is left as it is.

    - `loss`: robust loss of the reprojections, in units of their sigma; least squares if None. Priors carry their own.
    - `method`: `lm`, Levenberg-Marquardt, or `dogleg`.
    - `linear_solver`: how the reduced system is solved; `auto` chooses from its size and bandwidth.
    - `max_nfev`: the most steps tried. `ftol`, `xtol`, `gtol`: stop when the cost, the unknowns or the gradient no
      longer change, as in scipy.
    - `plan`: the problem's structure, made by `make_plan`; needed where the problem's values are traced. Where
      something is left out of the problem, a new plan of the same sizes takes its place.
    - `callback`: called after every step.

    Raises `JaxbaError` for a problem that cannot be solved, naming what is wrong. What is left out instead (points seen
    once, points behind their camera) is counted in `solution.report.dropped`. Ctrl-C returns what was reached so far.

    >>> import jaxba
    >>> survey = jaxba.synthetic.uav_block(8)
    >>> solution = jaxba.solve(survey.problem)
    >>> solution.converged, bool(solution.final_cost < solution.initial_cost)
    (True, True)
    """
    loss = Linear() if loss is None else loss
    if method not in _SOLVERS:
        raise JaxbaError(f"method {method!r}: choose one of {', '.join(_SOLVERS)}.")
    solver = _SOLVERS[method](rtol=ftol, atol=gtol, xtol=xtol)
    if is_traced((problem, loss)):
        if plan is None:
            raise JaxbaError(
                "solve inside jit, vmap or a derivative needs plan=jaxba.make_plan(problem), made outside."
            )
        return _solve_traced(problem, loss, solver, plan, max_nfev)
    # OpenBLAS's threads fight with XLA's for the cores (with them a 144 x 144 Cholesky took 204 ms instead of 0.16 ms),
    # so OpenBLAS gets one thread for as long as this runs
    with jax.enable_x64(True), threadpool_limits(1, user_api="blas"):
        return _solve_on_host(problem, loss, solver, plan, linear_solver, max_nfev, dtype, callback)


def _solve_on_host(
    problem: Problem,
    loss: AbstractLoss,
    solver: AbstractSchurSolver,
    plan: Plan | None,
    linear_solver: LinearSolver,
    max_nfev: int,
    dtype: Any,
    callback: Callable[[HistoryStep], None] | None,
) -> Solution:
    begin = time.perf_counter()
    prepared = prepare(problem)
    if plan is None or prepared.dropped.any():
        like = None if plan is None else plan.shape
        plan = make_plan(prepared.problem, linear_solver=linear_solver, like=like)
    system: System = jax.device_put(make_system(prepared.problem, plan, loss, dtype))
    plain: System = jax.device_put(_without_losses(system))
    unknowns: Unknowns = jax.device_put(initial_unknowns(prepared.problem, plan, dtype))
    ready = time.perf_counter()
    run = compiled(solver, unknowns, system, plain)
    started = time.perf_counter()

    state: State = run.init(unknowns, system)
    history = [HistoryStep(step=0, seconds=0.0, cost=float(state.cost), accepted=True, trust=float(state.trust))]
    initial_plain_cost = np.asarray(run.cost(plain, unknowns))
    interrupted = False
    try:
        while int(state.status) == RUNNING and len(history) <= max_nfev:
            reached = run.step(unknowns, state, system)
            entry = _history_step(len(history), started, jax.device_get(reached[1]))
            (unknowns, state), _ = reached, history.append(entry)
            if callback is not None:
                callback(history[-1])
    except KeyboardInterrupt:
        interrupted = True
    report = Report(
        history=tuple(history),
        dropped=prepared.dropped,
        seconds_setup=ready - begin,
        seconds_compile=started - ready,
        seconds_solve=time.perf_counter() - started,
        linear_solver=plan.shape.linear_solver,
        interrupted=interrupted,
        problem=prepared.problem,
    )
    values = restore(to_host(unknowns), prepared.problem, plan)
    return Solution(
        poses=values.poses,
        cameras=type(problem.cameras).from_parameters(values.intrinsics),
        points=values.points,
        lever_arm=values.lever_arm,
        initial_cost=np.asarray(history[0].cost),
        final_cost=np.asarray(state.cost),
        initial_plain_cost=initial_plain_cost,
        plain_cost=np.asarray(run.cost(plain, unknowns)),
        status=np.asarray(state.status),
        num_steps=np.asarray(len(history) - 1),
        report=report,
    )


def _history_step(step: int, started: float, state: State) -> HistoryStep:
    return HistoryStep(
        step=step,
        seconds=time.perf_counter() - started,
        cost=float(state.cost),
        accepted=bool(state.accepted),
        change=float(state.change),
        gradient=float(state.gradient_norm),
        step_norm=float(state.step_norm),
        trust=float(state.trust),
        linear_iterations=int(state.linear_iterations),
        points_held=int(state.points_held),
    )


def _solve_traced(
    problem: Problem, loss: AbstractLoss, solver: AbstractSchurSolver, plan: Plan, max_nfev: int
) -> Solution:
    problem, loss = eqxi.nondifferentiable((problem, loss), msg=_NO_DERIVATIVE)
    dtype = jnp.result_type(float)
    system = make_system(problem, plan, loss, dtype)
    plain = _without_losses(system)
    start = initial_unknowns(problem, plan, dtype)
    found = optx.least_squares(residuals, solver, start, args=system, max_steps=max_nfev, throw=False)
    values = restore(found.value, problem, plan)
    return Solution(
        poses=values.poses,
        cameras=type(problem.cameras).from_parameters(values.intrinsics),
        points=values.points,
        lever_arm=values.lever_arm,
        initial_cost=cost(system, start),
        final_cost=found.stats["cost"],
        initial_plain_cost=cost(plain, start),
        plain_cost=cost(plain, found.value),
        status=found.stats["status"],
        num_steps=found.stats["num_steps"],
    )


def _without_losses(system: System) -> System:
    linear = tuple(dataclasses.replace(prior, loss=Linear()) for prior in system.priors)
    return dataclasses.replace(system, loss=Linear(), priors=linear)
