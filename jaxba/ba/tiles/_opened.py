"""A problem opened in tiles: its tree, its share of the memory and an engine, for as long as work on it goes on."""

import contextlib
import os
import tempfile
from collections.abc import Iterator, Sequence
from concurrent.futures import Executor, ThreadPoolExecutor
from pathlib import Path

import jax
import numpy as np
from threadpoolctl import threadpool_limits

from jaxba.ba._plan_shape import PlanShape, bare_shape
from jaxba.ba._problem import Problem
from jaxba.ba.tiles._budget import memory_limit, plan_memory
from jaxba.ba.tiles._dissect import dissect
from jaxba.ba.tiles._elsewhere import Elsewhere
from jaxba.ba.tiles._engine import Engine
from jaxba.ba.tiles._fronts import Fronts
from jaxba.geometry import AbstractLoss, require_number

TILE_OBSERVATIONS, EXECUTOR_MEMORY = 1e5, "2GB"


@contextlib.contextmanager
def opened(
    label: str,
    problem: Problem,
    loss: AbstractLoss,
    *,
    max_memory: float | str | None = None,
    max_observations: float = TILE_OBSERVATIONS,
    num_tiles: int = 1,
    folder: str | os.PathLike[str] | None = None,
    workers: int | None = None,
    inverse: bool = False,
    columns: int = 1,
    executors: Sequence[Executor] | None = None,
    executor_memory: float | str = EXECUTOR_MEMORY,
    like: PlanShape | None = None,
) -> Iterator[Engine]:
    """Yield the engine of a problem that was checked, in double precision; its files are gone at the end.

    - `label`: of the function that asks, for messages. `max_memory` to `workers`, `executors`: see
      `solve_tiled`.
    - `inverse`: whether its inverse is asked for, which takes more memory than steps do. `columns`: right-hand sides.
    - `like`: of an earlier plan; a problem in one tile shares what was compiled for it.

    Raises `JaxbaError` for options out of range, and where memory does not suffice.
    """
    require_number(f"{label}: max_observations", max_observations, 1.0, np.inf, "give a number of observations")
    require_number(f"{label}: num_tiles", num_tiles, 1.0, 2.0**31 - 1, "give a whole number, 1 or more", whole=True)
    workers = (os.cpu_count() or 1) if workers is None else workers
    require_number(f"{label}: workers", workers, 1.0, 1024.0, "give a whole number, 1 or more", whole=True)
    limit = memory_limit(label, max_memory)
    shape = bare_shape(problem)
    with (
        jax.enable_x64(True),
        threadpool_limits(1, user_api="blas"),
        tempfile.TemporaryDirectory(prefix="jaxba-", dir=folder) as files,
        ThreadPoolExecutor(int(workers)) as pool,
    ):
        tree = dissect(
            problem, block=shape.block, border=shape.border, max_observations=max_observations, num_tiles=int(num_tiles)
        )
        fronts = Fronts(tree, shape.block, shape.border, columns)
        of_tiles = np.bincount(tree.tile_of_point[np.asarray(problem.observations.point_index)])
        work = fronts.bytes_in_inverse() if inverse else fronts.bytes_in_work(int(workers))
        budget = plan_memory(label, problem, fronts, limit, float(of_tiles.max()), int(workers), work)
        elsewhere = None
        if executors is not None:
            kept = memory_limit(label, executor_memory, "executor_memory")
            elsewhere = Elsewhere(label, executors, Path(files).absolute(), kept)
        yield Engine(problem, loss, tree, fronts, budget, Path(files), pool, int(workers), elsewhere, like)
