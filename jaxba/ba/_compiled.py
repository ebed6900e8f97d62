"""Compile a solver's functions for the shapes of a system, once a process.

`jax.jit` keeps what it has compiled, but does not tell a first call's compile time from its running time; here the two
are apart. jax's persistent cache, where it is switched on, keeps the result across processes.
"""

import functools
import math
from concurrent.futures import ThreadPoolExecutor
from typing import Any, NamedTuple

import equinox as eqx
import jax
from jax import Array
from jaxtyping import Float

from jaxba.ba._compiler import compiler_options
from jaxba.ba._linearise import cost
from jaxba.ba._rows import Unknowns
from jaxba.ba._solvers import AbstractSchurSolver, State
from jaxba.ba._system import System

_KEPT = 32


class Compiled(NamedTuple):
    """Compiled functions: `init(unknowns, system)`, `step(unknowns, state, system)` and `cost(system, unknowns)`."""

    init: jax.stages.Compiled
    step: jax.stages.Compiled
    cost: jax.stages.Compiled


def compiled(solver: AbstractSchurSolver, unknowns: Unknowns, system: System, plain: System) -> Compiled:
    """Return the solver's functions for these arguments' shapes; `plain` is the system without robust losses."""
    leaves, structure = jax.tree.flatten((unknowns, system, plain))
    shapes = tuple((leaf.shape, leaf.dtype.name) for leaf in leaves)
    return _compile(solver, structure, shapes)


_SMALL = 3_000_000  # entries of all arrays


@functools.lru_cache(maxsize=_KEPT)
def _compile(solver: AbstractSchurSolver, structure: Any, shapes: tuple[tuple[tuple[int, ...], str], ...]) -> Compiled:
    arguments = [jax.ShapeDtypeStruct(shape, dtype) for shape, dtype in shapes]
    unknowns, system, plain = jax.tree.unflatten(structure, arguments)

    def init(unknowns: Unknowns, system: System) -> State:
        return solver.init(None, unknowns, system, None, None, None, frozenset())

    def step(unknowns: Unknowns, state: State, system: System) -> tuple[Unknowns, State]:
        return solver.step(None, unknowns, system, None, state, frozenset())[:2]

    def plain_cost(system: System, unknowns: Unknowns) -> Float[Array, ""]:
        return cost(system, unknowns)

    state = eqx.filter_eval_shape(init, unknowns, system)
    lowered = (
        jax.jit(step).lower(unknowns, state, system),
        jax.jit(init).lower(unknowns, system),
        jax.jit(plain_cost).lower(plain, unknowns),
    )
    # the steps of a large program run long enough to pay for the optimisations
    small = sum(math.prod(shape) for shape, _ in shapes) < _SMALL
    options = compiler_options() if small else {}
    with ThreadPoolExecutor(2) as pool:  # XLA compiles a program on one core
        of_step, of_init, of_cost = pool.map(lambda one: one.compile(compiler_options=options), lowered)
    return Compiled(init=of_init, step=of_step, cost=of_cost)
