"""Solve in parts: the steps of `solve`, of which each core takes its part.

XLA lets all cores work on one program, but hands them its pieces one by one, each some microseconds long: a step takes
no less time with two cores than with one. Programs that two threads call do not wait for each other.
"""

import functools
import time
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any, NamedTuple

import equinox as eqx
import jax
import numpy as np

from jaxba.ba._compiler import Shapes, compile_ahead, of_shapes, platform, result_shapes, shapes_of
from jaxba.ba._descend import require_memory, walk
from jaxba.ba._linearise import costs
from jaxba.ba._plan import LinearSolver
from jaxba.ba._plan_shape import PlanShape
from jaxba.ba._problem import Problem
from jaxba.ba._solution import HistoryStep, Report, Solution
from jaxba.ba._solvers import AbstractSchurSolver, SchurLevenbergMarquardt, State, take_numbers
from jaxba.ba._system import centred, from_centred, has_sigmas, own_unknowns
from jaxba.ba._unknowns import Unknowns
from jaxba.ba.checks import Prepared
from jaxba.ba.parts._deal import Dealt, deal_out
from jaxba.ba.parts._programs import go_up, judge, solve_joint
from jaxba.ba.tiles._programs import put_back
from jaxba.geometry import AbstractLoss

_NUM_PARTS = 2
_LEAST_OBSERVATIONS = 8192  # with fewer, a step takes some milliseconds in one piece


def is_for_parts(problem: Problem, solver: AbstractSchurSolver, linear_solver: LinearSolver) -> bool:
    """Return whether a problem is solved in parts: it does not depend on the number of cores, nor do the results."""
    usual = isinstance(solver, SchurLevenbergMarquardt) and linear_solver != "cg" and platform() == "cpu"
    return usual and problem.num_observations >= _LEAST_OBSERVATIONS and all(map(has_sigmas, problem.priors))


def solve_in_parts(
    prepared: Prepared,
    like: PlanShape | None,
    linear_solver: LinearSolver,
    loss: AbstractLoss,
    solver: AbstractSchurSolver,
    max_nfev: int,
    dtype: Any,
    callback: Callable[[HistoryStep], None] | None,
    begun: float,
) -> Solution:
    """Return the solution of a problem that was checked, as `solve_prepared` does.

    - `like`: the least sizes of the problem in one piece.
    """
    problem = prepared.problem
    near, origin = centred(problem)
    with ThreadPoolExecutor(_NUM_PARTS) as pool:
        dealt = deal_out(near, loss, _NUM_PARTS, linear_solver, dtype, like=like)
        own = own_unknowns(near)
        start: tuple[Unknowns, ...] = jax.device_put(tuple(part.take(own, dtype) for part in dealt.parts))
        set_up = time.perf_counter()
        run = _compile(len(start), *shapes_of((dealt.parts[0].system, start[0], dealt.joint)), platform())
        require_memory(run.step_bytes)
        compiled = time.perf_counter()
        stepper = _Stepper(dealt, run, take_numbers(solver, dtype)[0], pool)
        first = stepper.costs(start)
        state = jax.device_put(jax.tree.map(np.asarray, solver.state_of(jax.numpy.asarray(first[0]))))
        found, state, history, interrupted = walk(start, state, stepper.step, max_nfev, callback)
        last = stepper.costs(found)
    report = Report(
        history=tuple(history),
        dropped=prepared.dropped,
        seconds_setup=set_up - begun,
        seconds_compile=compiled - set_up,
        seconds_solve=time.perf_counter() - compiled,
        linear_solver=dealt.joint.shape.linear_solver,
        interrupted=interrupted,
        problem=problem,
    )
    values = from_centred(dealt.restore(jax.tree.map(np.asarray, found)), origin)
    of_costs = first[0], np.asarray(state.cost), first[1], last[1]
    return Solution.of(problem, values, of_costs, np.asarray(state.status), np.asarray(state.num_steps), report)


class _Programs(NamedTuple):
    """What a step calls, compiled.

    - `step_bytes`: what a step takes beside its arguments.
    """

    up: Callable[..., Any]
    joint: Callable[..., Any]
    down: Callable[..., Any]
    judge: Callable[..., Any]
    costs: Callable[..., Any]
    step_bytes: float


