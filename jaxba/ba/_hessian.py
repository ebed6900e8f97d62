"""Hessian: the second derivatives of the cost at some unknowns, exact, in the same blocks as the normal equations.

The normal equations leave out the curvature of the residuals and most of that of a robust loss; what an optimum does
when its inputs change depends on both. Of one observation, with p = exp(w) (R (x + dx) + t) + v its point in the camera
and g, G, M, N the derivatives of its cost by p, p p, p K and K K (K the intrinsics, [a] the matrix of a cross product):

    v v   G             w v   [p] G         w w   [p] G [p]^T + (p g^T + g p^T) / 2 - (p . g) I
    v K   M             w K   [p] M         x w   R^T (G [p]^T + [g])
    x v   R^T G         x K   R^T M         x x   R^T G R            K K   N

At a strict minimum the matrix is positive definite, so the reduced system's factor solves it as it does a step.
"""

import jax
import jax.numpy as jnp
from jax import Array

from jaxba.ba._linearise import Linearisation, assemble
from jaxba.ba._priors import PriorBlocks, add_second_derivatives, robust_rows, transpose_product
from jaxba.ba._rows import rows_of
from jaxba.ba._system import System
from jaxba.ba._unknowns import Unknowns
from jaxba.ba.groups import Reprojection


def hessian(system: System, unknowns: Unknowns) -> Linearisation:
    """Return the second derivatives and the gradient at `unknowns`, rows and columns of what is fixed zero."""
    zero = jax.tree.map(jnp.zeros_like, system.free)
    blocks, gradient = PriorBlocks.zeros(zero), zero
    for prior in system.priors:
        blocks = add_second_derivatives(blocks, system, prior, unknowns)
        rows = robust_rows(system, prior, unknowns, jnp.zeros((), unknowns.points.dtype))
        gradient = jax.tree.map(jnp.add, gradient, transpose_product(rows, rows.residual, zero))
    return assemble(system, lambda part: _products(system, unknowns, part), blocks, gradient)


def _products(system: System, unknowns: Unknowns, part: Reprojection) -> tuple[Array, Array]:
    """Return the images' blocks of runs, (runs, 6 + k, 6 + k + 1), and the points' rows, (rows, 3, 6 + k + 1 + 3)."""
    k = system.shape.num_refined
    rotation, p, local = part.local_hessian(unknowns, system.loss)
    num_runs, lanes = p[0].shape
    of_p = local[:, :3]  # G, M and g
    by_point = jnp.einsum("rki,rkm->rim", rotation, of_p.reshape(num_runs, 3, -1)).reshape(of_p.shape)
    at, g = jnp.stack(p, axis=1), of_p[:, :, 3 + k]

    turned = _cross(at[:, :, None], of_p, 1)  # [p] G, [p] M and [p] g
    w_w = _cross(at[:, None], turned[:, :, :3], 2)
    outer = at[:, :, None] * g[:, None]
    along = jnp.eye(3, dtype=at.dtype)[:, :, None] * jnp.sum(at * g, axis=1)[:, None, None]
    w_w += (outer + jnp.swapaxes(outer, 1, 2)) / 2 - along
    w_w, moved, of_p_sum, of_k = (jnp.sum(a, axis=3) for a in (w_w, turned, of_p, local[:, 3:]))
    across = jnp.swapaxes(moved, 1, 2)
    rows = [
        jnp.concatenate([w_w, moved], axis=2),
        jnp.concatenate([across[:, :3], of_p_sum], axis=2),
        jnp.concatenate([across[:, 3 : 3 + k], of_k], axis=2),
    ]
    of_images = jnp.concatenate(rows, axis=1)

    axes = jnp.swapaxes(rotation, 1, 2)[:, :, :, None]  # the world's, in the camera
    w = _cross(at[:, None], by_point[:, :, :3], 2) + _cross(axes, g[:, None], 2)
    x = jnp.einsum("riml,rmj->rijl", by_point[:, :, :3], rotation)
    of_points = jnp.concatenate([w, by_point, x], axis=2)
    of_points = jnp.moveaxis(of_points, 3, 1).reshape(num_runs * lanes, 3, 6 + k + 4)
    return _masked(system, part, of_images, of_points)


def _masked(system: System, part: Reprojection, of_images: Array, of_points: Array) -> tuple[Array, Array]:
    """Zero rows and columns of what is fixed."""
    shape, free = system.shape, system.free
    size = 6 + shape.num_refined
    if shape.any_fixed_pose or shape.any_bound or (shape.num_cameras > 1 and shape.num_refined):
        pose = rows_of(free.poses, part.run_image)
        refined = [i for i, is_refined in enumerate(shape.refined) if is_refined]
        camera = rows_of(free.intrinsics[:, jnp.array(refined, jnp.int32)], rows_of(part.camera_index, part.run_image))
        mask = jnp.concatenate([pose, camera], axis=1)
        of_images = of_images * mask[:, :, None]
        of_images = of_images.at[:, :, :size].multiply(mask[:, None])
        lanes = part.point_index.shape[1]
        of_points = of_points.at[:, :, :size].multiply(jnp.repeat(mask, lanes, axis=0)[:, None])
    if shape.any_fixed_point:
        point = rows_of(free.points[:, 0], part.point_index).reshape(-1)
        of_points = of_points * point[:, None, None]
    return of_images, of_points


def _cross(a: Array, b: Array, axis: int) -> Array:
    return jnp.cross(a, b, axisa=axis, axisb=axis, axisc=axis)
