"""`solve_batch`: many problems of any sizes, each adjusted on its own, with few programs to compile.

Problems of one kind (camera model, what is free, priors, way to solve the reduced system) are sorted by size and padded
to the shapes of the largest of their group. Threads work on them, a problem each: XLA spreads the work on a small
problem badly over the cores, and a batch under `vmap` steps until its last problem has converged.
"""

import dataclasses
import functools
import os
import threading
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import jax
import numpy as np
from threadpoolctl import threadpool_limits

from jaxba._errors import JaxbaError
from jaxba.ba._plan import Plan, make_plan
from jaxba.ba._plan_shape import alike, larger
from jaxba.ba._problem import Problem
from jaxba.ba._solution import HistoryStep, Solution
from jaxba.ba._solve import SOLVERS, Method, solve, solve_prepared
from jaxba.ba._solvers import require_stops
from jaxba.ba._system import is_traced
from jaxba.ba.checks import Prepared, prepare
from jaxba.geometry import AbstractLoss, Linear, check_loss, require_number

_LIKE = 0.6  # of the observations of the largest problem of a group: smaller ones get shapes of their own


def solve_batch(
    problems: Sequence[Problem],
    *,
    loss: AbstractLoss | None = None,
    method: Method = "lm",
    max_nfev: int = 500,
    ftol: float = 1e-8,
    xtol: float = 1e-8,
    gtol: float = 1e-10,
    workers: int | None = None,
    callback: Callable[[int, Solution], None] | None = None,
) -> list[Solution]:
    """Adjust many problems, each on its own, and return their solutions in order.

    - `loss`, `method`, `max_nfev`, `ftol`, `xtol`, `gtol`: as in `solve`, for all of them.
    - `workers`: problems that are worked on at a time; as many as there are cores if None. It does not change results.
    - `callback`: called with a problem's place and its solution as soon as these are known, in any order and by any
      thread.

    Every solution is the one of `solve`, with a report of its own. Where values are traced, as in derivatives, the
    problems are solved one after another. Ctrl-C ends the batch within a step, and so does an error of the callback.

    Raises `JaxbaError` as `solve` does, before anything is solved, and says for which problem.

    >>> import jaxba
    >>> problems = [jaxba.synthetic.uav_block(n, seed=n).problem for n in (8, 9)]
    >>> [solution.converged for solution in jaxba.solve_batch(problems)]
    [True, True]
    """
    loss = Linear() if loss is None else loss
    check_loss("solve_batch: loss", loss)
    if method not in SOLVERS:
        raise JaxbaError(f"solve_batch: method {method!r}: choose one of {', '.join(SOLVERS)}.")
    max_nfev = require_stops("solve_batch", max_nfev=max_nfev, ftol=ftol, xtol=xtol, gtol=gtol)
    stops: dict[str, Any] = {"max_nfev": max_nfev, "ftol": ftol, "xtol": xtol, "gtol": gtol}
    workers = (os.cpu_count() or 1) if workers is None else workers
    require_number("solve_batch: workers", workers, 1.0, 1024.0, "give a whole number, 1 or more", whole=True)
    if is_traced((problems, loss)):
        return [solve(problem, loss=loss, method=method, **stops) for problem in problems]

    solver = SOLVERS[method](rtol=float(ftol), atol=float(gtol), xtol=float(xtol))
    work = _arranged(problems)
    solutions: dict[int, Solution] = {}
    stopped = threading.Event()

    def go_on(_: HistoryStep) -> None:
        if stopped.is_set():
            raise KeyboardInterrupt  # which ends this thread's solve

    def adjust(number: int) -> None:
        prepared, plan, seconds = work[number]
        with jax.enable_x64(True):  # of this thread
            begun = time.perf_counter() - seconds
            solution = solve_prepared(prepared, plan, loss, solver, max_nfev, np.float64, go_on, begun)
        solutions[number] = solution
        if callback is not None and solution.result != "interrupted":
            callback(number, solution)

    first_of_shape = {plan.shape: number for number, (_, plan, _) in reversed(list(enumerate(work)))}
    with threadpool_limits(1, user_api="blas"), ThreadPoolExecutor(int(workers)) as pool:
        try:
            firsts = sorted(first_of_shape.values())
            for numbers in (firsts, sorted(set(range(len(work))) - set(firsts))):
                list(pool.map(adjust, numbers))  # the first of each shape compiles for the others
        except BaseException:
            stopped.set()
            raise
    return [solutions[number] for number in range(len(work))]


def _arranged(problems: Sequence[Problem]) -> list[tuple[Prepared, Plan, float]]:
    """Return each problem checked, with a plan of its group's shape, and the seconds that this took."""
    checked: list[tuple[Prepared, Plan, float]] = []
    for number, problem in enumerate(problems):
        begun = time.perf_counter()
        try:
            prepared = prepare(problem)
        except JaxbaError as error:
            raise JaxbaError(f"solve_batch: problem {number} of {len(problems)}: {error}") from error
        checked.append((prepared, make_plan(prepared.problem), time.perf_counter() - begun))
    kinds: dict[Any, list[int]] = {}
    for number, (prepared, plan, _) in enumerate(checked):
        kinds.setdefault(_kind(prepared.problem, plan), []).append(number)
    for numbers in kinds.values():
        for group in alike([checked[number][0].problem.num_observations for number in numbers], _LIKE):
            of_group = [numbers[k] for k in group]
            shape = functools.reduce(larger, (checked[number][1].shape for number in of_group))
            for number in of_group:
                prepared, plan, seconds = checked[number]
                begun = time.perf_counter()
                if plan.shape != shape:
                    plan = make_plan(prepared.problem, like=shape)
                checked[number] = prepared, plan, seconds + time.perf_counter() - begun
    return checked


def _kind(problem: Problem, plan: Plan) -> tuple[Any, ...]:
    """Return what problems must have in common to share a program."""
    shape = plan.shape
    sizes = {name: 0 for name in ("num_images", "num_points", "num_rows", "chunk_runs", "num_pair_runs", "num_blocks")}
    flags = {"any_fixed_pose": False, "any_fixed_point": False}
    cameras = 0 if shape.own_cameras else shape.num_cameras
    bare = dataclasses.replace(shape, **sizes, **flags, num_cameras=cameras, band_panels=0, prior_rows=())
    priors = tuple((type(prior), type(prior.loss), jax.tree.structure(prior.loss)) for prior in problem.priors)
    return bare, type(problem.cameras), priors
