"""Lever arm prior: the measured offset from the camera to the antenna, `r = (l - l0) / sigma`."""

from typing import ClassVar

import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float

from jaxba.ba._problem import AbstractPrior
from jaxba.ba._rows import Rows
from jaxba.ba._unknowns import Unknowns
from jaxba.geometry import AbstractLoss, Linear


class LeverArmPrior(AbstractPrior):
    """Measured lever arm: `xyz` metres in the camera's frame, `std_m` a sigma an axis; a row a measurement."""

    name: ClassVar[str] = "lever_arm"
    in_world: ClassVar[tuple[str, ...] | None] = ()
    xyz: Float[Array | np.ndarray, "rows 3"]
    std_m: Float[Array | np.ndarray, "rows 3"]
    loss: AbstractLoss = Linear()

    def residual(self, unknowns: Unknowns) -> Float[Array, "3 rows"]:
        return ((jnp.asarray(unknowns.lever_arm)[None] - self.xyz) / jnp.asarray(self.std_m)).T

    def rows(self, unknowns: Unknowns) -> Rows:
        by_antenna = jnp.eye(3, len(unknowns.antenna), dtype=unknowns.antenna.dtype)
        derivative = by_antenna[:, :, None] / jnp.asarray(self.std_m).T[:, None]
        return Rows(residual=self.residual(unknowns), antenna=derivative)
