"""Linearise: the normal equations J^T J and J^T r at some unknowns, robust losses and fixed unknowns taken care of.

They are kept in the blocks that bundle adjustment has, none of which depends on the damping of a step:

- for each image, the products of its rows' columns [pose | refined intrinsics | residual] among themselves;
- for each observation, W: its point's columns times its image's block (3 x block);
- for each point, its columns times [refined intrinsics | residual | point].

The derivatives themselves are never stored: they are computed a few thousand rows at a time, in the cache. For 147k
rows they would take 42 MB, and to touch that much fresh memory costs more time than the derivatives.
"""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float, Int

from jaxba.ba._plan import ROW_RUN
from jaxba.ba._priors import (
    PriorBlocks,
    add_products,
    block_products,
    block_transpose,
    robust_rows,
    transpose_product,
)
from jaxba.ba._products import run_products
from jaxba.ba._reweighting import reweighting
from jaxba.ba._rows import rows_of, segments, sum_components
from jaxba.ba._system import System
from jaxba.ba._unknowns import Step, Unknowns
from jaxba.ba.groups import Reprojection


class Linearisation(eqx.Module):
    """The normal equations, over the columns named above, and the priors' rows.

    - `image_products`: of the columns pose (6), refined intrinsics (k), residual (1).
    - `w`: W of each row.
    - `point_products`: the points' 3x3 blocks.
    - `point_shared`: each point's block with the shared intrinsics, all cameras side by side, none if they are own
      ones; then with the antenna where a prior couples these.
    - `prior_blocks`: of the priors; the points' blocks hold theirs already.
    - `gradient`, `diagonal`: J^T r and the diagonal of J^T J, of all groups.
    """

    image_products: Float[Array, "images columns1 columns"]
    w: Float[Array, "rows 3 block"]
    point_products: Float[Array, "points 3 3"]
    point_shared: Float[Array, "points 3 shared"]
    prior_blocks: PriorBlocks
    gradient: Step
    diagonal: Step


def cost(system: System, unknowns: Unknowns) -> Float[Array, ""]:
    """Return half the sum of losses; infinite where a point is not in front of a camera or anything is not finite."""
    return costs(system, unknowns)[0]


def costs(system: System, unknowns: Unknowns) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """Return the cost and the plain cost: that without robust losses."""
    residual, depth = system.reprojection.residual(unknowns)
    squared = residual[0] ** 2 + residual[1] ** 2
    total, plain = jnp.sum(system.loss(squared)), jnp.sum(squared)
    for prior in system.priors:
        squared = sum_components(prior.residual(unknowns) ** 2)
        total += jnp.sum(prior.loss(squared))
        plain += jnp.sum(squared)
    in_front = True if system.reprojection.model.sees_behind else jnp.all(depth > 0)

    def valid(total: Array) -> Array:
        return jnp.where(jnp.isfinite(total) & in_front, total / 2, jnp.inf)

    return valid(total), valid(plain)


def point_costs(system: System, unknowns: Unknowns) -> Float[Array, " points"]:
    """Return twice the cost that each point takes part in: its observations and, if surveyed, its coordinates."""
    residual, depth = system.reprojection.residual(unknowns)
    of_rows = system.loss(residual[0] ** 2 + residual[1] ** 2)
    valid = jnp.isfinite(of_rows)
    if not system.reprojection.model.sees_behind:
        valid &= depth > 0
    of_rows = jnp.where(valid, of_rows, jnp.inf).reshape(-1)
    total = segments(of_rows, system.reprojection.point_index, system.shape.num_points)
    for prior in system.priors:
        rows = prior.rows(unknowns)
        if rows.point is not None:
            of_prior = prior.loss(sum_components(rows.residual**2))
            total += segments(of_prior, rows.point.index, system.shape.num_points)
    return total


def cost_with(system: System, unknowns: Unknowns, of_points: Float[Array, " points"]) -> Float[Array, ""]:
    """Return the cost, as `cost` does, from that of each point (`point_costs`) and the priors that touch no point."""
    total = jnp.sum(of_points)
    for prior in system.priors:
        if prior.rows(unknowns).point is None:
            total += jnp.sum(prior.loss(sum_components(prior.residual(unknowns) ** 2)))
    return jnp.where(jnp.isfinite(total), total / 2, jnp.inf)


def point_equations(
    system: System, unknowns: Unknowns, bend: Float[Array, ""]
) -> tuple[Float[Array, "points 3"], Float[Array, "points 3 3"]]:
    """Return the gradient and the block of J^T J of every point, poses and cameras held."""

    def body(of_points: tuple[Array], part: Reprojection) -> tuple[tuple[Array], tuple[()]]:
        rows = part.rows(unknowns, lambda residual: reweighting(residual, system.loss, bend))
        columns = rows[:, :, -4:]
        by_pixel = jnp.moveaxis(columns, 2, 3).swapaxes(1, 2).reshape(-1, 2, 4)
        products = by_pixel[:, 0, 1:, None] * by_pixel[:, 0, None] + by_pixel[:, 1, 1:, None] * by_pixel[:, 1, None]
        index = part.point_index.reshape(-1)
        return (of_points[0].at[index].add(products, mode="promise_in_bounds"),), ()

    start = (jnp.zeros((system.shape.num_points, 3, 4), unknowns.points.dtype),)
    (of_points,), _ = scan_chunks(system, body, start)
    gradient, hessian = of_points[:, :, 0], of_points[:, :, 1:]
    for prior in system.priors:
        rows = robust_rows(system, prior, unknowns, bend)
        if rows.point is not None:
            gradient += block_transpose(rows.point, rows.residual, system.shape.num_points)
            hessian += block_products(rows.point, system.shape.num_points)
    return gradient, hessian


