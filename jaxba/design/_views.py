"""What errors of photos do to a spot of ground that they show.

A spot X that photos see has, A and B the derivatives of its pixels by the spot and by poses and intrinsics c,

    dX = -N^-1 (sum w A^T B) dc + noise,   N = sum w A^T A,   Cov(noise) = s^2 N^-1

with s the sigma of a mark. The weight w of a photo falls smoothly to zero at its edge, so that all of it can be
differentiated by where the spot lies.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float, Int

from jaxba.design._photos import Photos
from jaxba.geometry import AbstractCamera, Pose

_EDGE = 0.04  # of the photo's shorter side, over which its weight rises from the edge
_SLACK = 1.02  # of the view: what lies farther out may be folded back by distortion
_UNSEEN = 1e-8  # of N, over its size where one pixel is a metre: a sigma of 10 km times that of a mark


class Views(eqx.Module):
    """Photos, as the fields of `Photos` and the edges of their frames."""

    poses: Pose
    intrinsics: Float[Array | np.ndarray, "cameras parameters"]
    camera_index: Int[Array | np.ndarray, " images"]
    frame_px: Float[Array | np.ndarray, "2 2"]
    view: Float[Array | np.ndarray, "2 2"]
    model: type[AbstractCamera] = eqx.field(static=True)

    def spots(
        self, xyz_m: Float[Array, "spots 3"]
    ) -> tuple[Float[Array, "spots 3 unknowns"], Float[Array, "spots 3 3"], Float[Array, " spots"]]:
        """Return, of each spot, dX by poses and intrinsics as `camera_covariance` orders them, N^-1, and the rays."""
        return jax.vmap(self._spot)(xyz_m)

    def _spot(self, xyz_m: Float[Array, "3"]) -> tuple[Array, Array, Array]:
        by_spot, by_camera, weight = jax.vmap(self._derivatives, (0, 0, None))(
            self.poses, jnp.asarray(self.camera_index), xyz_m
        )
        normal = jnp.einsum("n,nki,nkj->ij", weight, by_spot, by_spot) + _UNSEEN * jnp.eye(3)
        inverse = jnp.linalg.inv(normal)
        across = -inverse @ jnp.einsum("n,nki,nkc->nic", weight, by_spot, by_camera)
        of_cameras = jax.ops.segment_sum(across[:, :, 6:], jnp.asarray(self.camera_index), len(self.intrinsics))
        parts = [jnp.moveaxis(of, 0, 1).reshape(3, -1) for of in (across[:, :, :6], of_cameras)]
        return jnp.concatenate(parts, axis=1), inverse, jnp.sum(weight)

    def _derivatives(self, pose: Pose, camera: Array, xyz_m: Array) -> tuple[Array, Array, Array]:
        """Return the derivatives of a pixel by the spot and by pose and intrinsics, and its weight."""
        at = jnp.asarray(self.intrinsics)[camera]
        in_cam = jax.lax.stop_gradient(pose.transform(xyz_m))
        slope = in_cam[:2] / jnp.where(in_cam[2] > 0, in_cam[2], 1.0)
        ahead = (in_cam[2] > 0) & jnp.all((slope > _SLACK * self.view[0]) & (slope < _SLACK * self.view[1]))

        def pixel(x: Array, step: Array, change: Array) -> Array:
            point = pose.retract(step).transform(x)
            seen = jnp.where(ahead, point, jnp.array([0.0, 0.0, 1.0]))  # finite where it sees nothing
            return self.model.from_parameters(at + change).project(seen)

        by_spot, by_pose, by_intrinsics = jax.jacrev(pixel, (0, 1, 2))(xyz_m, jnp.zeros(6), jnp.zeros_like(at))
        xy_px = pixel(xyz_m, jnp.zeros(6), jnp.zeros_like(at))
        low, high = jnp.asarray(self.frame_px)
        inside = jnp.minimum(xy_px - low, high - xy_px) / (_EDGE * jnp.min(high - low))
        rise = jnp.clip(inside, 0.0, 1.0)
        weight = jnp.where(ahead, jnp.prod(rise**2 * (3.0 - 2.0 * rise)), 0.0)
        return by_spot, jnp.concatenate([by_pose, by_intrinsics], axis=1), weight


def views_of(photos: Photos) -> Views:
    """Return photos as what they show of the ground is computed from."""
    names = photos.cameras.parameter_names()
    columns = [np.atleast_1d(np.asarray(getattr(photos.cameras, name), float)) for name in names]
    return Views(
        poses=photos.poses,
        intrinsics=np.stack(columns, axis=1),
        camera_index=np.asarray(photos.camera_index, np.int32),
        frame_px=photos.frame_px,
        view=photos.view,
        model=type(photos.cameras),
    )
