"""The gradient of a scalar through an adjustment in tiles, in reverse mode: `jax.grad` of what `solve_tiled` returns.

The rule is that of `_adjoint.py`. With c the scalar's gradient by the unknowns, H the exact second derivatives of the
cost and theta all that the problem is made of,

    H l = c        gradient by theta = -d/dtheta (l . dcost/dx)

H is built, eliminated and solved over the tree as the equations of a step are. Of the last product every tile gives the
part of its own observations and priors, from the derivative of its cost along l. Nothing is as large as the block but
unknowns, l and the gradient itself.
"""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Bool, Float

from jaxba.ba._adjoint import ON_BOUND, SINGULAR, hold_saddles, settled, tell_held
from jaxba.ba._compiler import call_compiled
from jaxba.ba._hessian import hessian
from jaxba.ba._linearise import Linearisation, cost, linearise
from jaxba.ba._problem import Problem
from jaxba.ba._schur import ReducedVector, back_substitute, eliminate
from jaxba.ba._system import System
from jaxba.ba._unknowns import Step, Unknowns
from jaxba.ba.tiles._dense import NotPositive
from jaxba.ba.tiles._engine import Engine
from jaxba.ba.tiles._gradient_sums import GradientSums
from jaxba.ba.tiles._programs import Handed, handed
from jaxba.ba.tiles._tile_work import Up
from jaxba.geometry import AbstractLoss, Linear


class _Held(NamedTuple):
    """A tile's exact equations; what rests on a saddle or at a bound is fixed in `free`."""

    model: Linearisation
    free: Step


