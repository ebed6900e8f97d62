"""Solutions of a block's equations for any right-hand sides, `N^-1 b`, over the tree, one at a time."""

from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxba.ba._compiler import call_compiled
from jaxba.ba._linearise import Linearisation
from jaxba.ba._schur import ReducedVector, back_substitute, eliminate
from jaxba.ba._solvers import damped_points
from jaxba.ba._system import System
from jaxba.ba._unknowns import Step, Unknowns
from jaxba.ba.tiles._engine import Engine
from jaxba.ba.tiles._inverse import inverse_of_border
from jaxba.ba.tiles._programs import Handed, hand_columns
from jaxba.ba.tiles._tile_work import Up


def solved(engine: Engine, unknowns: Unknowns, columns: Sequence[Step]) -> list[Step]:
    """Return the solution for each right-hand side, poses and points alone, both in the problem's order.

    - `columns`: in the problem's order, zero for what is fixed.

    Raises `NotPositive` where the equations have no inverse.
    """
    return [_solved(engine, unknowns, column) for column in columns]


def _solved(engine: Engine, unknowns: Unknowns, rhs: Step) -> Step:
    nothing, count = np.zeros(()), engine.shape.border

    def up(number: int) -> Up:
        tile, _ = engine.tiles[number]
        part = jax.tree.map(lambda leaf: leaf[None], engine.part_of(rhs, number))
        model = engine.equations(number, tile.take(unknowns), nothing)
        handed: Handed = jax.tree.map(np.asarray, call_compiled(hand_columns, engine.system(number), model, part))
        return engine.up_tile(number, handed, nothing)

    top = engine.up(engine.each_tile(up), nothing).update
    border = inverse_of_border(top[:count, :count]) @ top[count, :count] if count else np.zeros(0)
    images, tail = engine.put_back_tops(border)
    points = np.zeros_like(rhs.points)

    def down(number: int) -> tuple[np.ndarray, np.ndarray]:
        tile, _ = engine.tiles[number]
        of_tile = engine.put_back_tile(number, images, tail)
        model = engine.equations(number, tile.take(unknowns), nothing)
        part = engine.part_of(rhs, number)
        return of_tile, np.asarray(call_compiled(_points, engine.system(number), model, part, of_tile, border))

    for (tile, _), (of_tile, of_points) in zip(engine.tiles, engine.each_tile(down), strict=True):
        images[tile.order] = of_tile[: len(tile.order)]
        points[tile.points[tile.plan.point_order]] = of_points[: len(tile.points)]
    return Step(images[:, :6], np.zeros_like(rhs.intrinsics), np.zeros_like(rhs.antenna), points)


def _points(system: System, model: Linearisation, rhs: Step, images: Array, border: Array) -> Array:
    damped, of_points = damped_points(model, jnp.zeros(()))
    points = eliminate(damped, of_points + (1 - system.free.points))
    return jnp.asarray(back_substitute(system, points, rhs, ReducedVector(images, border)).points)
