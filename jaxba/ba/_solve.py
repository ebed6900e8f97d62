"""`solve`: adjust a problem from its start values.

On concrete values a host loop calls the solver's compiled `init` and `step`: it reports progress, can be interrupted
with what was reached kept, and times every step without the compile. Inside `jit` and `vmap` the same solver runs in
`optimistix.least_squares`; where the problem's indices are traced, too, its structure must be known beforehand, as a
`Plan` made with `make_plan`. Derivatives are those of the optimum (`_adjoint.py`), whichever of the two found it.
"""

import time
from collections.abc import Callable
from typing import Any, Literal, get_args

import jax
import numpy as np
from threadpoolctl import threadpool_limits

from jaxba._errors import JaxbaError
from jaxba.ba._adjoint import Adjoint
from jaxba.ba._descend import descend
from jaxba.ba._plan import LinearSolver, Plan
from jaxba.ba._plan_shape import PlanShape
from jaxba.ba._problem import Problem
from jaxba.ba._solution import HistoryStep, Report, Solution
from jaxba.ba._solvers import AbstractSchurSolver, SchurDogleg, SchurLevenbergMarquardt, require_stops
from jaxba.ba._system import (
    System,
    centred,
    from_centred,
    initial_unknowns,
    is_traced,
    make_system,
    restore,
    structured,
)
from jaxba.ba._traced import solve_traced
from jaxba.ba._unknowns import Unknowns
from jaxba.ba.checks import Prepared, prepare
from jaxba.ba.parts._solve import is_for_parts, solve_in_parts
from jaxba.ba.tiles._solve_tiled import in_tiles
from jaxba.geometry import AbstractLoss, Linear, check_loss

Method = Literal["lm", "dogleg"]
SOLVERS: dict[str, type[SchurLevenbergMarquardt] | type[SchurDogleg]] = {
    "lm": SchurLevenbergMarquardt,
    "dogleg": SchurDogleg,
}

_TILES_FROM = 1000  # images


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
    plan: Plan | PlanShape | None = None,
    adjoint: Adjoint = "implicit",
    callback: Callable[[HistoryStep], None] | None = None,
) -> Solution:
    """Adjust a problem and return the solution; the problem is left as it is.

    - `loss`: robust loss of the reprojections, in units of their sigma; least squares if None. Priors carry their own.
    - `method`: `lm`, Levenberg-Marquardt, or `dogleg`.
    - `linear_solver`: how the reduced system is solved; `auto` chooses from its size and bandwidth, and solves large
      blocks by `solve_tiled`, which reaches the same solution faster, and in the memory that is free.
    - `max_nfev`: the most steps tried. `ftol`: stop when the cost changes by less than this share. `xtol`: when all
      unknowns together move what the images see by less than so many radians. `gtol`: when no entry of the gradient is
      larger, as in scipy.
    - `plan`: the problem's structure, made by `make_plan`; needed where the problem's indices are traced. Where
      something is left out of the problem, a new plan of the same sizes takes its place. A plan's shape in its place
      gives the least sizes, so that like problems share what is compiled.
    - `adjoint`: how derivatives are taken. `implicit`: of the optimum, exact. `gauss_newton`: the same with J^T J in
      place of the second derivatives, off by as much as residuals and losses bend. `unrolled`: backwards through the
      solver's steps, whose memory grows with their number; reverse mode alone, without bounds.
    - `callback`: called after every step.

    Raises `JaxbaError` for a problem that cannot be solved and for options out of range, naming what is wrong. What is
    left out instead (points seen once, points behind their camera) is counted in `solution.report.dropped`. Ctrl-C
    returns what was reached so far.

    >>> import jaxba
    >>> survey = jaxba.synthetic.uav_block(8)
    >>> solution = jaxba.solve(survey.problem)
    >>> solution.converged, bool(solution.final_cost < solution.initial_cost)
    (True, True)
    """
    loss = Linear() if loss is None else loss
    check_loss("solve: loss", loss)
    for name, value, choices in (
        ("method", method, tuple(SOLVERS)),
        ("linear_solver", linear_solver, get_args(LinearSolver)),
        ("adjoint", adjoint, get_args(Adjoint)),
        ("dtype", _name_of(dtype), ("float64", "float32")),
    ):
        if value not in choices:
            raise JaxbaError(f"solve: {name} {value!r}: choose one of {', '.join(choices)}.")
    max_nfev = require_stops("solve", max_nfev=max_nfev, ftol=ftol, xtol=xtol, gtol=gtol)
    solver = SOLVERS[method](rtol=float(ftol), atol=float(gtol), xtol=float(xtol))
    if is_traced((problem, loss)):
        return solve_traced(problem, loss, solver, plan, linear_solver, adjoint, max_nfev, callback)
    usual = linear_solver == "auto" and plan is None and _name_of(dtype) == "float64"
    if usual and isinstance(solver, SchurLevenbergMarquardt) and problem.num_images >= _TILES_FROM:
        return in_tiles("solve", problem, loss, solver, max_nfev, callback, None, {})
    # OpenBLAS's threads fight with XLA's for the cores (with them a 144 x 144 Cholesky took 204 ms instead of 0.16 ms),
    # so OpenBLAS gets one thread for as long as this runs
    with jax.enable_x64(True), threadpool_limits(1, user_api="blas"):
        return _solve_on_host(problem, loss, solver, plan, linear_solver, max_nfev, dtype, callback)


