"""Marginals: the diagonal blocks of (J^T J)^-1, from the reduced system; the compiled part of `_covariance.py`.

With the points eliminated, S = [A B; B^T C] is the reduced system without damping (`_schur.py`), over images and the
border of shared unknowns. Its inverse holds the covariances of both,

    S^-1 = [A^-1 + F G^-1 F^T   -F G^-1]       F = A^-1 B       G = C - B^T F
           [ .                    G^-1 ]

and each point's follows from its own observations: with V = L L^T and Z_i as in `_schur.py`,

    cov_x = V^-1 + V^-1 W^T S^-1 W V^-1 = L^-T (I + sum over its observations i, j of  Z_i S^-1_ij Z_j^T) L^-1

in which the border counts as one more block.

**Variance factor.** Under least squares it is `sum r^2 / redundancy`. A robust loss is there for errors that no sigma
describes, so that neither their squares nor the loss's cost tells whether the sigmas are right: with right ones twice
the cost over the redundancy is 0.84 under Huber(1) and 0.51 under Cauchy(1). There the factor k^2 solves

    sum min(r^2, q f k^2) = f k^2 sum E min(chi^2_c, q),   f = redundancy / components

with q the 99th percentile of chi^2_c, c the components of an observation. With right sigmas it comes out as 0.98 under
Huber(1) and 1.02 under Cauchy(1), with 2% of gross errors as 1.11 and 1.14 (blocks of 20 and 40 images).

Cost: A^-1 is dense, 75 MB for 500 images, and solved for in pieces of `_COLUMNS`; points are summed over pieces of
`_CHUNK` pairs of observations.
"""

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Bool, Float, Int
from scipy.stats import chi2

from jaxba.ba._compiler import fast_jit
from jaxba.ba._factor import factor_reduced, factor_solve
from jaxba.ba._linearise import linearise
from jaxba.ba._plan import Plan
from jaxba.ba._priors import robust_rows
from jaxba.ba._rows import rows_of
from jaxba.ba._schur import Eliminated, Reduced, apply_root, eliminate_points, one_for_fixed
from jaxba.ba._system import System
from jaxba.ba._unknowns import Unknowns
from jaxba.geometry import AbstractLoss, Linear

_CHUNK = 4096
_COUNTED = 0.99  # of errors whose squares count in full where the loss is robust
_PASSES = 30  # each takes some 0.85 of what is left
_COLUMNS = 384  # of A^-1 solved for at a time: keeps one dense matrix in memory, not four


class Marginals(eqx.Module):
    """Covariances in the solver's order, padding included.

    - `blocks`: of images. `border`: joint, of the shared unknowns.
    - `block_inflation`, `border_inflation`: each variance over what it were if all other unknowns were known.
    - `variance_factor`, `redundancy`: see `_covariance.Covariance`.
    """

    blocks: Float[Array, "images block block"]
    border: Float[Array, "border border"]
    points: Float[Array, "points 3 3"]
    block_inflation: Float[Array, "images block"]
    border_inflation: Float[Array, " border"]
    variance_factor: Float[Array, ""]
    redundancy: Int[Array, ""]


@fast_jit
def marginals(
    system: System,
    plan: Plan,
    unknowns: Unknowns,
    num_free: Int[Array | np.ndarray, ""],
    damping: Float[Array | np.ndarray, ""],
) -> Marginals:
    """Return the marginals, of a system damped by `damping * diag(J^T J)`; `num_free` counts what may change."""
    model = linearise(system, unknowns)
    damped = one_for_fixed(system, jax.tree.map(lambda d: damping * d, model.diagonal))
    reduced = eliminate_points(system, model, damped)
    inverse, cross, corner = _inverse(system, reduced)
    images = jnp.arange(system.shape.num_images)
    blocks = inverse[images, :, images]
    diagonal = jnp.diagonal(reduced.diagonal, axis1=1, axis2=2)
    variance_factor, redundancy = _variance_factor(system, plan, unknowns, num_free)
    return Marginals(
        blocks=blocks,
        border=corner,
        points=_point_covariances(system, plan, reduced.points, inverse, cross, corner),
        block_inflation=jnp.diagonal(blocks, axis1=1, axis2=2) * diagonal,
        border_inflation=jnp.diagonal(corner) * jnp.diagonal(reduced.corner),
        variance_factor=variance_factor,
        redundancy=redundancy,
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
    system: System, plan: Plan, eliminated: Eliminated, inverse: Array, cross: Array, corner: Array
) -> Float[Array, "points 3 3"]:
    shape = system.shape
    point, image = jnp.asarray(plan.row_point), jnp.asarray(plan.row_image)
    z, z_shared = (
        apply_root(rows_of(eliminated.root, point), eliminated.w),
        apply_root(eliminated.root, eliminated.shared),
    )
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
    root = _lower_triangle(eliminated.root)
    covariances = jnp.einsum("nki,nkl,nlj->nij", root, jnp.eye(3, dtype=z.dtype) + total, root)
    return covariances * system.free.points[:, :1, None]


