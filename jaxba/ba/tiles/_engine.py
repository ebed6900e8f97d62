"""The engine of a block in tiles: what goes up the tree and down again, with no more than a few tiles held at a time.

Up: each tile hands a dense matrix over its boundary to its parent (`_tile_work.py`, `_fronts.py`); parents add and
eliminate in turn, and the root solves for the border, within its bounds. Down: each node solves for its own images, and
each tile for its points. What is done so with what comes down stands in `_step.py` (a step of the solver),
`_inverse.py` (covariances) and `_reverse.py` (gradients).

Tiles are worked on by threads of this process, or in other processes (`_elsewhere.py`), and their results taken in the
order of the tree: the same bytes whatever their number.
"""

import threading
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import jax
import numpy as np
from jaxtyping import Float

from jaxba.ba._compiler import compile_ahead, result_shapes
from jaxba.ba._linearise import Linearisation, linearise
from jaxba.ba._plan_shape import PlanShape, bare_shape
from jaxba.ba._problem import Problem
from jaxba.ba._system import System
from jaxba.ba._unknowns import Step, Unknowns
from jaxba.ba.tiles._budget import Budget
from jaxba.ba.tiles._cut import Tile, cut
from jaxba.ba.tiles._dissect import Tree
from jaxba.ba.tiles._elsewhere import Elsewhere
from jaxba.ba.tiles._fronts import Fronts, TileFronts
from jaxba.ba.tiles._programs import hand_over
from jaxba.ba.tiles._shelf import Shelf
from jaxba.ba.tiles._tile_work import TileWork, Up
from jaxba.geometry import AbstractLoss

_T = TypeVar("_T")


class Call(NamedTuple):
    """A compiled program with arguments of the shapes that it is called with."""

    program: Callable[..., Any]
    arguments: tuple[Any, ...]


def compile_tiles(
    ones: Iterable[tuple[System, Unknowns]],
    others: Callable[[System, Unknowns, Linearisation], list[Call]],
    at_a_time: int = 2,
    stop: threading.Event | None = None,
) -> None:
    """Compile the work on tiles, so many programs at a time; without it that happens when it is first done.

    - `ones`: those of `Engine.one_of_each_shape`. `others`: what is called beside the way up, from a tile's system,
      unknowns and equations. `stop`: once it is set, no further program is begun.
    """

    def compile_one(call: Call) -> None:
        if stop is not None and stop.is_set():
            return
        with jax.enable_x64(True):  # of this thread
            compile_ahead(call.program, *call.arguments)

    calls: list[Call] = []
    with jax.enable_x64(True):
        for system, part in ones:
            scalar = np.zeros(())
            model = result_shapes(linearise, system, part, scalar)
            calls += others(system, part, model)
            calls += [Call(hand_over, (system, model, scalar)), Call(linearise, (system, part, scalar))]
    with ThreadPoolExecutor(at_a_time) as pool:  # XLA compiles a program on one core
        list(pool.map(compile_one, calls))