def _name_of(dtype: Any) -> str:
    try:
        return np.dtype(dtype).name if dtype is not None else "None"
    except TypeError:
        return str(dtype)


def _solve_on_host(
    problem: Problem,
    loss: AbstractLoss,
    solver: AbstractSchurSolver,
    plan: Plan | PlanShape | None,
    linear_solver: LinearSolver,
    max_nfev: int,
    dtype: Any,
    callback: Callable[[HistoryStep], None] | None,
) -> Solution:
    begun = time.perf_counter()
    if not isinstance(plan, Plan) and is_for_parts(problem, solver, linear_solver):
        return solve_in_parts(prepare(problem), plan, linear_solver, loss, solver, max_nfev, dtype, callback, begun)
    prepared, plan = structured(problem, plan, linear_solver)
    return solve_prepared(prepared, plan, loss, solver, max_nfev, dtype, callback, begun)


def solve_prepared(
    prepared: Prepared,
    plan: Plan,
    loss: AbstractLoss,
    solver: AbstractSchurSolver,
    max_nfev: int,
    dtype: Any,
    callback: Callable[[HistoryStep], None] | None,
    begun: float,
) -> Solution:
    """Return the solution of a problem that was checked, in double precision and with one thread of BLAS as `solve`.

    - `begun`: when its checks began, by `time.perf_counter`.
    """
    problem = prepared.problem
    near, origin = centred(problem)
    system: System = jax.device_put(make_system(near, plan, loss, dtype))
    start: Unknowns = jax.device_put(initial_unknowns(near, plan, dtype))
    seconds_setup = time.perf_counter() - begun
    reached = descend(solver, start, system, max_nfev, callback)
    report = Report(
        history=tuple(reached.history),
        dropped=prepared.dropped,
        seconds_setup=seconds_setup,
        seconds_compile=reached.seconds_compile,
        seconds_solve=reached.seconds_solve,
        linear_solver=plan.shape.linear_solver,
        interrupted=reached.interrupted,
        problem=problem,
    )
    plain = reached.plain_cost
    costs = reached.history[0].cost, reached.state.cost, plain(start), plain(reached.unknowns)
    on_host = jax.tree.map(np.asarray, (reached.unknowns, costs, reached.state.status, reached.state.num_steps))
    unknowns, costs, status, num_steps = on_host
    values = from_centred(restore(unknowns, plan), origin)
    return Solution.of(problem, values, costs, status, num_steps, report)