class Reverse:
    """The engine of a problem at its optimum, whose equations it keeps."""

    def __init__(self, engine: Engine, problem: Problem, loss: AbstractLoss, found: Unknowns) -> None:
        self.engine, self.problem, self.loss = engine, problem, loss
        self.unknowns = jax.tree.map(np.array, found)
        self.at_lower, self.at_upper = self._at_bounds()
        free = engine.free
        held = free.intrinsics * ~(self.at_lower | self.at_upper)
        engine.free = Step(free.poses, held, free.antenna, free.points)

    def gradient(self, along_unknowns: Unknowns, along_cost: Float[np.ndarray, ""]) -> tuple[Problem, AbstractLoss]:
        engine = self.engine
        if not isinstance(self.loss, Linear):
            self._move_tiles(lambda number, part: call_compiled(settled, engine.system(number), part))
        solution, tail = self._solved(lambda _, held: jax.tree.map(np.negative, held.model.gradient))
        before = engine.costs(self.unknowns)[0]
        self._newton(solution, tail, before)

        along = self._to_tangent(along_unknowns)
        rhs = functools.partial(self._rhs_of_tile, along)
        solution, tail = self._solved(rhs)
        total = GradientSums(self.problem, self.loss)
        steps = functools.partial(self._pull_tile, solution, tail, rhs, along_cost)
        held, points = 0, int(np.count_nonzero(self.problem.free.points))
        for number, (found, count) in enumerate(engine.each_tile(steps)):
            held += count
            total.add(engine.tiles[number][0], *found)
        tell_held(jnp.asarray(points), jnp.asarray(points - held))
        return total.assembled(along_unknowns, self.at_lower, self.at_upper)

    def _at_bounds(self) -> tuple[Bool[np.ndarray, "cameras parameters"], Bool[np.ndarray, "cameras parameters"]]:
        """Return which free intrinsics are pressed against a bound."""
        engine, intrinsics = self.engine, self.unknowns.intrinsics
        slope = np.zeros_like(intrinsics)
        if not engine.shape.any_bound:
            return slope > 0, slope > 0

        def of_tile(number: int) -> np.ndarray:
            part = engine.tiles[number][0].take(self.unknowns)
            return np.asarray(call_compiled(linearise, engine.system(number), part, np.zeros(())).gradient.intrinsics)

        for (tile, _), part in zip(engine.tiles, engine.each_tile(of_tile), strict=True):
            slope[tile.solver_cameras] += part[: len(tile.cameras)]
        near, free = ON_BOUND * (1 + np.abs(intrinsics)), engine.free.intrinsics > 0
        below, above = intrinsics - engine.lower <= near, engine.upper - intrinsics <= near
        return below & (slope > 0) & free, above & (slope < 0) & free

    def _held(self, number: int) -> _Held:
        """Return a tile's exact equations: those kept, or the same computed again."""
        kept = self.engine.models.get(number)
        if kept is not None:
            return kept
        tile, _ = self.engine.tiles[number]
        system = self.engine.system(number)
        intrinsics = np.array(system.free.intrinsics)
        intrinsics[: len(tile.cameras)] *= self.engine.free.intrinsics[tile.solver_cameras]
        return jax.tree.map(np.asarray, call_compiled(_exact, system, tile.take(self.unknowns), intrinsics))

    def _solved(self, rhs: Callable[[int, _Held], Step]) -> tuple[np.ndarray, np.ndarray]:
        """Return H^-1 b over images and tail, before tiles are put back; `rhs` gives each tile's part of b."""
        engine, nothing = self.engine, np.zeros(())

        def up(number: int) -> Up:
            engine.models.release(number)
            held = self._held(number)
            engine.models.put(number, held)
            arguments = engine.system(number), held, rhs(number, held)
            handed: Handed = jax.tree.map(np.asarray, call_compiled(_hand, *arguments))
            return engine.up_tile(number, handed, nothing)

        found = engine.up(engine.each_tile(up), nothing)
        pivots = [np.inf]
        for number, node in enumerate(engine.tree.nodes):
            if len(node.eliminated):
                root = np.diagonal(engine.factor(number).root) ** 2
                pivots.append(np.min(root / found.diagonal[node.eliminated].reshape(-1)))
        count = engine.shape.border
        corner = np.tril(found.update[:count, :count])
        corner += np.tril(corner, -1).T
        scale = 1 / np.sqrt(np.maximum(np.diagonal(corner), np.finfo(float).tiny))
        try:
            root = np.linalg.cholesky(corner * scale[:, None] * scale)
        except np.linalg.LinAlgError as error:
            raise NotPositive from error
        if min([*pivots, *np.diagonal(root) ** 2]) < SINGULAR:
            raise NotPositive
        border = scale * np.linalg.solve(corner * scale[:, None] * scale, scale * found.update[count, :count])
        return engine.put_back_tops(border)

    def _step_of_tile(self, number: int, solution: np.ndarray, tail: np.ndarray, rhs: Step, held: _Held) -> Step:
        images = self.engine.put_back_tile(number, solution, tail)
        border = tail[: self.engine.shape.border]
        arguments = self.engine.system(number), held, rhs, images, border
        return jax.tree.map(np.asarray, call_compiled(_back, *arguments))

    def _newton(self, solution: np.ndarray, tail: np.ndarray, before: float) -> None:
        """Take the Newton step unless the cost would rise."""
        kept, engine = jax.tree.map(np.copy, self.unknowns), self.engine

        def move(number: int, part: Unknowns) -> Unknowns:
            held = self._held(number)
            step = self._step_of_tile(number, solution, tail, jax.tree.map(np.negative, held.model.gradient), held)
            engine.models.release(number)
            return call_compiled(_moved, part, step)

        self._move_tiles(move)
        free = engine.free.intrinsics > 0
        within = np.clip(self.unknowns.intrinsics, engine.lower, engine.upper)
        self.unknowns = eqx.tree_at(
            lambda u: u.intrinsics, self.unknowns, np.where(free, within, self.unknowns.intrinsics)
        )
        if not engine.costs(self.unknowns)[0] <= before + 1e-12 * abs(before):
            self.unknowns = kept

    def _move_tiles(self, move: Callable[[int, Unknowns], Unknowns]) -> None:
        """Let each tile move its unknowns. Images and what is shared are moved alike by all that have them."""
        engine, moved = self.engine, jax.tree.map(np.copy, self.unknowns)

        def work(number: int) -> Unknowns:
            return jax.tree.map(np.asarray, move(number, engine.tiles[number][0].take(self.unknowns)))

        for (tile, _), part in zip(engine.tiles, engine.each_tile(work), strict=True):
            tile.put(part, moved)
            moved.intrinsics[tile.solver_cameras] = part.intrinsics[: len(tile.cameras)]
            moved.antenna[:] = part.antenna
        self.unknowns = moved

    def _to_tangent(self, cotangents: Unknowns) -> Step:
        """Return a gradient by stored unknowns as one by steps; zero for what is fixed or held at a bound."""
        free, engine = self.problem.free, self.engine
        unknowns = self.unknowns
        zero = Step(
            np.zeros((self.problem.num_images, 6)),
            np.zeros_like(unknowns.intrinsics),
            np.zeros_like(unknowns.antenna),
            np.zeros_like(unknowns.points),
        )
        _, pull = jax.vjp(unknowns.retract, zero)
        (step,) = pull(jax.tree.map(jnp.asarray, cotangents))
        poses, points = np.asarray(step.poses), np.asarray(step.points)
        return Step(
            poses * np.asarray(free.poses)[:, None],
            np.asarray(step.intrinsics) * engine.free.intrinsics,
            np.asarray(step.antenna) * engine.free.antenna,
            points * np.asarray(free.points)[:, None],
        )

    def _rhs_of_tile(self, along: Step, number: int, held: _Held) -> Step:
        """Return a tile's part of a right-hand side."""
        part = self.engine.part_of(along, number)
        return eqx.tree_at(lambda s: s.points, part, part.points * held.free.points)

    def _pull_tile(
        self,
        solution: np.ndarray,
        tail: np.ndarray,
        rhs: Callable[[int, _Held], Step],
        of_cost: Float[np.ndarray, ""],
        number: int,
    ) -> tuple[Any, int]:
        tile, _ = self.engine.tiles[number]
        system, held = self.engine.system(number), self._held(number)
        step = self._step_of_tile(number, solution, tail, rhs(number, held), held)
        pulled = call_compiled(_pull, system, tile.take(self.unknowns), step, of_cost)
        count = int(np.sum(system.free.points[:, 0]) - np.sum(held.free.points[:, 0]))
        return jax.tree.map(np.asarray, pulled), count


