"""Budget: what work in tiles needs of the memory that it may use, told before it begins.

Held throughout: the problem, and unknowns of all images and points. A tile that is worked on takes some
`_BYTES_PER_OBSERVATION` and its fronts; on the way up, the fronts that wait for their parents lie in memory as well.
What is left holds systems, factors and equations; systems and factors that do not fit lie in files, equations are
computed again.
"""

from typing import NamedTuple

from jaxba._errors import JaxbaError
from jaxba._sizes import bytes_of, free_memory, machine_memory, size_text, used_memory
from jaxba.ba._problem import Problem
from jaxba.ba.tiles._fronts import Fronts

_BYTES_PER_OBSERVATION = 1300.0  # of a tile in work: equations, W and Z, pairs
_BYTES_PER_POINT = 200.0  # of all points: unknowns before and after, and in turn those of the tiles
_COMPILED = 3e8  # compiled programs and what XLA keeps
_SHARE = 0.8  # of the free memory, where no limit is given
_USED = 0.8  # of what is left: the allocator keeps some of it in pieces
_SYSTEM = 130.0  # bytes an observation in a system


class Budget(NamedTuple):
    """Bytes: `shelf` for systems and factors, `models` for equations, `idle` for memory that waits to be used again."""

    shelf: float
    models: float
    idle: float


def memory_limit(label: str, max_memory: float | str | None, option: str = "max_memory") -> float:
    """Return the bytes that a process may hold, of which `option` is given.

    Raises `JaxbaError` for what is no amount.
    """
    if max_memory is None:
        return used_memory() + _SHARE * free_memory()
    limit = bytes_of(max_memory, machine_memory())
    if not limit >= 1e8:
        raise JaxbaError(
            f"{label}: {option} {max_memory!r}: give an amount from 100MB such as 4GB, or a share of the "
            "machine's memory such as 0.5."
        )
    return limit


def plan_memory(
    label: str,
    problem: Problem,
    fronts: Fronts,
    limit: float,
    tile_observations: float,
    workers: int,
    fronts_in_work: float,
) -> Budget:
    """Return how the memory is shared out.

    - `limit`: bytes that the process may hold. `tile_observations`: of the largest tile.
    - `fronts_in_work`: bytes that fronts take at a time.

    Raises `JaxbaError` where that is too little to work at all.
    """
    held = used_memory() + _COMPILED + _BYTES_PER_POINT * problem.num_points
    work = workers * _BYTES_PER_OBSERVATION * tile_observations + fronts_in_work
    left = _USED * (limit - held - work)
    if left < 0:
        raise JaxbaError(
            f"{label}: {size_text(held + work)} are needed: {size_text(held)} for the problem with "
            f"{problem.num_points:,} points and what is loaded, {size_text(work)} for {workers} tiles of up to "
            f"{tile_observations:,.0f} observations in work and the fronts between them. {size_text(limit)} are "
            f"allowed; give more max_memory (--max-memory of a command), fewer workers or smaller tiles "
            "(max_observations)."
        )
    systems, factors = _SYSTEM * problem.num_observations, fronts.bytes_of_factors()
    idle = 0.2 * left
    shelf = min(left - idle, systems + factors)
    return Budget(shelf, max(left - idle - shelf, 0.0), idle)