def _lower_triangle(root: Float[Array, "points 6"]) -> Float[Array, "points 3 3"]:
    """L^-1 as matrices, from (xx, yx, yy, zx, zy, zz)."""
    rows, columns = np.tril_indices(3)
    return jnp.zeros((root.shape[0], 3, 3), root.dtype).at[:, rows, columns].set(root)


def _variance_factor(
    system: System, plan: Plan, unknowns: Unknowns, num_free: Int[Array | np.ndarray, ""]
) -> tuple[Float[Array, ""], Int[Array, ""]]:
    """Return the variance factor, and the redundancy: components that depend on something free, minus free unknowns."""
    group, free = system.reprojection, system.free
    of_image = free.poses[:, 0] + jnp.sum(free.intrinsics[jnp.asarray(group.camera_index)], axis=1)
    anything = of_image[jnp.asarray(plan.row_image)] + free.points[jnp.asarray(plan.row_point), 0]
    depends = (anything > 0) & (jnp.asarray(plan.row_observation) >= 0)
    measured = [(system.loss, group.residual(unknowns)[0].reshape(2, -1), jnp.stack([depends, depends]))]
    for prior in system.priors:
        residual, rows = prior.residual(unknowns), robust_rows(system, prior, unknowns, jnp.zeros(()))
        depends = jnp.zeros(residual.shape, bool)
        blocks = [block.jacobian for block in (rows.pose, rows.intrinsics, rows.point) if block is not None]
        for derivative in [*blocks, *([] if rows.lever_arm is None else [rows.lever_arm])]:
            depends |= jnp.any(derivative != 0, axis=1)
        measured.append((prior.loss, residual, depends))

    number = sum(jnp.sum(depends) for _, _, depends in measured)
    redundancy = jnp.asarray(number - num_free)
    left = redundancy / number  # of an error's variance in its residual, on the average
    rows = [(*_tail(loss, depends), jnp.sum(jnp.where(depends, r, 0.0) ** 2, axis=0)) for loss, r, depends in measured]
    expected = _total([jnp.sum(mean) for _, mean, _ in rows]) * left

    def narrower(_: Array | int, factor: Array) -> Array:
        return _total([jnp.sum(jnp.minimum(s, limit * left * factor)) for limit, _, s in rows]) / expected

    factor = jax.lax.fori_loop(0, _PASSES, narrower, _total([jnp.sum(s) for _, _, s in rows]) / expected)
    return jnp.where(redundancy > 0, factor, jnp.nan), redundancy


def _tail(
    loss: AbstractLoss, depends: Bool[Array, "components rows"]
) -> tuple[Float[Array, " rows"], Float[Array, " rows"]]:
    """Return where the square of an error counts as its limit, and the mean of what counts, for an error of sigma 1."""
    freedom = np.arange(depends.shape[0] + 1)
    limit = np.where(isinstance(loss, Linear), np.inf, chi2.ppf(_COUNTED, np.maximum(freedom, 1)))
    beyond = 0.0 if isinstance(loss, Linear) else limit * chi2.sf(limit, np.maximum(freedom, 1))
    mean = np.where(freedom > 0, freedom * chi2.cdf(limit, freedom + 2) + beyond, 0.0)
    count = jnp.sum(depends, axis=0)
    return rows_of(limit, count), rows_of(mean, count)


def _total(terms: list[Array]) -> Array:
    return functools.reduce(jnp.add, terms)