class Engine(TileWork):
    """A problem in tiles.

    - `budget`: how much of systems, factors and equations stays in memory. `folder`: for files of the rest.
    - `pool`: threads for the fronts above the tiles. `workers`: tiles that are worked on at a time here.
    - `elsewhere`: where the tiles of steps are worked on instead, which hold their systems then.
    - `like`: as in `opened`.
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
        elsewhere: Elsewhere | None = None,
        like: PlanShape | None = None,
    ) -> None:
        free = problem.free
        of_unknowns = Step(
            np.repeat(np.asarray(free.poses, float)[:, None], 6, axis=1),
            np.asarray(free.intrinsics, float),
            problem.free_antenna.astype(float),
            np.zeros((0, 3)),
        )
        shelves = Shelf(budget.shelf, folder), Shelf(budget.models)
        super().__init__(bare_shape(problem), tree, fronts, np.asarray(problem.camera_index), of_unknowns, *shelves)
        self.pool, self.workers, self.elsewhere = pool, workers, elsewhere
        fronts.memory.limit = budget.idle
        if elsewhere is not None:
            elsewhere.put_block(self)
        tiles: dict[int, tuple[Tile, TileFronts]] = {}
        for number, tile, system in cut(problem, tree, loss, like):
            row, column = np.asarray(system.block_row), np.asarray(system.block_column)
            count = int(np.count_nonzero(row != column))  # padding stands at the end
            tiles[number] = tile, fronts.tile_fronts(number, tile.order, row[:count], column[:count])
            if elsewhere is None:
                self.shelf.put(("system", number), system)
            else:
                elsewhere.put_tile(number, *tiles[number], system)
        self.tiles = [tiles[number] for number in range(len(tiles))]
        self.lower, self.upper = np.asarray(problem.lower, float), np.asarray(problem.upper, float)
        below = {node for _, fronts in self.tiles for node in range(fronts.first, fronts.last)}
        self.tops = [number for number in range(len(tree.nodes)) if number not in below]
        first = np.full(problem.num_images, len(self.tiles))
        for number in reversed(range(len(self.tiles))):
            first[self.tiles[number][0].images] = number
        self.first_tile = first  # of each image
        self.tile_of_node = {fronts.last: number for number, (_, fronts) in enumerate(self.tiles)}

    def tile(self, number: int) -> tuple[Tile, TileFronts]:
        """Return a tile and its fronts."""
        return self.tiles[number]

    def one_of_each_shape(self, unknowns: Unknowns) -> list[tuple[System, Unknowns]]:
        """Return the system and the unknowns of one tile of each shape, as trees of `jax.ShapeDtypeStruct`s."""
        one_of_shape = {tile.plan.shape: number for number, (tile, _) in enumerate(self.tiles)}
        ones = [(self.system(number), self.tiles[number][0].take(unknowns)) for number in one_of_shape.values()]
        return jax.eval_shape(lambda: ones)

    def costs(self, unknowns: Unknowns) -> tuple[float, float]:
        """Return the cost, and the cost without robust losses."""
        robust, plain = np.sum(list(self.each_part("costs_of_tile", unknowns)), axis=0)
        return robust, plain

    def up(self, of_tiles: Iterator[Up], damping: Float[np.ndarray, ""]) -> Up:
        """Eliminate all but the border, and keep the factors.

        - `of_tiles`: what each tile gives, in order. `damping`: see `State`.

        Raises `NotPositive` where the damped equations have no factor.
        """
        gradient, squares = (jax.tree.map(np.zeros_like, self.free) for _ in range(2))
        diagonal, of_border = np.zeros((len(self.tree.rank), self.shape.block)), np.zeros(self.shape.border)
        updates: dict[int, np.ndarray] = {}
        steepest = 0.0
        for number in self.tops:
            if number in self.tile_of_node:
                tile, found = self.tiles[self.tile_of_node[number]][0], next(of_tiles)
                updates[number] = found.update
                steepest = max(steepest, found.steepest)
                diagonal[tile.order] += found.diagonal
                of_border += found.border_diagonal
                for total, part in ((gradient, found.gradient), (squares, found.squares)):
                    total.poses[tile.order] += part.poses
                    total.intrinsics[tile.solver_cameras] += part.intrinsics
                    total.antenna[:] += part.antenna
                continue
            node = self.tree.nodes[number]
            images, _ = self.reduced(self.damping(squares, damping), self.camera_index)
            handed_on = [updates.pop(child) for child in node.children]
            updates[number] = self.eliminate(number, handed_on, images[node.eliminated], pool=self.pool)
        (top,) = updates.values()
        images, on_border = self.reduced(self.damping(squares, damping), self.camera_index)
        np.einsum("ii->i", top)[: len(on_border)] += on_border
        return Up(top, gradient, squares, steepest, diagonal + images, of_border + on_border)

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

    def part_of(self, along: Step, number: int) -> Step:
        """Return a tile's part of a right-hand side, in its solver's order: parts of all tiles add up to the whole.

        A tile has its points, the images and own cameras that no tile before it has, and the first what all share.
        """
        tile, _ = self.tiles[number]
        shape, count = tile.plan.shape, len(tile.order)
        mine = (self.first_tile == number)[tile.order, None]
        poses, points = np.zeros((shape.num_images, 6)), np.zeros((shape.num_points, 3))
        intrinsics = np.zeros((shape.num_cameras, along.intrinsics.shape[1]))
        poses[:count] = along.poses[tile.order] * mine
        cameras = tile.solver_cameras
        if self.shape.own_cameras:
            own = self.first_tile[np.argsort(self.camera_index)[cameras]] == number
            intrinsics[: len(cameras)] = along.intrinsics[cameras] * own[:, None]
        elif number == 0:
            intrinsics[:] = along.intrinsics[cameras]
        points[: len(tile.points)] = along.points[tile.points[tile.plan.point_order]]
        return Step(poses, intrinsics, along.antenna if number == 0 else np.zeros_like(along.antenna), points)

    def each_part(self, name: str, unknowns: Unknowns, *arguments: Any) -> Iterator[Any]:
        """Yield what a method of `TileWork` gives for each tile, wherever that is worked on, in order.

        - `unknowns`: of which each gets its part. `arguments`: of the method beside it.
        """
        calls = ((number, tile.take(unknowns), *arguments) for number, (tile, _) in enumerate(self.tiles))
        if self.elsewhere is not None:
            return self.elsewhere.each(name, calls)
        return self.each_tile(getattr(self, name), calls)

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
