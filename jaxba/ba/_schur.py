"""Schur reduction: eliminate the points of the damped normal equations, and put them back.

With V_p the damped 3x3 block of point p, V_p = L L^T, W an observation's block with its image and W_k,p the point's
with the shared border,

    Z = L^-1 W  (3xb)        Z_k,p = L^-1 W_k,p  (3xg)

the reduced system over images and border, U, B and C the blocks that were there before, is

    S_ij = -sum over pairs Z_i^T Z_j                      S_ii = U_i - sum Z^T Z
    B_i  = B_i - sum Z^T Z_k,p                            C    = C - sum Z_k,p^T Z_k,p

plus the priors and the damping. Sums over an image are batched products of runs of rows; sums over pairs are products
of short runs gathered a few at a time, so that they stay in the cache: 188k pairs of 500 images take 10 ms, where one
product a pair takes 56 ms. They are added up at once: the products of all runs are as large as Z where tracks are long.
Right-hand sides and back-substitution need W and the points' L^-1 alone.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float

from jaxba.ba._linearise import Linearisation, refined_columns, sum_cameras, sum_runs, w_product
from jaxba.ba._plan import ROW_RUN
from jaxba.ba._priors import PriorBlocks
from jaxba.ba._products import run_products
from jaxba.ba._rows import rows_of, segments
from jaxba.ba._system import System
from jaxba.ba._unknowns import Step


class Eliminated(eqx.Module):
    """Points taken out of the equations.

    - `root`: the lower triangle (xx, yx, yy, zx, zy, zz) of each point's L^-1.
    - `w`, `shared`: W of each observation, W_k of each point.
    """

    root: Float[Array, "points 6"]
    w: Float[Array, "rows 3 block"]
    shared: Float[Array, "points 3 shared"]


class Reduced(eqx.Module):
    """The reduced system [A B; B^T C], block-sparse over images with a dense border, and the eliminated points.

    - `diagonal`, `off_diagonal`: blocks of A; off-diagonal ones lie below the diagonal, see `System.block_row`.
    """

    diagonal: Float[Array, "images block block"]
    off_diagonal: Float[Array, "blocks block block"]
    border: Float[Array, "images block border"]
    corner: Float[Array, "border border"]
    points: Eliminated


class ReducedVector(eqx.Module):
    """A vector over the reduced system's unknowns."""

    images: Float[Array, "images block"]
    border: Float[Array, " border"]


def one_for_fixed(system: System, damping: Step) -> Step:
    """Return the damping with a one for all that is fixed or padding, which has nothing on its diagonal."""
    return jax.tree.map(lambda d, free: d + (1 - free), damping, system.free)


def eliminate(model: Linearisation, damping: Float[Array | np.ndarray, "points 3"]) -> Eliminated:
    """Return the points taken out of `J^T J + diag(damping)`."""
    root = _inverse_root(model.point_products + diagonal_matrix(jnp.asarray(damping)))
    return Eliminated(root, model.w, model.point_shared)


def eliminate_points(system: System, model: Linearisation, damping: Step) -> Reduced:
    """Return the reduced system of `J^T J + diag(damping)`; see `one_for_fixed`."""
    shape = system.shape
    points = eliminate(model, damping.points)
    z_shared = apply_root(points.root, model.point_shared)
    z, products = _eliminate_rows(system, model.w, points.root, z_shared)
    eliminated = sum_runs(system, products)

    columns = 6 + shape.num_refined
    before = model.image_products[:, :columns, :columns]
    vector = to_reduced(system, damping)
    diagonal = before[:, : shape.block, : shape.block] - eliminated[:, :, : shape.block]
    diagonal += diagonal_matrix(vector.images)
    num_shared = shape.border - shape.antenna  # what follows them in `z_shared` is the antenna
    border = -eliminated[:, :, shape.block :]
    flat = z_shared.reshape(3 * shape.num_points, z_shared.shape[-1])
    corner = -(flat.T @ flat)
    if num_shared:
        k, images = shape.num_refined, jnp.arange(shape.num_images)
        camera = system.reprojection.camera_index
        by_camera = border[:, :, :num_shared].reshape(shape.num_images, 6, shape.num_cameras, k)
        by_camera = by_camera.at[images, :, camera, :].add(before[:, :6, 6:])
        border = border.at[:, :, :num_shared].set(by_camera.reshape(shape.num_images, 6, num_shared))
        corner = _add_cameras(corner, sum_cameras(system, before[:, 6:, 6:]))
    antenna = shape.border - z_shared.shape[-1]
    border = jnp.pad(border, ((0, 0), (0, 0), (0, antenna)))
    corner = jnp.pad(corner, ((0, antenna), (0, antenna))) + diagonal_matrix(vector.border)
    diagonal, border, corner = _add_priors(system, model.prior_blocks, diagonal, border, corner)
    return Reduced(diagonal, _sum_pairs(system, z), border, corner, points)


