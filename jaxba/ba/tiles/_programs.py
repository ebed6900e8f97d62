"""The compiled work on one tile: its equations, what it hands to the fronts, and its part of a step.

Every function takes the tile's own `System` and its part of the unknowns. What tiles return adds up to what the whole
block would give: costs, slopes, curvatures and lengths are sums over observations, gradients and diagonals of images
and cameras sums over the tiles that see them.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float, Int

from jaxba.ba._lengths import all_squared_in_sigmas, slope_along, squared_in_sigmas
from jaxba.ba._linearise import Linearisation, curvature
from jaxba.ba._refine import move_points, refine_points
from jaxba.ba._schur import (
    ReducedVector,
    apply_root,
    back_substitute,
    eliminate,
    eliminate_points,
    reduce_vector,
)
from jaxba.ba._solvers import damped_points
from jaxba.ba._system import System
from jaxba.ba._unknowns import Step, Unknowns


class Handed(NamedTuple):
    """Blocks that a tile hands to the fronts, and its part of gradient and diagonal; images in its solver's order.

    - `off_diagonal`: of the images `System.block_row` and `block_column`.
    - `tail`: of each image border and right-hand side, transposed and padded. `corner`: of the border itself.
    - `gradient`, `diagonal`: see `Linearisation`; those of points are left out.
    - `steepest`: the largest entry of the points' gradient.
    """

    diagonal: Float[Array | np.ndarray, "images block block"]
    off_diagonal: Float[Array | np.ndarray, "blocks block block"]
    tail: Float[Array | np.ndarray, "images tail block"]
    corner: Float[Array | np.ndarray, "tail tail"]
    gradient: Step
    squares: Step
    steepest: Float[Array | np.ndarray, ""]


class Sums(NamedTuple):
    """A tile's part of what a step is judged by; see `_lengths.py`."""

    cost: Float[Array | np.ndarray, ""]
    slope: Float[Array | np.ndarray, ""]
    curvature: Float[Array | np.ndarray, ""]
    in_sigmas: Float[Array | np.ndarray, ""]
    all_in_sigmas: Float[Array | np.ndarray, ""]
    of_points: Float[Array | np.ndarray, ""]
    points_held: Int[Array | np.ndarray, ""]


def tail_size(block: int, border: int, columns: int = 1) -> int:
    """Return border and right-hand sides in blocks, rounded up."""
    return -(-(border + columns) // block)


def hand_over(system: System, model: Linearisation, damping: Float[Array, ""]) -> Handed:
    """Return what a tile hands to the fronts for a step; the damping of images and border is added there, once."""
    damped, of_points = damped_points(model, damping)
    downhill = jax.tree.map(jnp.negative, model.gradient)
    return handed(system, damped, of_points + (1 - system.free.points), downhill)


def handed(system: System, model: Linearisation, of_points: Float[Array | np.ndarray, "points 3"], rhs: Step) -> Handed:
    """Return what a tile hands to the fronts to solve its equations.

    - `of_points`: what is added to the diagonal of the points. `rhs`: the tile's part of the right-hand side.
    """
    return _handed(system, model, of_points, jax.tree.map(lambda leaf: leaf[None], rhs))


def hand_columns(system: System, model: Linearisation, columns: Step) -> Handed:
    """Return what a tile hands to fronts that have many right-hand sides: its part of each.

    - `columns`: along a first axis of each leaf. So the root is handed `-g^T N^-1 g`, g all columns side by side.
    """
    damped, of_points = damped_points(model, jnp.zeros(()))
    return _handed(system, damped, of_points + (1 - system.free.points), columns)


def _handed(
    system: System, model: Linearisation, of_points: Float[Array | np.ndarray, "points 3"], columns: Step
) -> Handed:
    shape = system.shape
    zero = jax.tree.map(jnp.zeros_like, model.gradient)
    reduced = eliminate_points(system, model, eqx.tree_at(lambda s: s.points, zero, of_points))
    vectors = jax.vmap(lambda rhs: reduce_vector(system, reduced.points, rhs))(columns)
    count = len(vectors.border)
    pad = tail_size(shape.block, shape.border, count) * shape.block - shape.border - count
    tail = jnp.concatenate([reduced.border, jnp.moveaxis(vectors.images, 0, 2)], axis=2)
    roots = jax.vmap(lambda points: apply_root(reduced.points.root, points[:, :, None]))(jnp.asarray(columns.points))
    roots = roots.reshape(count, -1)
    below = jnp.concatenate([vectors.border, -(roots @ roots.T)], axis=1)
    above = jnp.pad(reduced.corner, ((0, 0), (0, count)))
    corner = jnp.concatenate([above, below])
    without_points = Step(model.gradient.poses, model.gradient.intrinsics, model.gradient.antenna, zero.points[:0])
    return Handed(
        reduced.diagonal,
        reduced.off_diagonal,
        jnp.swapaxes(jnp.pad(tail, ((0, 0), (0, 0), (0, pad))), 1, 2),
        jnp.pad(corner, ((0, pad), (0, pad))),
        without_points,
        eqx.tree_at(lambda s: s.points, model.diagonal, zero.points[:0]),
        jnp.max(jnp.abs(model.gradient.points), initial=0.0),
    )


def put_back(
    system: System,
    unknowns: Unknowns,
    model: Linearisation,
    images: Float[Array, "images block"],
    border: Float[Array, " border"],
    step: Step,
    damping: Float[Array, ""],
    bend: Float[Array, ""],
) -> tuple[Unknowns, Sums]:
    """Return the tile's unknowns after a step, points refined, and its part of the sums.

    - `images`, `border`: the solution of the reduced system. `step`: the same as a step within the bounds; its points
      are not read.
    """
    damped, of_points = damped_points(model, damping)
    points = eliminate(damped, of_points + (1 - system.free.points))
    solution = ReducedVector(images, border)
    whole = back_substitute(system, points, jax.tree.map(jnp.negative, model.gradient), solution)
    step = eqx.tree_at(lambda s: s.points, step, whole.points)
    moved = eqx.tree_at(lambda u: u.points, unknowns.retract(step), move_points(system, unknowns, step.points))
    trial, cost, held = refine_points(system, moved, unknowns, bend > 0)
    sums = Sums(
        cost=cost,
        slope=slope_along(model.gradient, step),
        curvature=curvature(system, model, step),
        in_sigmas=squared_in_sigmas(model, step),
        all_in_sigmas=all_squared_in_sigmas(system, unknowns, model),
        of_points=jnp.sum(step.points**2),
        points_held=held,
    )
    return trial, sums
