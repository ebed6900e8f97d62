"""A step of the solver over the tree: the same as that of the block in one piece.

The root solves for the border, within its bounds; each tile solves for its points and refines them, and gives its part
of the sums that the step is judged by, as the solver judges in one piece.
"""

import functools
from collections.abc import Callable, Iterator
from typing import Any, TypeVar

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Float

from jaxba.ba._compiler import call_compiled
from jaxba.ba._factor import box_minimum
from jaxba.ba._linearise import Linearisation, costs
from jaxba.ba._solvers import (
    AbstractSchurSolver,
    SchurLevenbergMarquardt,
    State,
    Tried,
    projected_gradient_norm,
    take_numbers,
)
from jaxba.ba._system import System
from jaxba.ba._unknowns import Step, Unknowns
from jaxba.ba.tiles._dense import NotPositive
from jaxba.ba.tiles._engine import Call, Engine, compile_tiles
from jaxba.ba.tiles._programs import Sums, put_back
from jaxba.geometry import Pose

_T = TypeVar("_T")


class Stepper:
    """Takes steps of a solver with an engine; `on_tile`: see `solve_tiled`."""

    def __init__(
        self, engine: Engine, solver: SchurLevenbergMarquardt, on_tile: Callable[[int, int], None] | None = None
    ) -> None:
        self.engine, self._on_tile, self._num_done = engine, on_tile, 0
        self._numbers, rest = take_numbers(solver, np.float64)
        self._judge = _judge_with(rest)

    def compile(self, unknowns: Unknowns) -> None:
        """Compile what a step calls, side by side; without it that happens at the first one."""
        compile_tiles(self.engine.one_of_each_shape(unknowns), _calls_of_step)

    def step(self, unknowns: Unknowns, state: State) -> tuple[Unknowns, State]:
        """Return the unknowns and the state after a step was tried."""
        damping, bend = np.asarray(state.trust), np.asarray(state.bend)
        self._num_done = 0
        try:
            up = self.engine.up(self._told(self.engine.each_part("step_up", unknowns, damping, bend)), damping)
        except NotPositive:
            return unknowns, call_compiled(self._judge, self._numbers, state, jax.tree.map(np.asarray, _NOTHING_TRIED))
        trial, sums, squared_norm = self._down(unknowns, self._border(unknowns, up.update), damping, bend)
        gradient = up.gradient
        of_all = Step(gradient.poses, gradient.intrinsics, gradient.antenna, np.array([[up.steepest, 0.0, 0.0]]))
        tried = _NOTHING_TRIED | {
            "cost": sums.cost,
            "promised": -sums.slope - sums.curvature / 2,
            "gradient_norm": call_compiled(
                projected_gradient_norm, self.engine.lower, self.engine.upper, unknowns.intrinsics, of_all
            ),
            "shortened": 1 + damping,
            "in_sigmas": np.sqrt(sums.in_sigmas),
            "all_in_sigmas": np.sqrt(sums.all_in_sigmas),
            "norm": np.sqrt(squared_norm),
            "points_held": int(sums.points_held),
        }
        judged = call_compiled(self._judge, self._numbers, state, jax.tree.map(np.asarray, tried))
        return (trial if judged.accepted else unknowns), judged

    def _told(self, of_tiles: Iterator[_T]) -> Iterator[_T]:
        """Yield what tiles give, and tell that they are done."""
        for found in of_tiles:
            self._num_done += 1
            if self._on_tile is not None:
                self._on_tile(self._num_done, 2 * len(self.engine.tiles))
            yield found

    def _border(self, unknowns: Unknowns, top: Float[np.ndarray, "tail tail"]) -> Float[np.ndarray, " border"]:
        """Return the border's solution from what the root hands on."""
        engine, count = self.engine, self.engine.shape.border
        if not count:
            return np.zeros(0)
        corner = np.tril(top[:count, :count])
        corner = corner + np.tril(corner, -1).T
        lower = upper = None
        if engine.shape.any_bound:
            far, free = np.full_like(engine.free.antenna, np.inf), engine.free
            lower, upper = (
                engine.reduced(Step(free.poses, of - unknowns.intrinsics, end, free.points), engine.camera_index)[1]
                for of, end in ((engine.lower, -far), (engine.upper, far))
            )
        return np.asarray(call_compiled(box_minimum, corner, top[count, :count], lower, upper))

    def _down(
        self,
        unknowns: Unknowns,
        border: Float[np.ndarray, " border"],
        damping: Float[np.ndarray, ""],
        bend: Float[np.ndarray, ""],
    ) -> tuple[Unknowns, Sums, float]:
        """Return the unknowns after the step, what it is judged by, and its squared length."""
        solution, tail = self.engine.put_back_tops(border)
        shared = self._shared_step(unknowns, border)
        trial = Unknowns(
            Pose(unknowns.poses.quaternion.copy(), unknowns.poses.translation.copy()),
            unknowns.intrinsics + shared.intrinsics,
            unknowns.antenna + shared.antenna,
            unknowns.points.copy(),
        )
        totals = Sums(*[np.zeros(()) for _ in Sums._fields])
        of_tiles = self.engine.each_part("step_down", unknowns, solution, tail, shared, damping, bend)
        for (tile, _), (part, sums, images) in zip(self.engine.tiles, self._told(of_tiles), strict=True):
            tile.put(part, trial)
            solution[tile.order] = images
            totals = Sums(*[total + own for total, own in zip(totals, sums, strict=True)])
        if self.engine.shape.own_cameras:
            refined = np.flatnonzero(self.engine.shape.refined)
            trial.intrinsics[self.engine.camera_index[:, None], refined] += solution[:, 6:]
        squared = np.sum(solution**2) + np.sum(shared.intrinsics**2) + np.sum(shared.antenna**2) + totals.of_points
        return trial, totals, float(squared)

    def _shared_step(self, unknowns: Unknowns, border: Float[np.ndarray, " border"]) -> Step:
        """Return the border's step of intrinsics and antenna, within the bounds."""
        shape, free = self.engine.shape, self.engine.free
        intrinsics, antenna = np.zeros_like(free.intrinsics), np.zeros_like(free.antenna)
        shared = shape.num_shared_cameras * shape.num_refined
        if shared:
            intrinsics[:, np.flatnonzero(shape.refined)] = border[:shared].reshape(-1, shape.num_refined)
        if shape.antenna:
            antenna = border[shared:]
        if shape.any_bound:
            moved = (
                np.clip(unknowns.intrinsics + intrinsics, self.engine.lower, self.engine.upper) - unknowns.intrinsics
            )
            intrinsics = np.where(free.intrinsics > 0, moved, 0.0)
        return Step(free.poses[:0], intrinsics, antenna, free.points)


def _calls_of_step(system: System, part: Unknowns, model: Linearisation) -> list[Call]:
    shape, scalar = system.shape, np.zeros(())
    solution = np.zeros((shape.num_images, shape.block)), np.zeros(shape.border)
    of_step = system, part, model, *solution, model.gradient, scalar, scalar
    return [Call(put_back, of_step), Call(costs, (system, part))]


@functools.cache
def _judge_with(rest: AbstractSchurSolver) -> Callable[[AbstractSchurSolver, State, dict[str, Any]], State]:
    return lambda numbers, state, tried: eqx.combine(numbers, rest).judge(state, Tried(**tried))


_NOTHING_TRIED: dict[str, Any] = {
    "cost": np.inf, "promised": np.nan, "gradient_norm": np.inf, "shortened": 1.0, "in_sigmas": np.inf,
    "all_in_sigmas": 0.0, "norm": np.inf, "scaled_norm": 0.0, "linear_iterations": 0, "points_held": 0,
}  # fmt: skip
"""Of a step that could not be computed."""