def linearise(system: System, unknowns: Unknowns, bend: Float[Array, ""] | float = 0.0) -> Linearisation:
    """Return the normal equations at `unknowns`.

    - `bend`: how much of a robust loss's curvature is used, 0 to 1; see `_robust.py`.
    """
    bend = jnp.asarray(bend, unknowns.points.dtype)
    first_point = 6 + system.shape.num_refined + 1

    def products(part: Reprojection) -> tuple[Array, Array]:
        rows = part.rows(unknowns, lambda residual: reweighting(residual, system.loss, bend))
        rows = masked_columns(rows, part, system)
        by_lane = jnp.swapaxes(rows, 2, 3)
        flat = by_lane.reshape(by_lane.shape[0], 2 * ROW_RUN, -1)[:, :, :first_point]
        of_images = run_products(flat, flat)
        pixel = jnp.moveaxis(by_lane, 1, 2).reshape(-1, 2, by_lane.shape[-1])
        of_points = (
            pixel[:, 0, first_point:, None] * pixel[:, 0, None] + pixel[:, 1, first_point:, None] * pixel[:, 1, None]
        )
        return of_images, of_points

    zero = jax.tree.map(jnp.zeros_like, system.free)
    blocks, gradient = PriorBlocks.zeros(zero), zero
    for prior in system.priors:
        rows = robust_rows(system, prior, unknowns, bend)
        blocks = add_products(blocks, rows)
        gradient = jax.tree.map(jnp.add, gradient, transpose_product(rows, rows.residual, zero))
    return assemble(system, products, blocks, gradient)


def assemble(
    system: System, products: Callable[[Reprojection], tuple[Array, Array]], blocks: PriorBlocks, gradient: Step
) -> Linearisation:
    """Return the equations from the products of pieces of the observations, and the priors' blocks and gradient.

    `products` returns those of each run among the columns of its image, and of each row the point's three times all
    columns: pose, refined intrinsics, residual, point.
    """
    shape, dtype = system.shape, blocks.points.dtype
    k, cameras = shape.num_refined, shape.num_shared_cameras

    def body(carry: tuple[Array, Array], part: Reprojection) -> tuple[tuple[Array, Array], tuple[Array, Array]]:
        of_points, of_shared = carry
        image_products, of_point = products(part)
        index = part.point_index.reshape(-1)
        of_points = of_points.at[index].add(of_point[:, :, 6 + k :], mode="promise_in_bounds")
        if cameras:
            camera = rows_of(part.camera_index, part.run_image)[:, None] if cameras > 1 else 0
            place = (part.point_index * cameras + camera).reshape(-1)
            of_shared = of_shared.at[place].add(of_point[:, :, 6 : 6 + k], mode="promise_in_bounds")
        return (of_points, of_shared), (image_products, of_point[:, :, : shape.block])

    start = (
        jnp.zeros((shape.num_points, 3, 4), dtype),
        jnp.zeros((shape.num_points * cameras, 3, k), dtype),
    )
    (of_points, of_shared), (run_products, w) = scan_chunks(system, body, start)
    image_products = sum_runs(system, run_products)
    of_shared = jnp.swapaxes(of_shared.reshape(shape.num_points, cameras, 3, k), 1, 2)
    of_border = of_shared.reshape(shape.num_points, 3, cameras * k)
    if shape.antenna:
        of_border = jnp.concatenate([of_border, blocks.points_antenna], axis=2)
    point_products = of_points[:, :, 1:] + blocks.points

    def diagonal_of(matrix: Array) -> Array:
        return jnp.diagonal(matrix, axis1=1, axis2=2)

    refined, squares = refined_columns(system), diagonal_of(image_products[:, : 6 + k, : 6 + k])
    of_cameras = sum_cameras(system, image_products[:, 6 : 6 + k, 6 + k])
    gradient = Step(
        poses=gradient.poses + image_products[:, :6, 6 + k],
        intrinsics=jnp.asarray(gradient.intrinsics).at[:, refined].add(of_cameras),
        antenna=gradient.antenna,
        points=gradient.points + of_points[:, :, 0],
    )
    diagonal = Step(
        poses=diagonal_of(blocks.poses) + squares[:, :6],
        intrinsics=diagonal_of(blocks.intrinsics).at[:, refined].add(sum_cameras(system, squares[:, 6:])),
        antenna=jnp.diagonal(blocks.antenna),
        points=diagonal_of(point_products),
    )
    return Linearisation(
        image_products,
        w,
        point_products,
        of_border,
        blocks,
        gradient,
        diagonal,
    )


