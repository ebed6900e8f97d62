"""`solve_tiled`: the adjustment of `solve`, tile by tile, in as much memory as it is given."""

import os
import time
from collections.abc import Callable, Sequence
from concurrent.futures import Executor
from typing import Any

import jax.numpy as jnp
import numpy as np

from jaxba.ba._descend import walk
from jaxba.ba._problem import Problem
from jaxba.ba._solution import HistoryStep, Report, Solution
from jaxba.ba._solvers import RUNNING, SchurLevenbergMarquardt, require_stops
from jaxba.ba._system import centred, from_centred, is_traced, own_unknowns
from jaxba.ba.checks import prepare
from jaxba.ba.tiles._checkpoint import Checkpoint, Standing
from jaxba.ba.tiles._opened import EXECUTOR_MEMORY, TILE_OBSERVATIONS, opened
from jaxba.ba.tiles._reversible import solve_reversibly
from jaxba.ba.tiles._step import Stepper
from jaxba.geometry import AbstractLoss, Linear, check_loss


def solve_tiled(
    problem: Problem,
    *,
    loss: AbstractLoss | None = None,
    max_memory: float | str | None = None,
    max_observations: float = TILE_OBSERVATIONS,
    num_tiles: int = 1,
    folder: str | os.PathLike[str] | None = None,
    workers: int | None = None,
    checkpoint: str | os.PathLike[str] | None = None,
    max_nfev: int = 500,
    ftol: float = 1e-8,
    xtol: float = 1e-8,
    gtol: float = 1e-10,
    callback: Callable[[HistoryStep], None] | None = None,
    on_tile: Callable[[int, int], None] | None = None,
    executors: Sequence[Executor] | None = None,
    executor_memory: float | str = EXECUTOR_MEMORY,
) -> Solution:
    """Adjust a problem in tiles: the same steps, and the same solution, as `solve` with Levenberg-Marquardt.

    Blocks of more than some thousand images are faster so, and need no more memory than `max_memory`.

    - `loss`, `max_nfev`, `ftol`, `xtol`, `gtol`, `callback`: as in `solve`.
    - `max_memory`: that the process may hold, as bytes, as a text such as `4GB`, or as a share of the machine's; 80% of
      what is free if None. What does not fit lies in files meanwhile.
    - `max_observations`: of a tile. `num_tiles`: at least so many tiles.
    - `folder`: for these files; the system's own for such files if None. They are gone at the end.
    - `workers`: tiles that are worked on at a time; as many as there are cores if None. It does not change the result.
    - `checkpoint`: a file that holds where the solve stands after each step. A call that finds it goes on from there,
      to the same bytes as without a break; it is gone when the solve has ended by itself. In a folder each solve has a
      file of its own, which stays: the same call then finds the solution there.
    - `on_tile`: called with how many tiles of a step are done, each once on the way up and once down, and of how many.
    - `executors`: of `concurrent.futures`, whose processes work on the tiles in place of threads of this one; they must
      see `folder`. One a process is best, since each then keeps what it needs of its tiles again: several times
      `ProcessPoolExecutor(1, get_context("spawn"))`, or `client.get_executor(workers=[address],
      allow_other_workers=True)` for each worker of dask. A process that is lost costs no more than its work. The bytes
      of the result are the same by processors of one kind.
    - `executor_memory`: what each of their processes keeps of tiles, beside the ones in work; the rest lies in files.

    Raises `JaxbaError` as `solve` does, and where memory or disk do not suffice.

    `jax.grad` goes through it, tile by tile: the derivative is that of `solve`, in reverse mode alone, and not inside
    `jit` or `vmap`. It is taken in this process. `max_memory` is planned for steps; the gradient of a tile takes more.

    >>> import jaxba
    >>> survey = jaxba.synthetic.uav_block(30)
    >>> whole, tiled = jaxba.solve(survey.problem), jaxba.solve_tiled(survey.problem, num_tiles=2)
    >>> bool(abs(whole.final_cost - tiled.final_cost) < 1e-9 * whole.final_cost)
    True
    """
    loss = Linear() if loss is None else loss
    check_loss("solve_tiled: loss", loss)
    max_nfev = require_stops("solve_tiled", max_nfev=max_nfev, ftol=ftol, xtol=xtol, gtol=gtol)
    solver = SchurLevenbergMarquardt(rtol=float(ftol), atol=float(gtol), xtol=float(xtol))

    room: dict[str, Any] = {
        "max_memory": max_memory,
        "max_observations": max_observations,
        "num_tiles": num_tiles,
        "folder": folder,
        "workers": workers,
    }

    def on_host(problem: Problem, loss: AbstractLoss) -> Solution:
        of_steps = {**room, "executors": executors, "executor_memory": executor_memory}
        return in_tiles("solve_tiled", problem, loss, solver, max_nfev, callback, checkpoint, of_steps, on_tile)

    if is_traced((problem, loss)):
        return solve_reversibly(
            problem, loss, on_host, lambda problem, loss: opened("solve_tiled", problem, loss, **room)
        )
    return on_host(problem, loss)


def in_tiles(
    label: str,
    problem: Problem,
    loss: AbstractLoss,
    solver: SchurLevenbergMarquardt,
    max_nfev: int,
    callback: Callable[[HistoryStep], None] | None,
    checkpoint: str | os.PathLike[str] | None,
    room: dict[str, Any],
    on_tile: Callable[[int, int], None] | None = None,
) -> Solution:
    """Return the solution, for the function named `label`; `room` are options of `opened`."""
    begun = time.perf_counter()
    stops = float(max_nfev), solver.rtol, solver.atol, solver.xtol
    kept = None if checkpoint is None else Checkpoint(checkpoint, problem, loss, stops)
    standing = None if kept is None else kept.load()
    prepared = prepare(problem)
    problem = prepared.problem
    near, origin = centred(problem)
    with opened(label, near, loss, **room) as engine:
        start = own_unknowns(near)
        set_up = time.perf_counter()
        stepper = Stepper(engine, solver, on_tile)
        if engine.elsewhere is None and (standing is None or int(standing.state.status) == RUNNING):
            stepper.compile(start)
        compiled = time.perf_counter()
        costs = engine.costs(start)
        if standing is None:
            standing = Standing(start, solver.state_of(jnp.asarray(costs[0])), ())
        found, state, history, interrupted = walk(
            standing.unknowns,
            standing.state,
            stepper.step,
            max_nfev,
            callback,
            before=standing.history,
            save=None if kept is None else kept.save,
        )
        if kept is not None and not interrupted:
            kept.end()
        costs = (costs[0], state.cost, costs[1], engine.costs(found)[1])
    report = Report(
        history=tuple(history),
        dropped=prepared.dropped,
        seconds_setup=set_up - begun,
        seconds_compile=compiled - set_up,
        seconds_solve=time.perf_counter() - compiled,
        linear_solver="tiles",
        interrupted=interrupted,
        problem=problem,
    )
    on_host = [np.asarray(value) for value in (*costs, state.status, state.num_steps)]
    return Solution.of(problem, from_centred(found, origin), on_host[:4], on_host[4], on_host[5], report)
