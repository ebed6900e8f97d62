"""Descend: a solver compiled for the shapes of a system, once a process, and the host's loop over its steps.

`jax.jit` keeps what it has compiled, but does not tell a first call's compile time from its running time; here the two
are apart. jax's persistent cache, where it is switched on, keeps the result across processes.
"""

import functools
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any, NamedTuple, TypeVar

import equinox as eqx
import jax
from jax import Array
from jaxtyping import Float

from jaxba._errors import JaxbaError
from jaxba._sizes import free_memory, size_text
from jaxba.ba._compiler import compiler_options, platform
from jaxba.ba._kept_programs import program
from jaxba.ba._linearise import cost
from jaxba.ba._solution import HistoryStep
from jaxba.ba._solvers import RUNNING, AbstractSchurSolver, State, take_numbers
from jaxba.ba._system import System, without_losses
from jaxba.ba._unknowns import Unknowns

_KEPT = 32
_SURELY_FREE = 1e8  # bytes

_Unknowns = TypeVar("_Unknowns")


class Reached(NamedTuple):
    """Where the loop stopped and how it got there.

    - `plain_cost`: the cost of unknowns without the losses.
    """

    unknowns: Unknowns
    state: State
    history: list[HistoryStep]
    interrupted: bool
    plain_cost: Callable[[Unknowns], Float[Array, ""]]
    seconds_compile: float
    seconds_solve: float


def descend(
    solver: AbstractSchurSolver,
    start: Unknowns,
    system: System,
    max_nfev: int,
    callback: Callable[[HistoryStep], None] | None = None,
) -> Reached:
    """Step until the solver has converged or `max_nfev` steps were tried; Ctrl-C ends it with what was reached."""
    begun = time.perf_counter()
    plain: System = jax.device_put(without_losses(system))
    run = compiled(solver, start, system, plain)
    require_memory(run.step_bytes)
    compiled_at = time.perf_counter()

    def step(unknowns: Unknowns, state: State) -> tuple[Unknowns, State]:
        return run.step(unknowns, state, system)

    walked = walk(start, run.init(start, system), step, max_nfev, callback)
    seconds = compiled_at - begun, time.perf_counter() - compiled_at
    return Reached(*walked, functools.partial(run.cost, plain), *seconds)


def require_memory(need: float) -> None:
    """Raise `JaxbaError` where a step needs more memory than is free, in place of XLA's own error."""
    if need < _SURELY_FREE or platform() != "cpu":
        return
    free = free_memory()
    if need > free:
        raise JaxbaError(
            f"solve: a step needs {size_text(need)} of memory, and {size_text(free)} are free. Solve in tiles: "
            "jaxba.solve_tiled(problem, max_memory=...), or --tiled on the command line, takes the same steps in less."
        )


def walk(
    unknowns: _Unknowns,
    state: State,
    step: Callable[[_Unknowns, State], tuple[_Unknowns, State]],
    max_nfev: int,
    callback: Callable[[HistoryStep], None] | None = None,
    *,
    before: Sequence[HistoryStep] = (),
    save: Callable[[_Unknowns, State, list[HistoryStep]], None] | None = None,
) -> tuple[_Unknowns, State, list[HistoryStep], bool]:
    """Step as `descend` does; return where it stopped, what it tried, and whether Ctrl-C ended it.

    - `before`: what an earlier call tried, if this one goes on from there. `save`: called after each step.
    """
    begun = time.perf_counter() - (before[-1].seconds if before else 0.0)
    first = HistoryStep(step=0, seconds=0.0, cost=float(state.cost), accepted=True, trust=float(state.trust))
    history = list(before) or [first]
    interrupted = False
    try:
        while int(state.status) == RUNNING and len(history) <= max_nfev:
            reached = step(unknowns, state)
            entry = _history_step(len(history), begun, jax.device_get(reached[1]))
            (unknowns, state), _ = reached, history.append(entry)
            if save is not None:
                save(unknowns, state, history)
            if callback is not None:
                callback(history[-1])
    except KeyboardInterrupt:
        interrupted = True
    return unknowns, state, history, interrupted


class Compiled(NamedTuple):
    """Compiled functions: `init(unknowns, system)`, `step(unknowns, state, system)` and `cost(system, unknowns)`.

    - `step_bytes`: what a step takes beside its arguments.
    """

    init: Callable[..., State]
    step: Callable[..., tuple[Unknowns, State]]
    cost: Callable[[System, Unknowns], Float[Array, ""]]
    step_bytes: float


def compiled(solver: AbstractSchurSolver, unknowns: Unknowns, system: System, plain: System) -> Compiled:
    """Return the solver's functions for these arguments' shapes; `plain` is the system without robust losses.

    Solvers that differ in tolerances or their first trust share them.
    """
    numbers, rest = take_numbers(solver, unknowns.points.dtype)
    leaves, structure = jax.tree.flatten((numbers, unknowns, system, plain))
    shapes = tuple((leaf.shape, leaf.dtype.name) for leaf in leaves)
    run = _compile(rest, structure, shapes, platform())
    return run._replace(init=functools.partial(run.init, numbers), step=functools.partial(run.step, numbers))


@functools.lru_cache(maxsize=_KEPT)
def _compile(
    rest: AbstractSchurSolver, structure: Any, shapes: tuple[tuple[tuple[int, ...], str], ...], _: str
) -> Compiled:
    """Return the functions; `init` and `step` take the solver's numbers first."""
    arguments = [jax.ShapeDtypeStruct(shape, dtype) for shape, dtype in shapes]
    numbers, unknowns, system, plain = jax.tree.unflatten(structure, arguments)

    def init(numbers: AbstractSchurSolver, unknowns: Unknowns, system: System) -> State:
        return eqx.combine(numbers, rest).init(None, unknowns, system, None, None, None, frozenset())

    def step(numbers: AbstractSchurSolver, unknowns: Unknowns, state: State, system: System) -> tuple[Unknowns, State]:
        return eqx.combine(numbers, rest).step(None, unknowns, system, None, state, frozenset())[:2]

    def plain_cost(system: System, unknowns: Unknowns) -> Float[Array, ""]:
        return cost(system, unknowns)

    made = functools.partial(program, options=compiler_options(), made_from=rest)
    start = made(init, (numbers, unknowns, system))
    programs = made(step, (numbers, unknowns, start.result, system)), start, made(plain_cost, (plain, unknowns))
    with ThreadPoolExecutor(2) as pool:  # XLA compiles a program on one core
        of_step, of_init, of_cost = pool.map(lambda one: one.compiled(), programs)
    found = of_step.memory_analysis()
    step_bytes = 0.0 if found is None else float(found.temp_size_in_bytes + found.output_size_in_bytes)
    return Compiled(init=of_init, step=of_step, cost=of_cost, step_bytes=step_bytes)


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