def reduce_vector(system: System, points: Eliminated, rhs: Step) -> ReducedVector:
    """Return the right-hand side of the reduced system, `b - W V^-1 b_points`."""
    solved = _solve_roots(points.root, jnp.asarray(rhs.points))
    at_rows = rows_of(solved, system.reprojection.point_index).reshape(-1, 3 * ROW_RUN)
    w = points.w.reshape(-1, 3 * ROW_RUN, points.w.shape[-1])
    through = jnp.einsum("rka,rk->ra", w, at_rows)
    vector = to_reduced(system, rhs)
    shared = jnp.einsum("pcg,pc->g", points.shared, solved)
    shared = jnp.pad(shared, (0, vector.border.shape[0] - shared.shape[0]))
    return ReducedVector(vector.images - sum_runs(system, through), vector.border - shared)


def back_substitute(system: System, points: Eliminated, rhs: Step, solution: ReducedVector) -> Step:
    """Return the full step whose images and border are `solution`, with `x = V^-1 (b_points - W^T solution)`."""
    moved = w_product(system, points.w, solution.images)
    moved = segments(moved, system.reprojection.point_index, system.shape.num_points)
    moved += points.shared @ solution.border[: points.shared.shape[-1]]
    solved = _solve_roots(points.root, jnp.asarray(rhs.points) - moved)
    return eqx.tree_at(lambda s: s.points, from_reduced(system, solution, rhs), solved)


def solve_points(
    system: System,
    matrix: Float[Array, "points 3 3"],
    rhs: Float[Array, "points 3"],
    damping: Float[Array, " points"],
) -> Float[Array, "points 3"]:
    """Return `(V + damping diag(V))^-1 b` of every point, zero for fixed ones."""
    diagonal = jnp.diagonal(matrix, axis1=1, axis2=2) * damping[:, None]
    seen = jnp.any(diagonal > 0, axis=1, keepdims=True)
    root = _inverse_root(matrix + diagonal_matrix(jnp.where(seen, diagonal, 1.0)))
    return _solve_roots(root, rhs) * system.free.points


def to_reduced(system: System, step: Step) -> ReducedVector:
    """Return the images' and the border's part of a step."""
    shape = system.shape
    poses, antenna = jnp.asarray(step.poses), jnp.asarray(step.antenna)
    intrinsics = step.intrinsics[:, refined_columns(system)]
    border = antenna if shape.antenna else antenna[:0]
    if shape.own_cameras:
        return ReducedVector(jnp.concatenate([poses, intrinsics], axis=1), border)
    return ReducedVector(poses, jnp.concatenate([intrinsics.reshape(-1), border]))


def from_reduced(system: System, vector: ReducedVector, like: Step) -> Step:
    """Return a step with these images and border, zero elsewhere."""
    shape = system.shape
    zero = jax.tree.map(jnp.zeros_like, like)
    shared = shape.num_shared_cameras * shape.num_refined
    refined = (
        vector.images[:, 6:]
        if shape.own_cameras
        else vector.border[:shared].reshape(shape.num_cameras, shape.num_refined)
    )
    antenna = vector.border[shared:] if shape.antenna else zero.antenna
    intrinsics = zero.intrinsics.at[:, refined_columns(system)].set(refined)
    return Step(vector.images[:, :6], intrinsics, antenna, zero.points)


def _eliminate_rows(
    system: System,
    w: Float[Array, "rows 3 block"],
    root: Float[Array, "points 6"],
    z_shared: Float[Array, "points 3 g"],
) -> tuple[Float[Array, "rows 3 block"], Float[Array, "runs block columns"]]:
    """Return Z of every row, and `Z^T [Z Z_k]` of every run."""
    of_points = jnp.concatenate([root, z_shared.reshape(root.shape[0], 3 * z_shared.shape[-1])], axis=1)
    rows = system.shape.chunk_runs * ROW_RUN

    def chunk(_: None, fields: tuple[Array, Array]) -> tuple[None, tuple[Array, Array]]:
        w, index = fields
        at_rows = rows_of(of_points, index)
        z = apply_root(at_rows[:, :6], w)
        shared = at_rows[:, 6:].reshape(rows, 3, z_shared.shape[-1])
        left, right = (a.reshape(-1, 3 * ROW_RUN, a.shape[-1]) for a in (z, jnp.concatenate([z, shared], axis=-1)))
        return None, (z, run_products(left, right))

    point_index = jnp.asarray(system.reprojection.point_index).reshape(-1, rows)
    _, (z, products) = jax.lax.scan(chunk, None, (w.reshape(-1, rows, *w.shape[1:]), point_index))
    return z.reshape(w.shape), products.reshape(-1, *products.shape[2:])


