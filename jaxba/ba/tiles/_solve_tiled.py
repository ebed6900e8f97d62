"""`solve_tiled`: the adjustment of `solve`, tile by tile."""

import os
import time
from collections.abc import Callable

import jax
import numpy as np
from threadpoolctl import threadpool_limits

from jaxba.ba._descend import walk
from jaxba.ba._plan import bare_shape
from jaxba.ba._problem import Problem
from jaxba.ba._solution import HistoryStep, Report, Solution
from jaxba.ba._solvers import SchurLevenbergMarquardt
from jaxba.ba._system import centred, from_centred
from jaxba.ba._unknowns import Unknowns
from jaxba.ba.checks import prepare
from jaxba.ba.tiles._dissect import dissect
from jaxba.ba.tiles._engine import Engine
from jaxba.ba.tiles._shelf import Shelf
from jaxba.geometry import AbstractLoss, Linear, Pose, check_loss


def solve_tiled(
    problem: Problem,
    *,
    loss: AbstractLoss | None = None,
    num_tiles: int = 1,
    max_observations: float = 1e5,
    max_nfev: int = 500,
    ftol: float = 1e-8,
    xtol: float = 1e-8,
    gtol: float = 1e-10,
    callback: Callable[[HistoryStep], None] | None = None,
    workers: int = 2,
) -> Solution:
    loss = Linear() if loss is None else loss
    check_loss("solve_tiled: loss", loss)
    begun = time.perf_counter()
    prepared = prepare(problem)
    problem = prepared.problem
    near, origin = centred(problem)
    shape = bare_shape(near)
    solver = SchurLevenbergMarquardt(rtol=float(ftol), atol=float(gtol), xtol=float(xtol))
    with jax.enable_x64(True), threadpool_limits(1, user_api="blas"):
        tree = dissect(
            near, block=shape.block, border=shape.border, max_observations=max_observations, num_tiles=num_tiles
        )
        engine = Engine(near, loss, tree, shelf=Shelf(), models=Shelf(), workers=workers)
        start = own_unknowns(near)
        seconds_setup = time.perf_counter() - begun
        engine.compile()
        compiled_at = time.perf_counter()
        cost, plain = engine.costs(start)
        state = jax.device_get(solver.state_of(np.asarray(cost)))
        found, state, history, interrupted = walk(
            start, state, lambda unknowns, state: engine.step(solver, unknowns, state), max_nfev, callback
        )
        final_plain = engine.costs(found)[1]
    report = Report(
        history=tuple(history),
        dropped=prepared.dropped,
        seconds_setup=seconds_setup,
        seconds_compile=compiled_at - begun - seconds_setup,
        seconds_solve=time.perf_counter() - compiled_at,
        linear_solver="tiled",
        interrupted=interrupted,
        problem=problem,
    )
    costs = (cost, float(state.cost), plain, final_plain)
    on_host = [np.asarray(value) for value in (*costs, state.status, state.num_steps)]
    return Solution.of(problem, from_centred(found, origin), on_host[:4], on_host[4], on_host[5], report)


def own_unknowns(problem: Problem) -> Unknowns:
    """Return a problem's start values in its own order, as numpy arrays."""
    names = type(problem.cameras).parameter_names()
    intrinsics = np.stack([np.asarray(getattr(problem.cameras, name), float) for name in names], axis=-1)
    poses = Pose(np.array(problem.poses.quaternion, float), np.array(problem.poses.translation, float))
    return Unknowns(poses, intrinsics, np.array(problem.lever_arm, float), np.array(problem.points, float))
