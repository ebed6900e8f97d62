"""The engine of a block in tiles: what goes up the tree and down again, with no more than a few tiles held at a time.

Up: each tile linearises its observations, eliminates its points, then its inner
images, and hands a dense matrix over its boundary to its parent (`_fronts.py`); parents add and eliminate in turn, and
the root solves for the border, within its bounds. Down: each node solves for
its own images, each tile for its points. What is done so with what comes down stands in `_step.py` (a step of the
solver), `_inverse.py` (covariances) and `_reverse.py` (gradients).

Tiles are worked on by `workers` threads, and their results taken in the order of the tree: the same bytes whatever the
number of threads.
"""

import functools
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import jax
import numpy as np
from jaxtyping import Float, Int

from jaxba.ba._compiler import call_compiled, compile_ahead
from jaxba.ba._lengths import MIN_DIAGONAL
from jaxba.ba._linearise import Linearisation, costs, linearise
from jaxba.ba._plan_shape import bare_shape
from jaxba.ba._problem import Problem
from jaxba.ba._system import System
from jaxba.ba._unknowns import Step, Unknowns
from jaxba.ba.tiles._budget import Budget
from jaxba.ba.tiles._cut import Tile, cut
from jaxba.ba.tiles._dissect import Tree
from jaxba.ba.tiles._fronts import Factor, Fronts, TileFronts
from jaxba.ba.tiles._programs import Handed, hand_over
from jaxba.ba.tiles._shelf import Shelf
from jaxba.geometry import AbstractLoss

_T = TypeVar("_T")


class Up(NamedTuple):
    """What a tile gives on the way up, in its own order, or all of them together, in the problem's.

    - `update`: what is handed on; of all together that of the root, over the tail.
    - `gradient`, `squares`: see `Linearisation`; those of points are left out. `steepest`: their largest gradient.
    - `diagonal`, `border_diagonal`: of the reduced system before anything is eliminated from it, damped.
    """

    update: np.ndarray
    gradient: Step
    squares: Step
    steepest: float
    diagonal: Float[np.ndarray, "images block"]
    border_diagonal: Float[np.ndarray, " border"]


class Call(NamedTuple):
    """A compiled program with arguments of the shapes that it is called with."""

    program: Callable[..., Any]
    arguments: tuple[Any, ...]


