"""Factor and solve the reduced system [A B; B^T C], A block-sparse over images, B and C a dense border.

A is factored as L L^T once, then `A^-1 [B, a]` gives the border's own small system, which also takes the bounds. Three
ways:

- dense: one LAPACK Cholesky, n^3/3 flops. Best up to some 1500 unknowns.
- banded: images stand in an order that keeps A near its diagonal (`_plan.py`). Panels of about 48 unknowns; a scan
  factors one panel, updates the window of the band below it, and moves on: 2 n b^2 flops for half-bandwidth b, nearly
  all of them in matrix products. n = 12000, b = 600 (2000 images) takes 0.11 s where dense takes several seconds.
- cg: conjugate gradients on the explicit blocks, preconditioned by A's block diagonal. For systems whose band does not
  fit in memory.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array, lax
from jaxtyping import Float, Int

from jaxba.ba._rows import rows_of
from jaxba.ba._schur import Reduced, ReducedVector
from jaxba.ba._system import System

_CG_TOLERANCE = 1e-8
CG_MAX_STEPS = 500
"""Iterations after which conjugate gradients give up."""


class Solved(NamedTuple):
    """A solution of the reduced system and the number of linear iterations it took (0 for a direct way)."""

    vector: ReducedVector
    iterations: Int[Array, ""]


class Factored(NamedTuple):
    """The reduced system factored for any number of right-hand sides.

    - `images`: factor of A. `through`: F = A^-1 B. `corner`: G = C - B^T F.
    """

    images: tuple[Array, ...]
    through: Float[Array, "images block border"]
    corner: Float[Array, "border border"]


def factor_reduced(system: System, reduced: Reduced) -> Factored:
    """Factor the reduced system; not finite where A is not positive definite."""
    images = factorise(system, reduced)
    if not reduced.corner.shape[0]:
        return Factored(images, reduced.border, reduced.corner)
    through, _ = factor_solve(system, reduced, images, reduced.border)
    corner = reduced.corner - jnp.einsum("mbg,mbh->gh", reduced.border, through)
    return Factored(images, through, (corner + corner.T) / 2)


def solve_factored(system: System, reduced: Reduced, factored: Factored, rhs: ReducedVector) -> ReducedVector:
    """Return S^-1 rhs."""
    images = factor_solve(system, reduced, factored.images, rhs.images[..., None])[0][..., 0]
    if not reduced.corner.shape[0]:
        return ReducedVector(images, rhs.border)
    border_rhs = rhs.border - jnp.einsum("mbg,mb->g", reduced.border, images)
    border = box_minimum(factored.corner, border_rhs, None, None)
    return ReducedVector(images - jnp.einsum("mbg,g->mb", factored.through, border), border)


def smallest_pivot(system: System, reduced: Reduced, factored: Factored) -> Float[Array, ""]:
    """Return the smallest pivot over what it was before anything was eliminated: the inverse of the largest inflation.

    Not positive, or NaN, where the system is not positive definite; of A's own blocks alone with conjugate gradients.
    """
    before = jnp.diagonal(reduced.diagonal, axis1=1, axis2=2).reshape(-1)
    ratios = [jnp.diagonal(factored.images[0], axis1=-2, axis2=-1).reshape(-1) ** 2 / before]
    if reduced.corner.shape[0]:
        scale = 1 / jnp.sqrt(jnp.diagonal(reduced.corner))
        root = jnp.linalg.cholesky(factored.corner * scale[:, None] * scale)
        ratios.append(jnp.diagonal(root) ** 2)
    return jnp.min(jnp.concatenate(ratios))


def solve_reduced(
    system: System,
    reduced: Reduced,
    rhs: ReducedVector,
    lower: Float[Array, " border"] | None = None,
    upper: Float[Array, " border"] | None = None,
) -> Solved:
    """Return the minimiser of `x^T S x / 2 - rhs^T x`, the border within `lower` and `upper` where these are given.

    Where A is not positive definite the result is not finite; the caller raises its damping.
    """
    num_border = reduced.corner.shape[0]
    columns = jnp.concatenate([reduced.border, rhs.images[..., None]], axis=-1)
    solved, iterations = factor_solve(system, reduced, factorise(system, reduced), columns)
    inner, images = solved[..., :num_border], solved[..., num_border]
    if num_border == 0:
        return Solved(ReducedVector(images, rhs.border), iterations)
    corner = reduced.corner - jnp.einsum("mbg,mbh->gh", reduced.border, inner)
    border_rhs = rhs.border - jnp.einsum("mbg,mb->g", reduced.border, images)
    border = box_minimum((corner + corner.T) / 2, border_rhs, lower, upper)
    return Solved(ReducedVector(images - jnp.einsum("mbg,g->mb", inner, border), border), iterations)


def factorise(system: System, reduced: Reduced) -> tuple[Array, ...]:
    """Return the factor of A: (L,) dense, (diagonal panels, panels below) banded, (L of each diagonal block,) cg."""
    if system.shape.linear_solver == "banded":
        return _factor_banded(_panels(system, reduced))
    matrix = reduced.diagonal if system.shape.linear_solver == "cg" else dense_images(system, reduced)
    return (_cholesky(matrix),)


def factor_solve(
    system: System, reduced: Reduced, factor: tuple[Array, ...], rhs: Float[Array, "images block columns"]
) -> tuple[Float[Array, "images block columns"], Int[Array, ""]]:
    """Return `A^-1 b` for several right-hand sides, and the number of linear iterations."""
    if system.shape.linear_solver == "cg":
        return _solve_cg(system, reduced, factor[0], rhs)
    flat = rhs.reshape(-1, rhs.shape[-1])
    solution = _solve_banded(factor, flat) if len(factor) == 2 else _solve_cholesky(factor[0], flat)
    return solution.reshape(rhs.shape), jnp.array(0)


@jax.custom_jvp
def _cholesky(matrix: Float[Array, "*m n n"]) -> Float[Array, "*m n n"]:
    """Return L of a matrix whose lower triangle alone is read."""
    return lax.linalg.cholesky(matrix, symmetrize_input=False)


@_cholesky.defjvp
def _cholesky_jvp(primals: tuple[Array], tangents: tuple[Array]) -> tuple[Array, Array]:
    # dL = L lower(L^-1 dA L^-T), half of its diagonal (Murray 2016); jax's own rule reads the upper triangle of dA
    root, lower = _cholesky(*primals), jnp.tril(tangents[0])
    change = lower + jnp.swapaxes(jnp.tril(lower, -1), -1, -2)
    half = lax.linalg.triangular_solve(root, change, left_side=True, lower=True)
    both = lax.linalg.triangular_solve(root, half, left_side=False, lower=True, transpose_a=True)
    return root, root @ (jnp.tril(both) - jnp.tril(both) * jnp.eye(both.shape[-1], dtype=both.dtype) / 2)


def _solve_cholesky(root: Float[Array, "*m n n"], rhs: Float[Array, "*m n columns"]) -> Float[Array, "*m n columns"]:
    half = lax.linalg.triangular_solve(root, rhs, left_side=True, lower=True)
    return lax.linalg.triangular_solve(root, half, left_side=True, lower=True, transpose_a=True)


def dense_images(system: System, reduced: Reduced) -> Float[Array, "n n"]:
    """Return A as a dense matrix, its lower triangle filled."""
    shape = system.shape
    images = jnp.arange(shape.num_images)
    blocks = jnp.zeros((shape.num_images, shape.num_images, shape.block, shape.block), reduced.diagonal.dtype)
    blocks = blocks.at[images, images].set(reduced.diagonal)
    blocks = blocks.at[system.block_row, system.block_column].add(reduced.off_diagonal)
    size = shape.num_images * shape.block
    return jnp.transpose(blocks, (0, 2, 1, 3)).reshape(size, size)


def box_minimum(
    matrix: Float[Array, "n n"],
    rhs: Float[Array, " n"],
    lower: Float[Array, " n"] | None,
    upper: Float[Array, " n"] | None,
) -> Float[Array, " n"]:
    """Return the x within the bounds that minimises `x^T M x / 2 - rhs^T x`, by block principal pivoting.

    Judice and Pires 1994: hold what lies beyond a bound, let go what its bound does not press against, solve for the
    rest, repeat until nothing is wrong; a handful of small solves. Where exchanging all at once does not get nearer
    for three solves, one at a time (Murty's rule) cannot cycle. Without bounds, one solve.
    """
    scale = 1 / jnp.sqrt(jnp.maximum(jnp.diagonal(matrix), jnp.finfo(matrix.dtype).tiny))

    def solve(held: Array, values: Array) -> Array:
        free = ~held
        scaled = matrix * scale[:, None] * scale[None] * (free[:, None] & free[None])
        scaled += jnp.diag(jnp.where(free, 0.0, 1.0))
        right = jnp.where(free, (rhs - matrix @ jnp.where(held, values, 0.0)) * scale, 0.0)
        root = _cholesky(scaled)
        x = jax.scipy.linalg.cho_solve((root, True), right) * scale
        return jnp.where(held, values, x)

    if lower is None or upper is None:
        return solve(jnp.zeros(rhs.shape, bool), rhs)

    size = rhs.shape[0]

    def step(state: tuple[Array, ...]) -> tuple[Array, ...]:
        low, high, fewest, patience, _, count = state
        x = solve(low | high, jnp.where(low, lower, upper))
        press = (rhs - matrix @ x) * scale**2  # positive where x wants to grow
        new_low = jnp.where(low, press <= 0, x < lower)
        new_high = jnp.where(high, press >= 0, x > upper)
        wrong = (new_low != low) | (new_high != high)
        number = jnp.sum(wrong)
        patience = jnp.where(number < fewest, 3, patience - 1)
        last = size - 1 - jnp.argmax(wrong[::-1])
        move = wrong & ((patience >= 0) | (jnp.arange(size) == last))  # one at a time cannot cycle
        low, high = jnp.where(move, new_low, low), jnp.where(move, new_high, high)
        return low, high, jnp.minimum(fewest, number), patience, number == 0, count + 1

    nothing = jnp.zeros(rhs.shape, bool)
    start = (nothing, nothing, jnp.array(size + 1), jnp.array(3), jnp.array(False), jnp.array(0))
    low, high, *_ = lax.while_loop(lambda s: ~s[4] & (s[5] < 50 * size + 50), step, start)
    return jnp.clip(solve(low | high, jnp.where(low, lower, upper)), lower, upper)


def _panels(system: System, reduced: Reduced) -> Float[Array, "panels panel band"]:
    """Return the band of A: a panel of rows holds the `band_panels` panels of columns before it and its own."""
    shape = system.shape
    group, width = shape.panel_images, shape.band_panels + 1
    num_panels = shape.num_images // group
    size = shape.block
    band = jnp.zeros((num_panels, group, size, width, group, size), reduced.diagonal.dtype)
    images = jnp.arange(shape.num_images)
    own = images // group, images % group
    band = band.at[*own, :, width - 1, images % group, :].set(reduced.diagonal)
    row, column = jnp.asarray(system.block_row), jnp.asarray(system.block_column)
    offset = column // group - row // group + width - 1
    band = band.at[row // group, row % group, :, offset, column % group, :].add(reduced.off_diagonal)
    return band.reshape(num_panels, group * size, width * group * size)


def _factor_banded(panels: Float[Array, "panels panel band"]) -> tuple[Array, Array]:
    """Right-looking band Cholesky; the carry is the window of the band below the panel in hand."""
    num_panels, size, band = panels.shape
    below = band - size
    width = band // size
    window = jnp.zeros((band, band), panels.dtype)
    for i in range(min(width, num_panels)):  # panel i of the first window: its last (i + 1) blocks of columns
        window = window.at[i * size : (i + 1) * size, : (i + 1) * size].set(panels[i][:, band - (i + 1) * size :])

    def factor(window: Array, panel: Array) -> tuple[Array, tuple[Array, Array]]:
        root = _cholesky(window[:size, :size])
        under = lax.linalg.triangular_solve(root, window[size:, :size], left_side=False, lower=True, transpose_a=True)
        moved = jnp.pad(window[size:, size:] - under @ under.T, ((0, size), (0, size)))
        # the panel of rows that enters the window as this one leaves it
        enters = jnp.where(panel + width < num_panels, panels[jnp.minimum(panel + width, num_panels - 1)], 0.0)
        return lax.dynamic_update_slice(moved, enters, (below, 0)), (root, under)

    return lax.scan(factor, window, jnp.arange(num_panels))[1]


def _solve_banded(factor: tuple[Array, ...], rhs: Float[Array, "n columns"]) -> Float[Array, "n columns"]:
    roots, panels = factor
    num_panels, below, size = panels.shape
    columns = rhs.shape[1]

    def forward(carry: Array, x: tuple[Array, Array, Array]) -> tuple[Array, Array]:
        root, panel, b = x
        y = lax.linalg.triangular_solve(root, b + carry[:size], left_side=True, lower=True)
        moved = jnp.concatenate([carry[size:], jnp.zeros((size, columns), b.dtype)])
        return moved - panel @ y, y

    def backward(carry: Array, x: tuple[Array, Array, Array]) -> tuple[Array, Array]:
        root, panel, y = x
        b = y - panel.T @ carry
        z = lax.linalg.triangular_solve(root, b, left_side=True, lower=True, transpose_a=True)
        return jnp.concatenate([z, carry[:-size]]), z

    start = jnp.zeros((below, columns), rhs.dtype)
    _, half = lax.scan(forward, start, (roots, panels, rhs.reshape(num_panels, size, columns)))
    _, solution = lax.scan(backward, start, (roots, panels, half), reverse=True)
    return solution.reshape(rhs.shape)


def multiply_images(
    system: System, reduced: Reduced, x: Float[Array, "images block columns"]
) -> Float[Array, "images block columns"]:
    """Return A x for several columns."""
    row, column = system.block_row, system.block_column
    down = jnp.einsum("bij,bjk->bik", reduced.off_diagonal, rows_of(x, column))
    up = jnp.einsum("bij,bik->bjk", reduced.off_diagonal, rows_of(x, row))
    return jnp.einsum("mij,mjk->mik", reduced.diagonal, x).at[row].add(down).at[column].add(up)


def _solve_cg(
    system: System,
    reduced: Reduced,
    roots: Float[Array, "images block block"],
    rhs: Float[Array, "images block columns"],
) -> tuple[Float[Array, "images block columns"], Int[Array, ""]]:
    """Conjugate gradients on every column at once, preconditioned by A's block diagonal."""

    def dot(a: Array, b: Array) -> Float[Array, " columns"]:
        return jnp.sum(a * b, axis=(0, 1))

    def quotient(a: Array, b: Array) -> Array:
        return jnp.where(b > 0, a / jnp.where(b > 0, b, 1.0), 0.0)  # a column that has converged stands still

    def step(state: tuple[Array, ...]) -> tuple[Array, ...]:
        x, r, p, rz, count = state
        ap = multiply_images(system, reduced, p)
        length = quotient(rz, dot(p, ap))
        x, r = x + length * p, r - length * ap
        z = _solve_cholesky(roots, r)
        new = dot(r, z)
        return x, r, z + quotient(new, rz) * p, new, count + 1

    first = _solve_cholesky(roots, rhs)
    start = dot(rhs, first)
    state = (jnp.zeros_like(rhs), rhs, first, start, jnp.array(0))

    def going(state: tuple[Array, ...]) -> Array:
        return jnp.any(state[3] > start * _CG_TOLERANCE**2) & (state[4] < CG_MAX_STEPS)

    x, _, _, _, count = lax.while_loop(going, step, state)
    return x, count
