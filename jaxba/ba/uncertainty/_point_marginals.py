"""Marginals of points: the compiled part of `_covariance.py`.

With V = L L^T the block of a point and Z_i = L^-1 W_i as in `_schur.py`, and S^-1 the inverse of the reduced system,
over images and the border of shared unknowns,

    cov_x = V^-1 + V^-1 W^T S^-1 W V^-1 = L^-T (I + sum over its observations j of  T_j Z_j^T) L^-1
    cov_xj = -V^-1 W^T S^-1_j = -L^-T T_j,        T_j = sum over its observations i of  Z_i S^-1_ij

in which the border counts as one more block. So of S^-1 no more is needed than its blocks where the reduced system has
some itself. T is summed over runs of pairs of observations.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float, Int

from jaxba.ba._linearise import Linearisation
from jaxba.ba._plan import ROW_RUN
from jaxba.ba._priors import robust_rows
from jaxba.ba._rows import rows_of
from jaxba.ba._schur import apply_root, eliminate
from jaxba.ba._solvers import damped_points
from jaxba.ba._system import System
from jaxba.ba._unknowns import Unknowns


class InverseBlocks(NamedTuple):
    """The inverse of the reduced system where the system itself has blocks; images in the solver's order.

    - `off_diagonal`: of the images `System.block_row` and `block_column`.
    - `border`: between images and border. `corner`: of the border.
    """

    diagonal: Float[Array | np.ndarray, "images block block"]
    off_diagonal: Float[Array | np.ndarray, "blocks block block"]
    border: Float[Array | np.ndarray, "images block border"]
    corner: Float[Array | np.ndarray, "border border"]


class Squares(NamedTuple):
    """Squares of residuals over their sigmas, a group's rows: summed over components that depend on something free."""

    squared: Float[Array | np.ndarray, " rows"]
    components: Int[Array | np.ndarray, " rows"]


class Joint(NamedTuple):
    """Covariances of points, and of points with what they are seen by; zero for what is fixed.

    - `with_images`: of the point of each row with its image. `with_border`: of each point with the border.
    """

    points: Float[Array | np.ndarray, "points 3 3"]
    with_images: Float[Array | np.ndarray, "rows 3 block"]
    with_border: Float[Array | np.ndarray, "points 3 border"]


def point_marginals(
    system: System, model: Linearisation, inverse: InverseBlocks, damping: Float[Array, ""]
) -> Float[Array, "points 3 3"]:
    """Return the points' covariances; zero for what is fixed.

    - `damping`: of the points' blocks, as in a step.
    """
    return jnp.asarray(joint_marginals(system, model, inverse, damping).points)


def joint_marginals(system: System, model: Linearisation, inverse: InverseBlocks, damping: Float[Array, ""]) -> Joint:
    """Return the points' covariances, and those with images and border; arguments as of `point_marginals`."""
    shape = system.shape
    damped, of_points = damped_points(model, damping)
    eliminated = eliminate(damped, of_points + (1 - system.free.points))
    point = jnp.asarray(system.reprojection.point_index).reshape(-1)
    image = jnp.repeat(jnp.asarray(system.reprojection.run_image), ROW_RUN)
    z = apply_root(rows_of(eliminated.root, point), eliminated.w)
    z_shared = apply_root(eliminated.root, eliminated.shared)
    num_shared = z_shared.shape[-1]
    from_border = jnp.swapaxes(inverse.border[:, :, :num_shared], 1, 2)

    def add_pairs(through: Array, pairs: tuple[Array, Array, Array]) -> tuple[Array, None]:
        first, second, block = pairs
        between = rows_of(inverse.off_diagonal, block)
        to_second = jnp.einsum("rnij,rjk->rnik", rows_of(z, first), between)
        to_first = jnp.einsum("rnij,rkj->rnik", rows_of(z, second), between)
        return through.at[second].add(to_second).at[first].add(to_first), None

    through = jnp.zeros_like(z)
    if shape.num_blocks:
        first, second = jnp.asarray(system.pair_first), jnp.asarray(system.pair_second)
        block = jnp.asarray(system.pair_block).reshape(first.shape[:2])
        through, _ = jax.lax.scan(add_pairs, through, (first, second, block))

    def add_own(carry: tuple[Array, Array], rows: tuple[Array, ...]) -> tuple[tuple[Array, Array], Array]:
        total, to_border = carry
        own, through, seen, at = rows
        through += jnp.einsum("nij,njk->nik", own, rows_of(inverse.diagonal, seen))
        through += jnp.einsum("nig,ngk->nik", rows_of(z_shared, at), rows_of(from_border, seen))
        product = jnp.einsum("nij,nlj->nil", through, own)
        on_border = jnp.einsum("nij,njk->nik", own, rows_of(inverse.border, seen))
        return (total.at[at].add(product), to_border.at[at].add(on_border)), through

    def split(of_rows: Array) -> Array:
        return of_rows.reshape(-1, shape.chunk_runs * ROW_RUN, *of_rows.shape[1:])

    start = jnp.zeros((shape.num_points, 3, 3), z.dtype), z_shared @ inverse.corner[:num_shared]
    (total, to_border), through = jax.lax.scan(add_own, start, tuple(map(split, (z, through, image, point))))
    total += jnp.einsum("nig,nlg->nil", to_border[:, :, :num_shared], z_shared)
    lower = np.tril_indices(3)
    root = jnp.zeros((shape.num_points, 3, 3), z.dtype).at[:, lower[0], lower[1]].set(eliminated.root)
    covariances = jnp.einsum("nki,nkl,nlj->nij", root, jnp.eye(3, dtype=z.dtype) + total, root)
    with_images = -jnp.einsum("nki,nkj->nij", rows_of(root, point), through.reshape(z.shape))
    with_border = -jnp.einsum("nki,nkj->nij", root, to_border)
    return Joint(covariances * system.free.points[:, :1, None], with_images, with_border)


def squares(system: System, unknowns: Unknowns) -> tuple[Squares, ...]:
    """Return the squares of the reprojections' residuals, then of each prior's."""
    group, free = system.reprojection, system.free
    of_image = free.poses[:, 0] + jnp.sum(rows_of(free.intrinsics, group.camera_index), axis=1)
    anything = rows_of(of_image, group.run_image)[:, None] + rows_of(free.points[:, 0], group.point_index)
    depends = (anything > 0) & (jnp.asarray(group.weight) > 0)
    groups = [(group.residual(unknowns)[0], jnp.stack([depends, depends]))]
    for prior in system.priors:
        residual, rows = prior.residual(unknowns), robust_rows(system, prior, unknowns, jnp.zeros(()))
        depends = jnp.zeros(residual.shape, bool)
        blocks = [block.jacobian for block in (rows.pose, rows.intrinsics, rows.point) if block is not None]
        for derivative in [*blocks, *([] if rows.antenna is None else [rows.antenna])]:
            depends |= jnp.any(derivative != 0, axis=1)
        groups.append((residual, depends))
    return tuple(
        Squares(jnp.sum(jnp.where(on, r, 0.0) ** 2, axis=0).reshape(-1), jnp.sum(on, axis=0).reshape(-1))
        for r, on in groups
    )
