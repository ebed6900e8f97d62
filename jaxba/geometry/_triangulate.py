"""Triangulation: a point in the world from the rays on which two or more cameras see it.

Two views: the midpoint of the closest points of both rays, weighted by inverse depth (Lee and Civera 2019,
"Triangulation: why optimize?"), a closed form whose 3D error is close to that of the reprojection's optimum. Several
views: the point with the smallest sum of squared distances to the rays, a 3x3 system,

    sum w_i^2 (I - d_i d_i^T) (x - c_i) = 0

with c_i the centres and d_i the unit rays in the world. `refine_point` takes a point to the minimum of its reprojection
error.

These are for use from Python, by themselves: rays of any source and of any camera, a few views or many tracks, under
`jit`, `vmap` and derivatives. Every observation counts; what is wrong among them is for the caller to leave out.

Every function works on padded tracks at once, `(..., views, ...)` with weight 0 for padding: a hundred operations a
view in plain elementwise code, and the angles of all pairs of rays, fused into one loop.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Bool, Float

from jaxba._errors import JaxbaError
from jaxba.geometry._cameras import AbstractCamera
from jaxba.geometry._pose import Pose


class Triangulation(eqx.Module):
    """Points, and what tells good from bad geometry.

    - `point`: metres, world. Where the geometry is degenerate the mean of the cameras' centres: finite, and no answer.
    - `angle_rad`: largest angle between two of the rays; about 0.02 (1 degree) is the least that fixes a depth well.
    - `distance_m`: smallest distance from a camera to the point along its ray; negative where it is behind that camera.
    - `is_degenerate`: fewer than two rays, rays parallel to within rounding, or one centre for all rays.
    """

    point: Float[Array, "*batch 3"]
    angle_rad: Float[Array, "*batch"]
    distance_m: Float[Array, "*batch"]
    is_degenerate: Bool[Array, "*batch"]

    @property
    def is_valid(self) -> Bool[Array, "*batch"]:
        """True where the rays meet in one point in front of every camera."""
        return ~self.is_degenerate & (self.distance_m > 0)


def triangulate_two_view(poses: Pose, rays: Float[Array | np.ndarray, "*batch views 3"]) -> Triangulation:
    """Return the inverse-depth weighted midpoint of two rays (Lee and Civera 2019, eq. 7 and 10).

    `poses`: `cam_from_world`, batch `(..., 2)`. `rays`: unit directions in each camera's frame, as `Camera.unproject`
    returns them.

    >>> import jax.numpy as jnp
    >>> from jaxba.geometry import Pose, triangulate_two_view
    >>> poses = Pose(jnp.array([[1.0, 0, 0, 0], [1.0, 0, 0, 0]]), jnp.array([[0.0, 0, 0], [-3.0, 0, 0]]))
    >>> rays = jnp.array([[0.0, 0, 1], [-0.6, 0, 0.8]])
    >>> found = triangulate_two_view(poses, rays)
    >>> found.point.round(3).tolist(), bool(found.is_valid)
    ([0.0, 0.0, 4.0], True)
    """
    _check(rays)
    if rays.shape[-2] != 2:
        raise JaxbaError(f"triangulate_two_view: rays have {rays.shape[-2]} views; use triangulate for more than two.")
    center, ray = _in_world(poses, rays)
    used = jnp.ones(ray.shape[:-1], bool)
    angle = _largest_angle(ray, used)
    p = jnp.cross(ray[..., 0, :], ray[..., 1, :])
    opposite = _safe_norm(p) < _LEAST_ANGLE * jnp.finfo(ray.dtype).eps ** 0.5
    degenerate = _is_degenerate(center, used, angle) | opposite
    baseline = center[..., 0, :] - center[..., 1, :]
    q, r = jnp.cross(ray[..., 0, :], baseline), jnp.cross(ray[..., 1, :], baseline)
    p_norm, q_norm, r_norm = (_safe_norm(v) for v in (p, q, r))
    p_safe = jnp.where(degenerate, 1.0, p_norm)
    depth_0 = jnp.where(jnp.sum(p * r, -1) < 0, -r_norm, r_norm) / p_safe
    depth_1 = jnp.where(jnp.sum(p * q, -1) < 0, -q_norm, q_norm) / p_safe
    share = q_norm / jnp.where(degenerate, 1.0, q_norm + r_norm)
    on_ray = center + jnp.stack([depth_0, depth_1], axis=-1)[..., None] * ray
    point = share[..., None] * on_ray[..., 0, :] + (1 - share)[..., None] * on_ray[..., 1, :]
    point = jnp.where(degenerate[..., None], jnp.mean(center, axis=-2), point)
    distance = jnp.where(degenerate, 0.0, jnp.minimum(depth_0, depth_1))
    return Triangulation(point, angle, distance, degenerate)


def triangulate(
    poses: Pose,
    rays: Float[Array | np.ndarray, "*batch views 3"],
    *,
    weight: Float[Array | np.ndarray, "*batch views"] | None = None,
) -> Triangulation:
    """Return the point with the smallest sum of squared, weighted distances to its rays.

    `poses`: `cam_from_world`, batch `(..., views)`. `rays`: unit directions in each camera's frame, as
    `Camera.unproject` returns them. `weight`: 1/sigma of each view up to a factor, 0 for padding (whose poses and rays
    must be finite); equal by default.

    >>> import jax.numpy as jnp
    >>> from jaxba.geometry import Pinhole, Pose, triangulate
    >>> camera = Pinhole(1000.0, 1000.0, 500.0, 400.0)
    >>> poses = Pose(jnp.tile(jnp.array([1.0, 0, 0, 0]), (3, 1)), jnp.array([[0.0, 0, 0], [-1, 0, 0], [0, -1, 0]]))
    >>> rays = camera.unproject(camera.project(poses.transform(jnp.array([0.5, 0.5, 10.0]))))
    >>> triangulate(poses, rays).point.round(3).tolist()
    [0.5, 0.5, 10.0]
    """
    _check(rays)
    center, ray = _in_world(poses, rays)
    weight = jnp.ones(ray.shape[:-1], ray.dtype) if weight is None else jnp.asarray(weight)
    used = weight > 0
    angle = _largest_angle(ray, used)
    squared = jnp.where(used, weight * weight, 0.0)
    total = jnp.sum(squared, axis=-1, keepdims=True)
    share = squared / jnp.where(total > 0, total, 1.0)
    mean = jnp.sum(share[..., None] * center, axis=-2)
    offset = center - mean[..., None, :]  # keeps the digits of a block far from the origin
    across = jnp.eye(3, dtype=ray.dtype) - ray[..., :, None] * ray[..., None, :]
    matrix = jnp.sum(share[..., None, None] * across, axis=-3)
    degenerate = _is_degenerate(center, used, angle) | _cofactors(matrix)[2]
    right = jnp.sum(share[..., None] * (offset - ray * jnp.sum(ray * offset, -1, keepdims=True)), axis=-2)
    matrix = jnp.where(degenerate[..., None, None], jnp.eye(3, dtype=ray.dtype), matrix)
    right = jnp.where(degenerate[..., None], 0.0, right)
    from_mean = _solve(matrix, right)
    distance = jnp.sum(ray * (from_mean[..., None, :] - offset), axis=-1)
    distance = jnp.min(jnp.where(used, distance, jnp.inf), axis=-1)
    return Triangulation(mean + from_mean, angle, jnp.where(degenerate, 0.0, distance), degenerate)


def refine_point(
    point: Float[Array | np.ndarray, "*batch 3"],
    poses: Pose,
    camera: AbstractCamera,
    xy_px: Float[Array | np.ndarray, "*batch views 2"],
    *,
    weight: Float[Array | np.ndarray, "*batch views"] | None = None,
    num_steps: int = 3,
) -> Float[Array, "*batch 3"]:
    """Return the point after Gauss-Newton steps on its reprojection error.

    `point`: metres, world, a start value such as `triangulate` gives. `camera`: fields scalar or with batch
    `(..., views)`. `weight`: 1/sigma of each view, 0 for padding. A step that raises the error is not taken, and a
    degenerate point stays where it is. `num_steps`: static; the derivative is that of these steps, the minimum's once
    they have converged.

    >>> import jax.numpy as jnp
    >>> from jaxba.geometry import Pinhole, Pose, refine_point
    >>> camera = Pinhole(1000.0, 1000.0, 500.0, 400.0)
    >>> poses = Pose(jnp.tile(jnp.array([1.0, 0, 0, 0]), (2, 1)), jnp.array([[0.0, 0, 0], [-1, 0, 0]]))
    >>> xy_px = camera.project(poses.transform(jnp.array([0.5, 0.5, 10.0])))
    >>> refine_point(jnp.array([0.4, 0.4, 9.0]), poses, camera, xy_px).round(3).tolist()
    [0.5, 0.5, 10.0]
    """
    xy_px = jnp.asarray(xy_px)
    weight = jnp.ones(xy_px.shape[:-1], xy_px.dtype) if weight is None else jnp.asarray(weight)
    used = weight > 0
    rotation, translation = poses.rotation, jnp.asarray(poses.translation)

    def residual(point: Array) -> Array:
        x, y, z = jnp.moveaxis(jnp.einsum("...ij,...j->...i", rotation, point[..., None, :]) + translation, -1, 0)
        u, v = camera.project_components(x, y, jnp.where(used, z, 1.0))
        error = jnp.stack([u, v], axis=-1) - xy_px
        return jnp.where(used[..., None], error * weight[..., None], 0.0)

    point = jnp.asarray(point)
    axes = [jnp.zeros_like(point).at[..., i].set(1) for i in range(3)]
    # what rounding of the pixels alone adds to a cost; a converged point goes on to be stepped, for its derivative
    rounding = jnp.sum(jnp.where(used, jnp.square(weight), 0.0) * jnp.sum(jnp.square(xy_px), -1), axis=-1)
    rounding = rounding * (4 * jnp.finfo(xy_px.dtype).eps) ** 2

    def step(_: Array | int, state: tuple[Array, Array]) -> tuple[Array, Array]:
        point, error = state
        columns = [jax.jvp(residual, (point,), (axis,))[1] for axis in axes]
        matrix = jnp.stack([jnp.stack([jnp.sum(a * b, axis=(-2, -1)) for b in columns], -1) for a in columns], -2)
        gradient = jnp.stack([jnp.sum(a * error, axis=(-2, -1)) for a in columns], -1)
        trial = point - _solve(matrix, gradient)
        trial_error = residual(trial)
        cost, trial_cost = (jnp.sum(e * e, axis=(-2, -1)) for e in (error, trial_error))
        accepted = trial_cost <= cost * (1 + 1e-6) + rounding
        point = jnp.where(accepted[..., None], trial, point)
        return point, jnp.where(accepted[..., None, None], trial_error, error)

    return jax.lax.fori_loop(0, num_steps, step, (point, residual(point)))[0]


_LEAST_ANGLE = 64  # in units of sqrt(eps), 1e-6 rad in float64: rounding then costs a depth its fourth digit


def _check(rays: Array | np.ndarray) -> None:
    if rays.ndim < 2 or rays.shape[-2] < 2 or rays.shape[-1] != 3:
        raise JaxbaError(f"rays have shape {rays.shape}; give (..., views, 3) with two views or more.")


def _in_world(poses: Pose, rays: Array | np.ndarray) -> tuple[Float[Array, "*batch views 3"], ...]:
    """Return the centres, and the rays turned into the world, with one shape."""
    ray = jnp.einsum("...ji,...j->...i", poses.rotation, jnp.asarray(rays))
    return jnp.broadcast_to(poses.center, ray.shape), ray


def _largest_angle(ray: Float[Array, "*batch views 3"], used: Bool[Array, "*batch views"]) -> Float[Array, "*batch"]:
    """Return the largest angle between two used rays, from the chord, which unlike the cosine resolves small angles."""
    chord2 = sum((ray[..., :, None, i] - ray[..., None, :, i]) ** 2 for i in range(3))
    chord2 = jnp.max(jnp.where(used[..., :, None] & used[..., None, :], chord2, 0.0), axis=(-2, -1))
    apart = chord2 > 0
    half = jnp.sqrt(jnp.where(apart, chord2, 1.0)) / 2
    half = jnp.minimum(half, 1 - jnp.finfo(ray.dtype).eps)  # opposite rays: a finite derivative
    return jnp.where(apart, 2 * jnp.arcsin(half), 0.0)


def _is_degenerate(center: Array, used: Array, angle: Array) -> Bool[Array, "*batch"]:
    eps = jnp.finfo(center.dtype).eps
    high = jnp.max(jnp.where(used[..., None], center, -jnp.inf), axis=-2)
    low = jnp.min(jnp.where(used[..., None], center, jnp.inf), axis=-2)
    extent = jnp.max(high - low, axis=-1)
    one_center = extent <= 16 * eps * jnp.max(jnp.maximum(jnp.abs(high), jnp.abs(low)), axis=-1)
    return (jnp.sum(used, axis=-1) < 2) | (angle < _LEAST_ANGLE * eps**0.5) | one_center


def _cofactors(matrix: Float[Array, "*batch 3 3"]) -> tuple[Float[Array, "*batch 3 3"], Float[Array, "*batch"], Array]:
    """Return the adjugate and determinant of a symmetric matrix, and whether it is singular to within rounding."""
    rows = [matrix[..., i, :] for i in range(3)]
    adjugate = jnp.stack([jnp.cross(rows[(i + 1) % 3], rows[(i + 2) % 3]) for i in range(3)], axis=-2)
    determinant = jnp.sum(rows[0] * adjugate[..., 0, :], axis=-1)
    mean = jnp.trace(matrix, axis1=-2, axis2=-1) / 3
    return adjugate, determinant, determinant <= 8 * jnp.finfo(matrix.dtype).eps * mean**3


def _solve(matrix: Float[Array, "*batch 3 3"], right: Float[Array, "*batch 3"]) -> Float[Array, "*batch 3"]:
    """Solve by cofactors, elementwise; zero where the matrix is singular."""
    adjugate, determinant, singular = _cofactors(matrix)
    solution = jnp.einsum("...ij,...j->...i", adjugate, right) / jnp.where(singular, 1.0, determinant)[..., None]
    return jnp.where(singular[..., None], 0.0, solution)


def _safe_norm(vector: Float[Array, "*batch 3"]) -> Float[Array, "*batch"]:
    """Return the norm, its derivative zero at zero."""
    squared = jnp.sum(vector * vector, axis=-1)
    positive = squared > 0
    return jnp.where(positive, jnp.sqrt(jnp.where(positive, squared, 1.0)), 0.0)