def _exact(system: System, unknowns: Unknowns, free_intrinsics: Array) -> _Held:
    system = eqx.tree_at(lambda s: s.free.intrinsics, system, free_intrinsics)
    system, model = hold_saddles(system, hessian(system, unknowns))
    return _Held(model, system.free)


def _hand(system: System, held: _Held, rhs: Step) -> Handed:
    system = eqx.tree_at(lambda s: s.free, system, held.free)
    return handed(system, held.model, 1 - held.free.points, rhs)


def _back(system: System, held: _Held, rhs: Step, images: Array, border: Array) -> Step:
    system = eqx.tree_at(lambda s: s.free, system, held.free)
    points = eliminate(held.model, 1 - held.free.points)
    step = back_substitute(system, points, rhs, ReducedVector(images, border))
    return jax.tree.map(jnp.multiply, held.free, step)


def _moved(unknowns: Unknowns, step: Step) -> Unknowns:
    return unknowns.retract(step)


def _pull(system: System, unknowns: Unknowns, step: Step, of_cost: Array) -> tuple[System, Unknowns]:
    """Return the gradient of `of_cost cost - dcost/dstep` by the system's numbers and by unknowns as stored."""
    numbers, rest = eqx.partition((system, unknowns), eqx.is_inexact_array)

    def scalar(numbers: Any) -> Array:
        system, unknowns = eqx.combine(numbers, rest)
        zero = jax.tree.map(jnp.zeros_like, step)
        value, slope = jax.jvp(lambda s: cost(system, unknowns.retract(s)), (zero,), (step,))
        return of_cost * value - slope

    return eqx.combine(jax.grad(scalar)(numbers), rest)
