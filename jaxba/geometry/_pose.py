"""Rigid transforms SE(3), `target_from_source`: the pose of an image is `cam_from_world`, `x_cam = R x_world + t`.

A tangent step is six numbers (w, v), rotation first, applied on the left in the camera's own frame:
`R' = exp(w) R`, `t' = exp(w) t + v`. The camera's centre then moves by `-R^T exp(-w) v` alone and turns by w alone, so
a block far from the world's origin is conditioned as well as one around it, and no attitude is singular.
"""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.typing import DTypeLike
from jaxtyping import Float

from jaxba.geometry._rotation import (
    hat,
    matrix_from_quaternion,
    quaternion_conjugate,
    quaternion_exp,
    quaternion_from_matrix,
    quaternion_log,
    quaternion_multiply,
    so3_left_jacobian_inverse,
)


class Pose(eqx.Module):
    """Rigid transform `cam_from_world`, batched over leading axes.

    - `quaternion`: unit, scalar first.
    - `translation`: metres, in the target's (camera's) frame.
    """

    quaternion: Float[Array | np.ndarray, "*batch 4"]
    translation: Float[Array | np.ndarray, "*batch 3"]

    @staticmethod
    def identity(*batch: int, dtype: DTypeLike | None = None) -> "Pose":
        """Return the transform that leaves points where they are."""
        quaternion = jnp.zeros((*batch, 4), dtype).at[..., 0].set(1)
        return Pose(quaternion, jnp.zeros((*batch, 3), dtype))

    @staticmethod
    def from_matrix(rotation: Float[Array, "*batch 3 3"], translation: Float[Array, "*batch 3"]) -> "Pose":
        """Return the pose with this rotation matrix."""
        return Pose(quaternion_from_matrix(rotation), translation)

    @staticmethod
    def from_center(rotation: Float[Array, "*batch 3 3"], center: Float[Array, "*batch 3"]) -> "Pose":
        """Return the pose whose camera has this rotation `cam_from_world` and stands at `center` in the world."""
        return Pose(quaternion_from_matrix(rotation), -jnp.einsum("...ij,...j->...i", rotation, center))

    @property
    def rotation(self) -> Float[Array, "*batch 3 3"]:
        """Rotation matrix."""
        return matrix_from_quaternion(jnp.asarray(self.quaternion))

    @property
    def center(self) -> Float[Array, "*batch 3"]:
        """Position of the camera in the world, `-R^T t`."""
        return -jnp.einsum("...ji,...j->...i", self.rotation, jnp.asarray(self.translation))

    def transform(self, point: Float[Array, "*#batch 3"]) -> Float[Array, "*#batch 3"]:
        """Return `R x + t`."""
        return jnp.einsum("...ij,...j->...i", self.rotation, point) + self.translation

    def inverse(self) -> "Pose":
        """Return `source_from_target`."""
        return Pose(quaternion_conjugate(jnp.asarray(self.quaternion)), self.center)

    def compose(self, other: "Pose") -> "Pose":
        """Return the transform `other` followed by this one."""
        quaternion = quaternion_multiply(jnp.asarray(self.quaternion), jnp.asarray(other.quaternion))
        return Pose(quaternion, self.transform(jnp.asarray(other.translation)))

    def retract(self, step: Float[Array, "*batch 6"]) -> "Pose":
        """Return the pose after a tangent step (w, v): `R' = exp(w) R`, `t' = exp(w) t + v`."""
        turn = quaternion_exp(step[..., :3])
        quaternion = quaternion_multiply(turn, jnp.asarray(self.quaternion))
        quaternion = quaternion / jnp.linalg.norm(quaternion, axis=-1, keepdims=True)
        turned = jnp.einsum("...ij,...j->...i", matrix_from_quaternion(turn), jnp.asarray(self.translation))
        return Pose(quaternion, turned + step[..., 3:])


def se3_exp(twist: Float[Array, "*batch 6"]) -> Pose:
    """Return the pose of a twist (rotation vector first), the exponential of SE(3) (Sola et al. 2018, eq. 172)."""
    w, v = twist[..., :3], twist[..., 3:]
    return Pose(quaternion_exp(w), jnp.einsum("...ij,...j->...i", _left_jacobian(w), v))


def se3_log(pose: Pose) -> Float[Array, "*batch 6"]:
    """Return the twist of a pose, the inverse of `se3_exp` for angles up to half a turn."""
    w = quaternion_log(jnp.asarray(pose.quaternion))
    v = jnp.einsum("...ij,...j->...i", so3_left_jacobian_inverse(w), jnp.asarray(pose.translation))
    return jnp.concatenate([w, v], axis=-1)


def _left_jacobian(w: Float[Array, "*batch 3"]) -> Float[Array, "*batch 3 3"]:
    squared = jnp.sum(w**2, axis=-1)[..., None, None]
    small = squared < 1e-4
    safe = jnp.where(small, 1.0, squared)
    angle = jnp.sqrt(safe)
    # (1 - cos) by the half angle, which does not cancel
    first = jnp.where(small, 0.5 - squared / 24 + squared**2 / 720, 2 * jnp.sin(angle / 2) ** 2 / safe)
    second = jnp.where(small, 1 / 6 - squared / 120 + squared**2 / 5040, (angle - jnp.sin(angle)) / (safe * angle))
    skew = hat(w)
    return jnp.eye(3, dtype=w.dtype) + first * skew + second * (skew @ skew)


__all__ = ["Pose", "se3_exp", "se3_log"]