def curvature(system: System, model: Linearisation, step: Step) -> Float[Array, ""]:
    """Return `d^T J^T J d` along a step, from the blocks."""
    refined = step.intrinsics[:, refined_columns(system)]
    of_images = jnp.concatenate([step.poses, rows_of(refined, system.reprojection.camera_index)], axis=1)
    columns = of_images.shape[1]
    total = jnp.einsum("ma,mab,mb->", of_images, model.image_products[:, :columns, :columns], of_images)
    total += jnp.einsum("pi,pij,pj->", step.points, model.point_products, step.points)
    of_points = segments(w_product(system, model.w, of_images), system.reprojection.point_index, step.points.shape[0])
    if model.point_shared.shape[-1]:
        shared = refined.reshape(-1)[: system.shape.border - system.shape.antenna]
        on_border = jnp.concatenate([shared, step.antenna])
        of_points += model.point_shared @ on_border[: model.point_shared.shape[-1]]
    total += 2 * jnp.vdot(step.points, of_points)
    blocks = model.prior_blocks  # the points' blocks hold the priors on points already
    total += jnp.einsum("ma,mab,mb->", step.poses, blocks.poses, step.poses)
    total += jnp.einsum("ca,cab,cb->", step.intrinsics, blocks.intrinsics, step.intrinsics)
    total += jnp.einsum("a,ab,b->", step.antenna, blocks.antenna, step.antenna)
    total += 2 * jnp.einsum("ma,mab,b->", step.poses, blocks.poses_antenna, step.antenna)
    return total


def w_product(
    system: System, w: Float[Array, "rows 3 block"], images: Float[Array, "images columns"]
) -> Float[Array, "rows 3"]:
    """Return W d of each row for a step of the images' blocks."""
    of_runs = rows_of(images[:, : w.shape[-1]], system.reprojection.run_image)
    return jnp.einsum("rka,ra->rk", w.reshape(-1, 3 * ROW_RUN, w.shape[-1]), of_runs).reshape(-1, 3)


def sum_runs(system: System, runs: Float[Array, "runs *rest"]) -> Float[Array, "images *rest"]:
    """Sum runs of rows by image."""
    return jax.ops.segment_sum(
        runs,
        system.reprojection.run_image,
        num_segments=system.shape.num_images,
        indices_are_sorted=True,
        mode="promise_in_bounds",
    )


def sum_cameras(system: System, images: Float[Array, "images *rest"]) -> Float[Array, "cameras *rest"]:
    """Sum images by camera."""
    return segments(images, system.reprojection.camera_index, system.shape.num_cameras)


def refined_columns(system: System) -> Int[Array, " refined"]:
    """Columns of the intrinsics that are free in any camera."""
    return jnp.array([i for i, refined in enumerate(system.shape.refined) if refined], jnp.int32)


def scan_chunks(
    system: System, body: Callable[..., tuple[Any, Any]], carry: Any, *of_rows: Float[Array, "rows *rest"]
) -> tuple[Any, Any]:
    """Fold `body` over chunks of runs, each with its part of `of_rows`; its outputs come back joined along their rows.

    - `body`: of the carry, the observations of a chunk, and its part of each of `of_rows`, by runs and lanes.
    """
    group, runs = system.reprojection, system.shape.chunk_runs

    def split(a: Array | np.ndarray) -> Array:
        return jnp.asarray(a).reshape(-1, runs, *a.shape[1:])

    xy_px = jnp.swapaxes(jnp.asarray(group.xy_px).reshape(2, -1, runs, ROW_RUN), 0, 1)
    fields = (xy_px, split(group.weight), split(group.point_index), split(group.run_image))
    beside = tuple(rows.reshape(-1, runs, ROW_RUN, *rows.shape[1:]) for rows in of_rows)

    def step(carry: Any, fields: tuple[tuple[Array, ...], tuple[Array, ...]]) -> tuple[Any, Any]:
        (xy_px, weight, point_index, run_image), beside = fields
        part = Reprojection(xy_px, weight, point_index, run_image, group.camera_index, group.model, group.refined)
        return body(carry, part, *beside)

    carry, out = jax.lax.scan(step, carry, (fields, beside))
    return carry, jax.tree.map(lambda a: a.reshape(-1, *a.shape[2:]), out)


def masked_columns(
    rows: Float[Array, "runs 2 columns lanes"], group: Reprojection, system: System
) -> Float[Array, "runs 2 columns lanes"]:
    """Zero the columns of what is fixed."""
    shape, free = system.shape, system.free
    k = shape.num_refined
    if shape.any_fixed_pose:
        rows = rows.at[:, :, :6].multiply(rows_of(free.poses, group.run_image)[:, None, :, None])
    if shape.num_cameras > 1 and k:
        mask = rows_of(free.intrinsics[:, refined_columns(system)], rows_of(group.camera_index, group.run_image))
        rows = rows.at[:, :, 6 : 6 + k].multiply(mask[:, None, :, None])
    if shape.any_fixed_point:
        rows = rows.at[:, :, 7 + k :].multiply(rows_of(free.points[:, 0], group.point_index)[:, None, None])
    return rows