def _inverse_root(matrix: Float[Array, "n 3 3"]) -> Float[Array, "n 6"]:
    """Lower triangle of L^-1 with matrix = L L^T, component by component; pivots are kept positive."""
    xx, xy, xz, yy, yz, zz = (matrix[:, i, j] for i, j in ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2)))
    tiny = 1e-14
    a = 1 / jnp.sqrt(xx)
    l10, l20 = xy * a, xz * a
    b = 1 / jnp.sqrt(jnp.maximum(yy - l10**2, tiny * yy))
    l21 = (yz - l20 * l10) * b
    c = 1 / jnp.sqrt(jnp.maximum(zz - l20**2 - l21**2, tiny * zz))
    ba = -b * l10 * a
    return jnp.stack([a, ba, b, -c * (l20 * a + l21 * ba), -c * l21 * b, c], axis=-1)


def apply_root(root: Float[Array, "n 6"], vectors: Float[Array, "n 3 k"]) -> Float[Array, "n 3 k"]:
    """Return L^-1 v, for k vectors each."""
    r = root[:, :, None]
    x, y, z = vectors[:, 0], vectors[:, 1], vectors[:, 2]
    return jnp.stack([r[:, 0] * x, r[:, 1] * x + r[:, 2] * y, r[:, 3] * x + r[:, 4] * y + r[:, 5] * z], axis=1)


def _solve_roots(root: Float[Array, "n 6"], vectors: Float[Array, "n 3"]) -> Float[Array, "n 3"]:
    """Return L^-T L^-1 v."""
    r = root.T
    u, v, w = apply_root(root, vectors[:, :, None])[:, :, 0].T
    return jnp.stack([r[0] * u + r[1] * v + r[3] * w, r[2] * v + r[4] * w, r[5] * w], axis=-1)


def diagonal_matrix(diagonal: Float[Array, "*n k"]) -> Float[Array, "*n k k"]:
    """Return matrices with these diagonals."""
    return diagonal[..., None] * jnp.eye(diagonal.shape[-1], dtype=diagonal.dtype)


def _sum_pairs(system: System, z: Float[Array, "rows 3 block"]) -> Float[Array, "blocks block block"]:
    """Sum `-Z_i^T Z_j` over the pairs of every off-diagonal block."""
    shape = system.shape
    if shape.num_blocks == 0:
        return jnp.zeros((0, shape.block, shape.block), z.dtype)

    def chunk(total: Array, fields: tuple[Array, Array, Array]) -> tuple[Array, None]:
        *pairs, block = fields
        first, second = (rows_of(z, p).reshape(p.shape[0], -1, shape.block) for p in pairs)
        runs = run_products(first, second)
        return total.at[block].add(-runs, indices_are_sorted=True, mode="promise_in_bounds"), None

    first, second = jnp.asarray(system.pair_first), jnp.asarray(system.pair_second)
    block = jnp.asarray(system.pair_block).reshape(first.shape[:2])
    nothing = jnp.zeros((shape.num_blocks, shape.block, shape.block), z.dtype)
    return jax.lax.scan(chunk, nothing, (first, second, block))[0]


def _add_priors(
    system: System,
    blocks: PriorBlocks,
    diagonal: Float[Array, "images block block"],
    border: Float[Array, "images block border"],
    corner: Float[Array, "border border"],
) -> tuple[Array, Array, Array]:
    """Add the priors' blocks of poses, intrinsics and antenna."""
    shape, refined = system.shape, refined_columns(system)
    diagonal = diagonal.at[:, :6, :6].add(blocks.poses)
    of_cameras = blocks.intrinsics[:, refined[:, None], refined]
    if shape.own_cameras:
        diagonal = diagonal.at[:, 6:, 6:].add(of_cameras)
    elif shape.num_refined:
        corner = _add_cameras(corner, of_cameras)
    if shape.antenna:
        antenna = slice(shape.border - shape.antenna, shape.border)
        corner = corner.at[antenna, antenna].add(blocks.antenna)
        border = border.at[:, :6, antenna].add(blocks.poses_antenna)
    return diagonal, border, corner


def _add_cameras(
    corner: Float[Array, "border border"], products: Float[Array, "cameras refined refined"]
) -> Float[Array, "border border"]:
    """Add each camera's block to the diagonal of the corner."""
    cameras, k = products.shape[:2]
    index = jnp.arange(cameras)
    blocks = jnp.zeros((cameras, k, cameras, k), corner.dtype).at[index, :, index, :].set(products)
    return corner.at[: cameras * k, : cameras * k].add(blocks.reshape(cameras * k, -1))