class Engine:
    """A problem in tiles.

    - `budget`: how much of systems, factors and equations stays in memory. `folder`: for files of the rest.
    - `pool`: threads for the fronts above the tiles.
    """

    def __init__(
        self,
        problem: Problem,
        loss: AbstractLoss,
        tree: Tree,
        fronts: Fronts,
        budget: Budget,
        folder: Path,
        pool: ThreadPoolExecutor,
        workers: int,
    ) -> None:
        self.pool = pool
        self.shape, self.tree, self.fronts, self.workers = bare_shape(problem), tree, fronts, workers
        self.shelf, self.models = Shelf(budget.shelf, folder), Shelf(budget.models)
        fronts.memory.limit = budget.idle
        tiles: dict[int, tuple[Tile, TileFronts]] = {}
        for number, tile, system in cut(problem, tree, loss):
            row, column = np.asarray(system.block_row), np.asarray(system.block_column)
            count = int(np.count_nonzero(row != column))  # padding stands at the end
            tiles[number] = tile, fronts.tile_fronts(number, tile.order, row[:count], column[:count])
            self.shelf.put(("system", number), system)
        self.tiles = [tiles[number] for number in range(len(tiles))]
        self.camera_index = np.asarray(problem.camera_index)
        free = problem.free
        self.free = Step(
            np.repeat(np.asarray(free.poses, float)[:, None], 6, axis=1),
            np.asarray(free.intrinsics, float),
            np.full(3, float(free.lever_arm)),
            np.zeros((0, 3)),
        )
        self.lower, self.upper = np.asarray(problem.lower, float), np.asarray(problem.upper, float)
        below = {node for _, fronts in self.tiles for node in range(fronts.first, fronts.last)}
        self.tops = [number for number in range(len(tree.nodes)) if number not in below]
        self.tile_of_node = {fronts.last: number for number, (_, fronts) in enumerate(self.tiles)}

    def compile(self, unknowns: Unknowns, calls: Callable[[System, Unknowns, Linearisation], list[Call]]) -> None:
        """Compile the work on tiles, two programs at a time; without it that happens when it is first done.

        - `calls`: what is called beside the way up, from a tile's system, unknowns and equations.
        """
        one_of_shape = {tile.plan.shape: number for number, (tile, _) in enumerate(self.tiles)}

        def compile_one(call: Call) -> None:
            with jax.enable_x64(True):  # of this thread
                compile_ahead(call.program, *call.arguments)

        with ThreadPoolExecutor(2) as pool:  # XLA compiles a program on one core
            done = []
            for number in one_of_shape.values():
                system, part, scalar = self.system(number), self.tiles[number][0].take(unknowns), np.zeros(())
                model = jax.eval_shape(linearise, system, part, scalar)
                done += calls(system, part, model)
                done += [Call(hand_over, (system, model, scalar)), Call(linearise, (system, part, scalar))]
            list(pool.map(compile_one, done))

    def costs(self, unknowns: Unknowns) -> tuple[float, float]:
        """Return the cost, and the cost without robust losses."""

        def of_tile(number: int) -> tuple[float, float]:
            found = call_compiled(costs, self.system(number), self.tiles[number][0].take(unknowns))
            return float(found[0]), float(found[1])

        robust, plain = np.sum(list(self.each_tile(of_tile)), axis=0)
        return robust, plain

    def system(self, number: int) -> System:
        """Return the system of a tile."""
        return self.shelf.get(("system", number))

    def factor(self, number: int) -> Factor:
        """Return the factor of a node, as the last way up has left it."""
        return self.shelf.get(("factor", number))

    def equations(self, number: int, part: Unknowns, bend: Float[np.ndarray, ""]) -> Linearisation:
        """Return a tile's equations: those of the last way up, or the same computed again."""
        model = self.models.get(number)
        return call_compiled(linearise, self.system(number), part, bend) if model is None else model

    def up(
        self, hand: Callable[[int], Handed], damping: Float[np.ndarray, ""], on_tile: Callable[[], None] = lambda: None
    ) -> Up:
        """Eliminate all but the border, and keep the factors.

        - `hand`: returns what a tile hands to the fronts. `damping`: see `State`. `on_tile`: called after each tile.

        Raises `NotPositive` where the damped equations have no factor.
        """
        gradient, squares = (jax.tree.map(np.zeros_like, self.free) for _ in range(2))
        diagonal, of_border = np.zeros((len(self.tree.rank), self.shape.block)), np.zeros(self.shape.border)
        updates: dict[int, np.ndarray] = {}
        steepest, results = 0.0, self.each_tile(functools.partial(self._up_tile, hand, damping))
        for number in self.tops:
            if number in self.tile_of_node:
                tile, found = self.tiles[self.tile_of_node[number]][0], next(results)
                on_tile()
                updates[number] = found.update
                steepest = max(steepest, found.steepest)
                diagonal[tile.order] += found.diagonal
                of_border += found.border_diagonal
                for total, part in ((gradient, found.gradient), (squares, found.squares)):
                    total.poses[tile.order] += part.poses
                    total.intrinsics[tile.solver_cameras] += part.intrinsics
                    total.lever_arm[:] += part.lever_arm
                continue
            node = self.tree.nodes[number]
            images, _ = self.reduced(self._damping(squares, damping), self.camera_index)
            handed_on = [updates.pop(child) for child in node.children]
            updates[number] = self._eliminate(number, handed_on, images[node.eliminated], pool=self.pool)
        (top,) = updates.values()
        images, on_border = self.reduced(self._damping(squares, damping), self.camera_index)
        np.einsum("ii->i", top)[: len(on_border)] += on_border
        return Up(top, gradient, squares, steepest, diagonal + images, of_border + on_border)

    def step_equations(
        self, unknowns: Unknowns, damping: Float[np.ndarray, ""], bend: Float[np.ndarray, ""]
    ) -> Callable[[int], Handed]:
        """Return the function that gives `up` the equations of a step, and keeps them.

        - `damping`, `bend`: see `State`.
        """

        def hand(number: int) -> Handed:
            system = self.system(number)
            model = call_compiled(linearise, system, self.tiles[number][0].take(unknowns), bend)
            handed: Handed = jax.tree.map(np.asarray, call_compiled(hand_over, system, model, damping))
            self.models.put(number, jax.tree.map(np.asarray, model))
            return handed

        return hand

    def _up_tile(self, hand: Callable[[int], Handed], damping: Float[np.ndarray, ""], number: int) -> Up:
        tile, fronts = self.tiles[number]
        handed = hand(number)
        count = len(tile.order)
        squares, gradient = (
            Step(part.poses[:count], part.intrinsics[: len(tile.cameras)], part.lever_arm, part.points)
            for part in (handed.squares, handed.gradient)
        )
        images, _ = self.reduced(self._damping(squares, damping, tile), np.arange(count))
        updates: dict[int, np.ndarray] = {}
        begin = 0
        for node_number, part in zip(range(fronts.first, fronts.last + 1), fronts.parts, strict=True):
            node = self.tree.nodes[node_number]
            end = begin + len(node.eliminated)
            handed_on = [updates.pop(child) for child in node.children]
            updates[node_number] = self._eliminate(node_number, handed_on, images[begin:end], part, handed)
            begin = end
        diagonal = np.diagonal(handed.diagonal[:count], axis1=1, axis2=2)
        of_border = np.diagonal(handed.corner)[: self.shape.border]
        return Up(updates[fronts.last], gradient, squares, float(handed.steepest), diagonal, of_border)

    def _eliminate(self, number: int, *arguments: Any, pool: ThreadPoolExecutor | None = None) -> np.ndarray:
        old = self.shelf.release(("factor", number))
        if old is not None:
            self.fronts.forget(old)
        factor, update = self.fronts.eliminate(number, *arguments, pool=pool)
        if not self.shelf.put(("factor", number), factor):
            self.fronts.forget(factor)
        return update

    def put_back_tops(
        self, border: Float[np.ndarray, " border"]
    ) -> tuple[Float[np.ndarray, "images block"], Float[np.ndarray, " tail"]]:
        """Return the images' solution, so far of those above the tiles, and the tail that `put_back_tile` takes."""
        solution = np.zeros((len(self.tree.rank), self.shape.block))
        tail = np.zeros(self.fronts.tail * self.shape.block)
        tail[: len(border)], tail[len(border)] = border, -1
        for number in reversed(self.tops):
            if number not in self.tile_of_node:
                self.fronts.put_back(number, self.factor(number), solution, tail)
        return solution, tail

    def put_back_tile(
        self, number: int, solution: Float[np.ndarray, "images block"], tail: Float[np.ndarray, " tail"]
    ) -> Float[np.ndarray, "padded block"]:
        """Write the solution of a tile's images into that of all; return the tile's, in its solver's order, padded."""
        tile, fronts = self.tiles[number]
        for node in reversed(range(fronts.first, fronts.last + 1)):
            self.fronts.put_back(node, self.factor(node), solution, tail)
        images = np.zeros((tile.plan.shape.num_images, self.shape.block))
        images[: len(tile.order)] = solution[tile.order]
        return images

    def reduced(
        self, step: Step, camera_index: Int[np.ndarray, " images"]
    ) -> tuple[Float[np.ndarray, "images block"], Float[np.ndarray, " border"]]:
        """Return the images' and the border's part of a step, as `_schur.to_reduced` does."""
        shape = self.shape
        refined = step.intrinsics[:, np.flatnonzero(shape.refined)]
        lever_arm = np.asarray(step.lever_arm if shape.lever_arm else step.lever_arm[:0])
        if shape.own_cameras:
            return np.concatenate([step.poses, refined[camera_index]], axis=1), lever_arm
        return np.asarray(step.poses), np.concatenate([refined.reshape(-1), lever_arm])

    def _damping(self, squares: Step, damping: Float[np.ndarray, ""], tile: Tile | None = None) -> Step:
        """Return what is added to the diagonal of images and border, of a tile's or of all."""
        free = self.free
        if tile is not None:
            free = Step(free.poses[tile.order], free.intrinsics[tile.solver_cameras], free.lever_arm, free.points)

        def added(squares: np.ndarray, free: np.ndarray) -> np.ndarray:
            largest = squares.max(initial=0.0)
            return damping * np.maximum(squares, MIN_DIAGONAL * largest if largest > 0 else 1.0) + (1 - free)

        return jax.tree.map(added, squares, free)

    def each_tile(self, work: Callable[..., _T], calls: Iterable[tuple[Any, ...]] | None = None) -> Iterator[_T]:
        """Yield the results of work on tiles, in order, a few at a time.

        - `calls`: arguments of each call, taken as workers get free; the numbers of all tiles if None.
        """

        def in_double(arguments: tuple[Any, ...]) -> _T:
            with jax.enable_x64(True):  # of this thread
                return work(*arguments)

        waiting: deque[Future[_T]] = deque()
        with ThreadPoolExecutor(self.workers) as pool:
            for arguments in ((number,) for number in range(len(self.tiles))) if calls is None else calls:
                waiting.append(pool.submit(in_double, arguments))
                if len(waiting) > self.workers:
                    yield waiting.popleft().result()
            while waiting:
                yield waiting.popleft().result()