class _Stepper:
    """Takes steps of a problem in parts."""

    def __init__(self, dealt: Dealt, run: _Programs, numbers: AbstractSchurSolver, pool: ThreadPoolExecutor) -> None:
        self._dealt, self._run, self._numbers, self._pool = dealt, run, numbers, pool

    def costs(self, unknowns: tuple[Unknowns, ...]) -> tuple[np.ndarray, ...]:
        """Return the cost and the plain cost, see `_linearise.costs`."""
        found = self._each(lambda number: self._run.costs(self._dealt.parts[number].system, unknowns[number]))
        return tuple(np.asarray(sum(np.asarray(own[which]) for own in found)) for which in (0, 1))

    def step(self, unknowns: tuple[Unknowns, ...], state: State) -> tuple[tuple[Unknowns, ...], State]:
        """Return the unknowns and the state after a step was tried."""
        run, parts = self._run, self._dealt.parts
        ups = self._each(lambda number: run.up(parts[number].system, unknowns[number], state.trust, state.bend))
        models, handed = zip(*ups, strict=True)
        joint = run.joint(self._dealt.joint, handed, _without_points(unknowns[0]), state.trust)
        solved = joint.images, joint.border, joint.step
        downs = self._each(
            lambda number: run.down(
                parts[number].system, unknowns[number], models[number], *solved, state.trust, state.bend
            )
        )
        trial, sums = zip(*downs, strict=True)
        judged = run.judge(self._numbers, state, joint, sums, state.trust)
        return (trial if judged.accepted else unknowns), judged

    def _each(self, work: Callable[[int], Any]) -> list[Any]:
        def one(number: int) -> Any:
            with jax.enable_x64(True):  # of this thread
                return jax.block_until_ready(work(number))

        return list(self._pool.map(one, range(len(self._dealt.parts))))


@functools.lru_cache(maxsize=32)
def _compile(count: int, structure: Any, shapes: Shapes, _: str) -> _Programs:
    """Compile each program in a thread while the next is traced."""
    system, part, joint = of_shapes(structure, shapes)
    scalar = jax.ShapeDtypeStruct((), part.points.dtype)
    numbers = take_numbers(SchurLevenbergMarquardt(), part.points.dtype)[0]

    def begin(function: Callable[..., Any], *arguments: Any) -> tuple[Any, Future[Callable[..., Any]]]:
        return result_shapes(function, *arguments), pool.submit(compile_here, function, *arguments)

    def compile_here(function: Callable[..., Any], *arguments: Any) -> Callable[..., Any]:
        with jax.enable_x64(True):  # of this thread
            return compile_ahead(function, *arguments)

    with ThreadPoolExecutor(2) as pool:  # XLA compiles a program on one core
        (model, handed), up = begin(go_up, system, part, scalar, scalar)
        bare = _without_points(part)
        of_joint, solving = begin(solve_joint, joint, (handed,) * count, bare, scalar)
        step = of_joint.images, of_joint.border, of_joint.step
        (_, sums), down = begin(put_back, system, part, model, *step, scalar, scalar)
        (cost, _), of_costs = begin(costs, system, part)
        state = jax.eval_shape(SchurLevenbergMarquardt().state_of, cost)
        _, judging = begin(judge, numbers, state, of_joint, (sums,) * count, scalar)
        made = [future.result() for future in (up, solving, down, judging, of_costs)]
    return _Programs(*made, step_bytes=count * max(_bytes(made[0]), _bytes(made[2])))


def _without_points(unknowns: Unknowns) -> Unknowns:
    points = unknowns.points
    none = points[:0] if hasattr(points, "__getitem__") else jax.ShapeDtypeStruct((0, 3), points.dtype)
    return eqx.tree_at(lambda u: u.points, unknowns, none)


def _bytes(program: Any) -> float:
    found = program.memory_analysis()
    return 0.0 if found is None else float(found.temp_size_in_bytes + found.output_size_in_bytes)
