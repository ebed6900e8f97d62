"""Marginals: the diagonal blocks of (J^T J)^-1, from the reduced system; the compiled part of `_covariance.py`.

With the points eliminated, S = [A B; B^T C] is the reduced system without damping (`_schur.py`), over images and the
border of shared unknowns. Its inverse holds the covariances of both,

    S^-1 = [A^-1 + F G^-1 F^T   -F G^-1]       F = A^-1 B       G = C - B^T F
           [ .                    G^-1 ]

and each point's follows from its own observations: with V = L L^T and Z_i as in `_schur.py`,

    cov_x = V^-1 + V^-1 W^T S^-1 W V^-1 = L^-T (I + sum over its observations i, j of  Z_i S^-1_ij Z_j^T) L^-1

in which the border counts as one more block.

Cost: A^-1 is dense, 75 MB for 500 images, and solved for in pieces of `_COLUMNS`; points are summed over pieces of
`_CHUNK` pairs of observations.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float, Int

from jaxba.ba._compiler import fast_jit
from jaxba.ba._factor import factor_reduced, factor_solve
from jaxba.ba._linearise import linearise
from jaxba.ba._plan import Plan
from jaxba.ba._priors import robust_rows
from jaxba.ba._schur import Reduced, eliminate_points
from jaxba.ba._system import System
from jaxba.ba._unknowns import Unknowns

_CHUNK = 4096
_COLUMNS = 384  # of A^-1 solved for at a time: keeps one dense matrix in memory, not four


class Marginals(eqx.Module):
    """Covariances in the solver's order, padding included.

    - `blocks`: of images. `border`: joint, of the shared unknowns.
    - `block_inflation`, `border_inflation`: each variance over what it were if all other unknowns were known.
    - `double_cost`, `num_rows`: of the measured components that depend on something free.
    """

    blocks: Float[Array, "images block block"]
    border: Float[Array, "border border"]
    points: Float[Array, "points 3 3"]
    block_inflation: Float[Array, "images block"]
    border_inflation: Float[Array, " border"]
    double_cost: Float[Array, ""]
    num_rows: Int[Array, ""]


@fast_jit
def marginals(system: System, plan: Plan, unknowns: Unknowns, damping: Float[Array | np.ndarray, ""]) -> Marginals:
    """Return the marginals, of a system damped by `damping * diag(J^T J)`."""
    model = linearise(system, unknowns)
    reduced = eliminate_points(system, model, jax.tree.map(lambda d: damping * d, model.diagonal))
    inverse, cross, corner = _inverse(system, reduced)
    images = jnp.arange(system.shape.num_images)
    blocks = inverse[images, :, images]
    diagonal = jnp.diagonal(reduced.diagonal, axis1=1, axis2=2)
    double_cost, num_rows = _sum_of_losses(system, plan, unknowns)
    return Marginals(
        blocks=blocks,
        border=corner,
        points=_point_covariances(system, plan, reduced, inverse, cross, corner),
        block_inflation=jnp.diagonal(blocks, axis1=1, axis2=2) * diagonal,
        border_inflation=jnp.diagonal(corner) * jnp.diagonal(reduced.corner),
        double_cost=double_cost,
        num_rows=num_rows,
    )


def _inverse(system: System, reduced: Reduced) -> tuple[Array, Array, Array]:
    """Return S^-1: (images block images block), (images block border), (border border)."""
    shape = system.shape
    size = shape.num_images * shape.block
    factored = factor_reduced(system, reduced)
    factor, through, corner = factored.images, factored.through, factored.corner
    if shape.border:
        scale = 1 / jnp.sqrt(jnp.diagonal(corner))
        root = jnp.linalg.cholesky(corner * scale[:, None] * scale)
        half = jax.scipy.linalg.solve_triangular(root, jnp.diag(scale), lower=True)
        corner = half.T @ half
    cross = -jnp.einsum("mbg,gh->mbh", through, corner)

    def piece(carry: None, column: Array) -> tuple[None, Array]:
        identity = (jnp.arange(size)[:, None] == column).astype(cross.dtype)
        solved, _ = factor_solve(system, reduced, factor, identity.reshape(shape.num_images, shape.block, _COLUMNS))
        solved = solved.reshape(size, _COLUMNS)
        if shape.border:
            own = jnp.take(through.reshape(size, shape.border), column, axis=0, mode="clip")
            solved -= cross.reshape(size, shape.border) @ own.T
        return carry, solved.T

    _, inverse = jax.lax.scan(piece, None, jnp.arange(size + -size % _COLUMNS).reshape(-1, _COLUMNS))
    inverse = inverse.reshape(-1, size)[:size]
    return inverse.reshape(shape.num_images, shape.block, shape.num_images, shape.block), cross, corner


def _point_covariances(
    system: System, plan: Plan, reduced: Reduced, inverse: Array, cross: Array, corner: Array
) -> Float[Array, "points 3 3"]:
    shape = system.shape
    point, image = jnp.asarray(plan.row_point), jnp.asarray(plan.row_image)
    z, z_shared = reduced.z, reduced.z_shared
    num_shared = z_shared.shape[-1]
    cross, corner = cross[:, :, :num_shared], corner[:num_shared, :num_shared]  # no observation sees the lever arm

    def pieces(rows: Array) -> Array:
        last = shape.num_rows - 1  # padding, of weight zero
        return jnp.pad(rows.reshape(-1), (0, -rows.size % _CHUNK), constant_values=last).reshape(-1, _CHUNK)

    def add_pairs(total: Array, pair: tuple[Array, Array]) -> tuple[Array, None]:
        first, second = pair
        between = inverse[image[first], :, image[second]]
        product = jnp.einsum("nij,njk,nlk->nil", z[first], between, z[second])
        return total.at[point[first]].add(product), None

    def add_border(total: Array, rows: Array) -> tuple[Array, None]:
        return total.at[point[rows]].add(jnp.einsum("nij,njk->nik", z[rows], cross[image[rows]])), None

    every = pieces(jnp.arange(shape.num_rows, dtype=jnp.int32))
    total = jnp.zeros((shape.num_points, 3, 3), z.dtype)
    if shape.num_blocks:
        pairs = (pieces(jnp.asarray(plan.pair_first)), pieces(jnp.asarray(plan.pair_second)))
        total, _ = jax.lax.scan(add_pairs, total, pairs)
    total, _ = jax.lax.scan(add_pairs, total + jnp.swapaxes(total, 1, 2), (every, every))
    if num_shared:
        through, _ = jax.lax.scan(add_border, jnp.zeros_like(z_shared), every)
        mixed = jnp.einsum("nik,njk->nij", through, z_shared)
        total += mixed + jnp.swapaxes(mixed, 1, 2)
        total += jnp.einsum("nik,kl,njl->nij", z_shared, corner, z_shared)
    root = _lower_triangle(reduced.point_root)
    covariances = jnp.einsum("nki,nkl,nlj->nij", root, jnp.eye(3, dtype=z.dtype) + total, root)
    return covariances * system.free.points[:, :1, None]


def _lower_triangle(root: Float[Array, "points 6"]) -> Float[Array, "points 3 3"]:
    """L^-1 as matrices, from (xx, yx, yy, zx, zy, zz)."""
    rows, columns = np.tril_indices(3)
    return jnp.zeros((root.shape[0], 3, 3), root.dtype).at[:, rows, columns].set(root)


def _sum_of_losses(system: System, plan: Plan, unknowns: Unknowns) -> tuple[Array, Array]:
    """Return twice the cost of the components that depend on something free, and their number."""
    group, free = system.reprojection, system.free
    of_image = free.poses[:, 0] + jnp.sum(free.intrinsics[jnp.asarray(group.camera_index)], axis=1)
    anything = of_image[jnp.asarray(plan.row_image)] + free.points[jnp.asarray(plan.row_point), 0]
    depends = (anything > 0) & (jnp.asarray(plan.row_observation) >= 0)
    squared = jnp.sum(group.residual(unknowns)[0].reshape(2, -1) ** 2, axis=0)
    total, number = jnp.sum(system.loss(jnp.where(depends, squared, 0.0))), 2 * jnp.sum(depends)
    for prior in system.priors:
        residual, rows = prior.residual(unknowns), robust_rows(system, prior, unknowns, jnp.zeros(()))
        depends = jnp.zeros(residual.shape, bool)
        blocks = [block.jacobian for block in (rows.pose, rows.intrinsics, rows.point) if block is not None]
        for derivative in [*blocks, *([] if rows.lever_arm is None else [rows.lever_arm])]:
            depends |= jnp.any(derivative != 0, axis=1)
        total += jnp.sum(prior.loss(jnp.sum(jnp.where(depends, residual, 0.0) ** 2, axis=0)))
        number += jnp.sum(depends)
    return total, number
