"""Rotations SO(3): exponential, logarithm, quaternions and matrices.

Quaternions are unit, scalar first (w, x, y, z). All functions broadcast over leading axes, and every value and
derivative is finite at the identity and at half a turn: each branch of a `where` is fed an argument that is safe in it.
"""

import jax.numpy as jnp
from jax import Array
from jaxtyping import Float

_SMALL = 1e-8  # squared angle under which series replace quotients: relative error then below 1e-16


def hat(vector: Float[Array, "*batch 3"]) -> Float[Array, "*batch 3 3"]:
    """Return the skew matrix `[v]_x`, so that `hat(a) @ b == cross(a, b)`."""
    x, y, z = vector[..., 0], vector[..., 1], vector[..., 2]
    zero = jnp.zeros_like(x)
    rows = [zero, -z, y, z, zero, -x, -y, x, zero]
    return jnp.stack(rows, axis=-1).reshape(*vector.shape[:-1], 3, 3)


def quaternion_exp(rotation_vector: Float[Array, "*batch 3"]) -> Float[Array, "*batch 4"]:
    """Return the unit quaternion of a rotation vector (axis times angle, radians)."""
    squared = jnp.sum(rotation_vector**2, axis=-1, keepdims=True)
    small = squared < _SMALL
    angle = jnp.sqrt(jnp.where(small, 1.0, squared))
    sinc = jnp.where(small, 0.5 - squared / 48, jnp.sin(angle / 2) / angle)
    cosine = jnp.where(small, 1 - squared / 8 + squared**2 / 384, jnp.cos(angle / 2))
    return jnp.concatenate([cosine, sinc * rotation_vector], axis=-1)


def quaternion_log(quaternion: Float[Array, "*batch 4"]) -> Float[Array, "*batch 3"]:
    """Return the rotation vector of a unit quaternion, its angle in [0, pi]. `q` and `-q` give the same vector."""
    quaternion = jnp.where(quaternion[..., :1] < 0, -quaternion, quaternion)
    w, vector = quaternion[..., :1], quaternion[..., 1:]
    squared = jnp.sum(vector**2, axis=-1, keepdims=True)
    small = squared < _SMALL
    norm = jnp.sqrt(jnp.where(small, 1.0, squared))
    w_safe = jnp.where(small, w, 1.0)  # w is near 1 where the series is used
    ratio = squared / w_safe**2
    series = 2 / w_safe * (1 - ratio / 3 + ratio**2 / 5)
    return jnp.where(small, series, 2 * jnp.arctan2(norm, w) / norm) * vector


def quaternion_multiply(left: Float[Array, "*batch 4"], right: Float[Array, "*batch 4"]) -> Float[Array, "*batch 4"]:
    """Return the Hamilton product, the rotation `right` followed by `left`."""
    a, b, c, d = (left[..., i] for i in range(4))
    e, f, g, h = (right[..., i] for i in range(4))
    product = [
        a * e - b * f - c * g - d * h,
        a * f + b * e + c * h - d * g,
        a * g - b * h + c * e + d * f,
        a * h + b * g - c * f + d * e,
    ]
    return jnp.stack(product, axis=-1)


def quaternion_conjugate(quaternion: Float[Array, "*batch 4"]) -> Float[Array, "*batch 4"]:
    """Return the inverse of a unit quaternion."""
    return quaternion * jnp.array([1.0, -1.0, -1.0, -1.0], quaternion.dtype)


def matrix_from_quaternion(quaternion: Float[Array, "*batch 4"]) -> Float[Array, "*batch 3 3"]:
    """Return the rotation matrix of a quaternion; it is normalised first."""
    q = quaternion / jnp.linalg.norm(quaternion, axis=-1, keepdims=True)
    w, x, y, z = (q[..., i] for i in range(4))
    entries = [
        1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
        2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
        2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
    ]  # fmt: skip
    return jnp.stack(entries, axis=-1).reshape(*q.shape[:-1], 3, 3)


def quaternion_from_matrix(matrix: Float[Array, "*batch 3 3"]) -> Float[Array, "*batch 4"]:
    """Return the unit quaternion (w >= 0) of a rotation matrix, by its largest component (Shepperd 1978)."""
    m = matrix
    xx, yy, zz = m[..., 0, 0], m[..., 1, 1], m[..., 2, 2]
    a, b, c = m[..., 2, 1], m[..., 0, 2], m[..., 1, 0]
    d, e, f = m[..., 1, 2], m[..., 2, 0], m[..., 0, 1]
    # row i is 4 q_i (w, x, y, z): the outer product of the quaternion with itself
    outer = jnp.stack(
        [
            jnp.stack([1 + xx + yy + zz, a - d, b - e, c - f], -1),
            jnp.stack([a - d, 1 + xx - yy - zz, c + f, b + e], -1),
            jnp.stack([b - e, c + f, 1 - xx + yy - zz, a + d], -1),
            jnp.stack([c - f, b + e, a + d, 1 - xx - yy + zz], -1),
        ],
        axis=-2,
    )
    largest = jnp.argmax(jnp.diagonal(outer, axis1=-2, axis2=-1), axis=-1)
    row = jnp.take_along_axis(outer, largest[..., None, None], axis=-2)[..., 0, :]
    q = row / jnp.linalg.norm(row, axis=-1, keepdims=True)
    return jnp.where(q[..., :1] < 0, -q, q)


def so3_exp(rotation_vector: Float[Array, "*batch 3"]) -> Float[Array, "*batch 3 3"]:
    """Return the rotation matrix of a rotation vector (radians)."""
    return matrix_from_quaternion(quaternion_exp(rotation_vector))


def so3_log(matrix: Float[Array, "*batch 3 3"]) -> Float[Array, "*batch 3"]:
    """Return the rotation vector of a rotation matrix, its angle in [0, pi]."""
    return quaternion_log(quaternion_from_matrix(matrix))


def so3_left_jacobian_inverse(rotation_vector: Float[Array, "*batch 3"]) -> Float[Array, "*batch 3 3"]:
    """Return `J` with `log(exp(d) exp(v)) = v + J d` to first order (Sola et al. 2018, eq. 146)."""
    squared = jnp.sum(rotation_vector**2, axis=-1)[..., None, None]
    small = squared < 1e-4
    safe = jnp.where(small, 1.0, squared)
    angle = jnp.sqrt(safe)
    half = angle / 2
    factor = jnp.where(small, 1 / 12 + squared / 720 + squared**2 / 30240, (1 - half / jnp.tan(half)) / safe)
    skew = hat(rotation_vector)
    return jnp.eye(3, dtype=rotation_vector.dtype) - skew / 2 + factor * (skew @ skew)
