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
from contextlib import AbstractContextManager
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Bool, Float

from jaxba._errors import JaxbaError
from jaxba.ba._adjoint import NOT_A_MINIMUM, ON_BOUND, SINGULAR, hold_saddles, settled, tell_held
from jaxba.ba._compiler import call_compiled
from jaxba.ba._hessian import hessian
from jaxba.ba._linearise import Linearisation, cost, linearise
from jaxba.ba._problem import Problem
from jaxba.ba._schur import ReducedVector, back_substitute, eliminate
from jaxba.ba._solution import Solution
from jaxba.ba._system import System, is_traced, own_unknowns, restore
from jaxba.ba._traced import NOT_DOUBLE
from jaxba.ba._unknowns import Step, Unknowns
from jaxba.ba.checks import require_gauge
from jaxba.ba.tiles._cut import Tile
from jaxba.ba.tiles._dense import NotPositive
from jaxba.ba.tiles._engine import Engine
from jaxba.ba.tiles._programs import Handed, handed
from jaxba.geometry import AbstractLoss, Linear, Pose


class _Held(NamedTuple):
    """A tile's exact equations; what rests on a saddle or at a bound is fixed in `free`."""

    model: Linearisation
    free: Step


class Cotangents(NamedTuple):
    """A scalar's gradient by what was found, in the problem's order: unknowns as stored, and the costs.

    - `costs`: in the order of the fields of `Solution`.
    """

    unknowns: Unknowns
    costs: tuple[Float[Array | np.ndarray, ""], ...]


def solve_reversibly(
    problem: Problem,
    loss: AbstractLoss,
    solve: Callable[[Problem, AbstractLoss], Solution],
    open_engine: Callable[[Problem, AbstractLoss], AbstractContextManager[Engine]],
) -> Solution:
    """Return the solution of a problem under `jax.grad`, which hands the values themselves to the rule below.

    Raises `JaxbaError` inside `jit` and `vmap`, where there are no values, in single precision, and where the values
    have no derivative.
    """
    numbers, rest = eqx.partition((problem, loss), eqx.is_inexact_array)

    @jax.custom_vjp
    def solved(numbers: Any) -> tuple[Any, ...]:
        return forward(numbers)[0]

    def forward(numbers: Any) -> tuple[tuple[Any, ...], Any]:
        if is_traced(numbers):
            raise JaxbaError(_NO_VALUES)
        if jnp.result_type(float) != jnp.float64:
            raise JaxbaError(NOT_DOUBLE)
        problem, loss = jax.tree.map(np.asarray, eqx.combine(numbers, rest))
        require_gauge(problem, "Derivatives")
        solution = solve(problem, loss)
        if solution.report is not None and solution.report.dropped.any():
            raise JaxbaError(f"{_LEFT_OUT} {solution.report.dropped.summary()}")
        if not solution.converged:
            raise JaxbaError(NOT_A_MINIMUM)
        unknowns = own_unknowns(solution.apply(problem))
        costs = solution.initial_cost, solution.final_cost, solution.initial_plain_cost, solution.plain_cost
        found = unknowns, tuple(map(float, costs)), int(solution.status), int(solution.num_steps)
        return jax.tree.map(jnp.asarray, found), (problem, loss, unknowns)

    def backward(kept: Any, cotangents: tuple[Any, ...]) -> tuple[Any]:
        problem, loss, unknowns = kept
        along: Cotangents = jax.tree.map(np.asarray, Cotangents(*cotangents[:2]))
        if any(float(along.costs[k]) for k in (0, 2, 3)):
            raise JaxbaError(_FINAL_COST_ALONE)
        with open_engine(problem, loss) as engine:
            try:
                found = _Reverse(engine, problem, loss, unknowns).gradient(along)
            except NotPositive as error:
                raise JaxbaError(NOT_A_MINIMUM) from error
        asked = jax.tree.map(
            lambda number, of: None if number is None else jnp.asarray(of), numbers, found, is_leaf=_none
        )
        return (asked,)

    solved.defvjp(forward, backward)
    return Solution.of(problem, *solved(numbers))


_NO_VALUES = (
    "solve_tiled: the problem's values are traced, as inside jit and vmap. jax.grad is taken outside of them, or use "
    "solve there."
)
_LEFT_OUT = (
    "Derivatives: solve what is left of the problem, solution.report.problem of a solve before; this one leaves out:"
)
_FINAL_COST_ALONE = "solve_tiled: of the costs only final_cost has a derivative; use solve for the others."


