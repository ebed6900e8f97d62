"""The work on tiles that a step consists of, wherever it is done: here in threads, or in other processes.

A tile linearises its observations, eliminates its points, then its inner images, and hands on a dense matrix over its
boundary; on the way down it solves for its images, then for its points. What it is given and gives back are numbers of
that tile, or of all images; what it keeps from the way up for the way down stays with it.
"""

import abc
from concurrent.futures import ThreadPoolExecutor
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Float, Int

from jaxba.ba._compiler import call_compiled
from jaxba.ba._lengths import MIN_DIAGONAL
from jaxba.ba._linearise import Linearisation, costs, linearise
from jaxba.ba._plan_shape import PlanShape
from jaxba.ba._system import System
from jaxba.ba._unknowns import Step, Unknowns
from jaxba.ba.tiles._cut import Tile
from jaxba.ba.tiles._dissect import Tree
from jaxba.ba.tiles._fronts import Factor, Fronts, TileFronts
from jaxba.ba.tiles._programs import Handed, Sums, hand_over, put_back
from jaxba.ba.tiles._shelf import Shelf


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


class TileWork(abc.ABC):
    """What work on tiles needs.

    - `shape`, `tree`, `fronts`: of the block. `camera_index`: of its images. `free`: 1 for each free unknown of images,
      cameras and antenna.
    - `shelf`: holds systems, and factors of the last way up. `models`: its equations, as far as they fit.
    """

    def __init__(
        self,
        shape: PlanShape,
        tree: Tree,
        fronts: Fronts,
        camera_index: Int[np.ndarray, " images"],
        free: Step,
        shelf: Shelf,
        models: Shelf,
    ) -> None:
        self.shape, self.tree, self.fronts, self.camera_index, self.free = shape, tree, fronts, camera_index, free
        self.shelf, self.models = shelf, models

    @abc.abstractmethod
    def tile(self, number: int) -> tuple[Tile, TileFronts]:
        """Return a tile and its fronts."""

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

    def costs_of_tile(self, number: int, part: Unknowns) -> tuple[float, float]:
        """Return a tile's cost, and that without robust losses."""
        found = call_compiled(costs, self.system(number), part)
        return float(found[0]), float(found[1])

    def step_up(self, number: int, part: Unknowns, damping: Float[np.ndarray, ""], bend: Float[np.ndarray, ""]) -> Up:
        """Return what a tile gives on the way up of a step; keep its equations and factors.

        - `part`: its unknowns. `damping`, `bend`: see `State`.

        Raises `NotPositive` where the damped equations have no factor.
        """
        return self.up_tile(number, self.hand(number, part, damping, bend), damping)

    def hand(self, number: int, part: Unknowns, damping: Float[np.ndarray, ""], bend: Float[np.ndarray, ""]) -> Handed:
        """Return what a tile hands to its fronts for a step, and keep its equations."""
        system = self.system(number)
        model = call_compiled(linearise, system, part, bend)
        handed: Handed = jax.tree.map(np.asarray, call_compiled(hand_over, system, model, damping))
        self.models.put(number, jax.tree.map(np.asarray, model))
        return handed

    def step_down(
        self,
        number: int,
        part: Unknowns,
        solution: Float[np.ndarray, "images block"],
        tail: Float[np.ndarray, " tail"],
        shared: Step,
        damping: Float[np.ndarray, ""],
        bend: Float[np.ndarray, ""],
    ) -> tuple[Unknowns, Sums, Float[np.ndarray, "own block"]]:
        """Return a tile's unknowns after a step, its part of what the step is judged by, and its images' solution.

        - `solution`, `tail`: see `put_back_tile`. `shared`: the step of shared intrinsics and antenna, within bounds.
        """
        images = self.put_back_tile(number, solution, tail)
        system = self.system(number)
        model = self.equations(number, part, bend)
        intrinsics = shared.intrinsics
        if self.shape.own_cameras:
            intrinsics = np.zeros(part.intrinsics.shape)
            intrinsics[:, np.flatnonzero(self.shape.refined)] = images[:, 6:]
        step = Step(images[:, :6], intrinsics, shared.antenna, np.zeros_like(part.points))
        solved = images, tail[: self.shape.border]
        after, sums = call_compiled(put_back, system, part, model, *solved, step, damping, bend)
        return (*jax.tree.map(np.asarray, (after, sums)), images[: len(self.tile(number)[0].order)])

    def up_tile(self, number: int, handed: Handed, damping: Float[np.ndarray, ""]) -> Up:
        """Eliminate a tile's inner images, and keep the factors.

        Raises `NotPositive`.
        """
        tile, fronts = self.tile(number)
        count = len(tile.order)
        squares, gradient = (
            Step(part.poses[:count], part.intrinsics[: len(tile.cameras)], part.antenna, part.points)
            for part in (handed.squares, handed.gradient)
        )
        images, _ = self.reduced(self.damping(squares, damping, tile), np.arange(count))
        updates: dict[int, np.ndarray] = {}
        begin = 0
        for node_number, part in zip(range(fronts.first, fronts.last + 1), fronts.parts, strict=True):
            node = self.tree.nodes[node_number]
            end = begin + len(node.eliminated)
            handed_on = [updates.pop(child) for child in node.children]
            updates[node_number] = self.eliminate(node_number, handed_on, images[begin:end], part, handed)
            begin = end
        diagonal = np.diagonal(handed.diagonal[:count], axis1=1, axis2=2)
        of_border = np.diagonal(handed.corner)[: self.shape.border]
        return Up(updates[fronts.last], gradient, squares, float(handed.steepest), diagonal, of_border)

    def eliminate(self, number: int, *arguments: Any, pool: ThreadPoolExecutor | None = None) -> np.ndarray:
        """Eliminate a node's images as `Fronts.eliminate` does; keep the factor, and return what goes to its parent."""
        old = self.shelf.release(("factor", number))
        if old is not None:
            self.fronts.forget(old)
        factor, update = self.fronts.eliminate(number, *arguments, pool=pool)
        if not self.shelf.put(("factor", number), factor):
            self.fronts.forget(factor)
        return update

    def put_back_tile(
        self, number: int, solution: Float[np.ndarray, "images block"], tail: Float[np.ndarray, " tail"]
    ) -> Float[np.ndarray, "padded block"]:
        """Write the solution of a tile's images into that of all; return the tile's, in its solver's order, padded."""
        tile, fronts = self.tile(number)
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
        antenna = np.asarray(step.antenna if shape.antenna else step.antenna[:0])
        if shape.own_cameras:
            return np.concatenate([step.poses, refined[camera_index]], axis=1), antenna
        return np.asarray(step.poses), np.concatenate([refined.reshape(-1), antenna])

    def damping(self, squares: Step, damping: Float[np.ndarray, ""], tile: Tile | None = None) -> Step:
        """Return what is added to the diagonal of images and border, of a tile's or of all."""
        free = self.free
        if tile is not None:
            free = Step(free.poses[tile.order], free.intrinsics[tile.solver_cameras], free.antenna, free.points)

        def added(squares: np.ndarray, free: np.ndarray) -> np.ndarray:
            largest = squares.max(initial=0.0)
            return damping * np.maximum(squares, MIN_DIAGONAL * largest if largest > 0 else 1.0) + (1 - free)

        return jax.tree.map(added, squares, free)
