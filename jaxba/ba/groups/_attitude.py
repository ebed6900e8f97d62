"""Attitude priors: measured rotations of images, from a gimbal or an inertial unit.

    r = log(R Q^T) / sigma

with Q the measured rotation `cam_from_world`: the rotation vector, in the camera's frame, from measured to adjusted. A
step w on the left changes it by `J_l^-1(r) w`.
"""

from typing import ClassVar

import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float, Int

from jaxba.ba._problem import AbstractPrior
from jaxba.ba._rows import JacobianBlock, Rows, rows_of
from jaxba.ba._unknowns import Unknowns
from jaxba.geometry import (
    AbstractLoss,
    Linear,
    quaternion_conjugate,
    quaternion_log,
    quaternion_multiply,
    so3_left_jacobian_inverse,
)


class AttitudePrior(AbstractPrior):
    """Measured rotations of some images.

    - `quaternion`: `cam_from_world`, scalar first. `std_rad`: sigma about each axis of the camera.
    """

    name: ClassVar[str] = "attitude"
    in_world: ClassVar[tuple[str, ...] | None] = ()
    image_index: Int[Array | np.ndarray, " rows"]
    quaternion: Float[Array | np.ndarray, "rows 4"]
    std_rad: Float[Array | np.ndarray, "rows 3"]
    loss: AbstractLoss = Linear()

    def residual(self, unknowns: Unknowns) -> Float[Array, "3 rows"]:
        return (self._turn(unknowns) / jnp.asarray(self.std_rad)).T

    def rows(self, unknowns: Unknowns) -> Rows:
        turn = self._turn(unknowns)
        jacobian = so3_left_jacobian_inverse(turn) / jnp.asarray(self.std_rad)[:, :, None]
        about = jnp.moveaxis(jacobian, 0, -1)
        return Rows(
            residual=(turn / jnp.asarray(self.std_rad)).T,
            pose=JacobianBlock(self.image_index, jnp.concatenate([about, jnp.zeros_like(about)], axis=1)),
        )

    def _turn(self, unknowns: Unknowns) -> Float[Array, "rows 3"]:
        adjusted = rows_of(unknowns.poses.quaternion, self.image_index)
        return quaternion_log(quaternion_multiply(adjusted, quaternion_conjugate(jnp.asarray(self.quaternion))))