class _Reverse:
    """The engine of a problem at its optimum, whose equations it keeps."""

    def __init__(self, engine: Engine, problem: Problem, loss: AbstractLoss, found: Unknowns) -> None:
        self.engine, self.problem, self.loss = engine, problem, loss
        self.unknowns = jax.tree.map(np.array, found)
        self.at_lower, self.at_upper = self._at_bounds()
        free = engine.free
        held = free.intrinsics * ~(self.at_lower | self.at_upper)
        engine.free = Step(free.poses, held, free.lever_arm, free.points)
        first = np.full(problem.num_images, len(engine.tiles))
        for number in reversed(range(len(engine.tiles))):
            first[engine.tiles[number][0].images] = number
        self.first_tile = first  # which gives an image's own part of a right-hand side

    def gradient(self, cotangents: Cotangents) -> tuple[Problem, AbstractLoss]:
        engine = self.engine
        if not isinstance(self.loss, Linear):
            self._move_tiles(lambda number, part: call_compiled(settled, engine.system(number), part))
        solution, tail = self._solved(lambda _, held: jax.tree.map(np.negative, held.model.gradient))
        before = engine.costs(self.unknowns)[0]
        self._newton(solution, tail, before)

        along = self._to_tangent(cotangents.unknowns)
        rhs = functools.partial(self._rhs_of_tile, along)
        solution, tail = self._solved(rhs)
        total = _zeros_like(self.problem, self.loss)
        steps = functools.partial(self._pull_tile, solution, tail, rhs, np.asarray(cotangents.costs[1]))
        held, points = 0, int(np.count_nonzero(self.problem.free.points))
        for number, (found, count) in enumerate(engine.each_tile(steps)):
            held += count
            self._add(total, engine.tiles[number][0], found)
        tell_held(jnp.asarray(points), jnp.asarray(points - held))
        return self._assembled(total, cotangents.unknowns)

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

        def hand(number: int) -> Handed:
            engine.models.release(number)
            held = self._held(number)
            engine.models.put(number, held)
            arguments = engine.system(number), held, rhs(number, held)
            return jax.tree.map(np.asarray, call_compiled(_hand, *arguments))

        up = engine.up(hand, nothing)
        pivots = [np.inf]
        for number, node in enumerate(engine.tree.nodes):
            if len(node.eliminated):
                root = np.diagonal(engine.factor(number).root) ** 2
                pivots.append(np.min(root / up.diagonal[node.eliminated].reshape(-1)))
        count = engine.shape.border
        corner = np.tril(up.update[:count, :count])
        corner += np.tril(corner, -1).T
        scale = 1 / np.sqrt(np.maximum(np.diagonal(corner), np.finfo(float).tiny))
        try:
            root = np.linalg.cholesky(corner * scale[:, None] * scale)
        except np.linalg.LinAlgError as error:
            raise NotPositive from error
        if min([*pivots, *np.diagonal(root) ** 2]) < SINGULAR:
            raise NotPositive
        border = scale * np.linalg.solve(corner * scale[:, None] * scale, scale * up.update[count, :count])
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
            moved.lever_arm[:] = part.lever_arm
        self.unknowns = moved

    def _to_tangent(self, cotangents: Unknowns) -> Step:
        """Return a gradient by stored unknowns as one by steps; zero for what is fixed or held at a bound."""
        free, engine = self.problem.free, self.engine
        unknowns = self.unknowns
        zero = Step(
            np.zeros((self.problem.num_images, 6)),
            np.zeros_like(unknowns.intrinsics),
            np.zeros(3),
            np.zeros_like(unknowns.points),
        )
        _, pull = jax.vjp(unknowns.retract, zero)
        (step,) = pull(jax.tree.map(jnp.asarray, cotangents))
        poses, points = np.asarray(step.poses), np.asarray(step.points)
        return Step(
            poses * np.asarray(free.poses)[:, None],
            np.asarray(step.intrinsics) * engine.free.intrinsics,
            np.asarray(step.lever_arm) * engine.free.lever_arm,
            points * np.asarray(free.points)[:, None],
        )

    def _rhs_of_tile(self, along: Step, number: int, held: _Held) -> Step:
        """Return a tile's part of a right-hand side: its points, the images first seen in it; the shared from one."""
        tile, _ = self.engine.tiles[number]
        plan = tile.plan
        mine = self.first_tile == number
        poses, intrinsics = np.zeros(held.free.poses.shape), np.zeros(held.free.intrinsics.shape)
        points = np.zeros(held.free.points.shape)
        poses[: len(tile.order)] = along.poses[tile.order] * mine[tile.order, None]
        if self.engine.shape.own_cameras:
            image_of_camera = np.argsort(self.engine.camera_index)
            cameras = tile.solver_cameras
            intrinsics[: len(cameras)] = along.intrinsics[cameras] * mine[image_of_camera[cameras], None]
        elif number == 0:
            intrinsics[:] = along.intrinsics
        points[: len(tile.points)] = along.points[tile.points[plan.point_order]]
        lever_arm = along.lever_arm if number == 0 else np.zeros(3)
        return Step(poses, intrinsics, lever_arm, points * held.free.points)

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

    def _add(self, total: "_Total", tile: Tile, pulled: tuple[System, Unknowns]) -> None:
        """Add a tile's gradient by its system and its unknowns to that by the problem."""
        of_system, of_unknowns = pulled
        plan, seen = tile.plan, self.problem.observations
        layout = np.flatnonzero(plan.row_observation >= 0)
        rows = tile.rows[plan.row_observation[layout]]
        total.xy_px[rows] += of_system.reprojection.xy_px.reshape(2, -1)[:, layout].T
        total.std_px[rows] -= of_system.reprojection.weight.reshape(-1)[layout] / np.asarray(seen.std_px)[rows] ** 2
        for fields, chosen, prior in zip(total.priors, tile.prior_rows, of_system.priors, strict=True):
            for name, whole in fields.items():
                whole[chosen] += getattr(prior, name)[: len(chosen)]
        losses = [of_system.loss, *(prior.loss for prior in of_system.priors)]
        for whole, loss in zip(total.losses, losses, strict=True):
            whole += np.array(jax.tree.leaves(loss))
        found = restore(of_unknowns, plan)
        total.unknowns.poses.quaternion[tile.images] += found.poses.quaternion
        total.unknowns.poses.translation[tile.images] += found.poses.translation
        total.unknowns.intrinsics[tile.cameras] += found.intrinsics
        total.unknowns.lever_arm[:] += found.lever_arm
        total.unknowns.points[tile.points] += found.points

    def _assembled(self, total: "_Total", direct: Unknowns) -> tuple[Problem, AbstractLoss]:
        """Return the gradient as trees like the problem and its loss; what is fixed moves with its start value."""
        problem, free = self.problem, self.problem.free
        through = jax.tree.map(lambda a, b: a + np.asarray(b), total.unknowns, direct)
        fixed_pose, fixed_point = (~np.asarray(of)[:, None] for of in (free.poses, free.points))
        intrinsics = through.intrinsics
        of_start = np.where(np.asarray(free.intrinsics), 0.0, intrinsics)
        priors = tuple(
            _with_fields(prior, fields, loss)
            for prior, fields, loss in zip(problem.priors, total.priors, total.losses[1:], strict=True)
        )
        changed = eqx.tree_at(
            lambda p: (p.poses, p.cameras, p.points, p.priors, p.lever_arm, p.lower, p.upper, p.observations.xy_px,
                       p.observations.std_px),
            problem,
            (
                Pose(through.poses.quaternion * fixed_pose, through.poses.translation * fixed_pose),
                type(problem.cameras).from_parameters(of_start),
                through.points * fixed_point,
                priors,
                through.lever_arm * (not np.asarray(free.lever_arm)),
                np.where(self.at_lower, intrinsics, 0.0),
                np.where(self.at_upper, intrinsics, 0.0),
                total.xy_px,
                total.std_px,
            ),
        )  # fmt: skip
        return changed, _with_leaves(self.loss, total.losses[0])


class _Total(NamedTuple):
    """The gradient while tiles add to it."""

    xy_px: np.ndarray
    std_px: np.ndarray
    priors: list[dict[str, np.ndarray]]
    losses: list[np.ndarray]
    unknowns: Unknowns


def _zeros_like(problem: Problem, loss: AbstractLoss) -> _Total:
    observations = problem.observations
    priors = [
        {n: np.zeros(np.shape(v)) for n, v in vars(prior).items() if n != "loss" and np.asarray(v).dtype.kind == "f"}
        for prior in problem.priors
    ]
    losses = [np.zeros(len(jax.tree.leaves(of))) for of in (loss, *(prior.loss for prior in problem.priors))]
    zero = jax.tree.map(np.zeros_like, own_unknowns(problem))
    return _Total(np.zeros(observations.xy_px.shape), np.zeros(observations.std_px.shape), priors, losses, zero)


def _with_fields(prior: Any, fields: dict[str, np.ndarray], loss: np.ndarray) -> Any:
    names = list(fields)
    changed = eqx.tree_at(lambda p: [getattr(p, name) for name in names], prior, [fields[name] for name in names])
    return eqx.tree_at(lambda p: p.loss, changed, _with_leaves(prior.loss, loss))


def _none(leaf: Any) -> bool:
    return leaf is None


def _with_leaves(loss: AbstractLoss, values: np.ndarray) -> AbstractLoss:
    leaves, structure = jax.tree.flatten(loss)
    return jax.tree.unflatten(
        structure, [np.reshape(value, np.shape(leaf)) for value, leaf in zip(values, leaves, strict=True)]
    )


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
