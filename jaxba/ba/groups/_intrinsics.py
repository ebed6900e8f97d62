"""Intrinsics priors: calibrations with their sigmas, `r = (K - K0) / sigma` for each parameter of a camera."""

from typing import ClassVar

import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float, Int

from jaxba.ba._problem import AbstractPrior
from jaxba.ba._rows import JacobianBlock, Rows, rows_of
from jaxba.ba._unknowns import Unknowns
from jaxba.geometry import AbstractLoss, Linear


class IntrinsicsPrior(AbstractPrior):
    """Calibrated intrinsics of some cameras.

    - `parameters`: in the model's order. `std`: in the same units; infinite where a parameter is not known.
    """

    name: ClassVar[str] = "intrinsics"
    in_world: ClassVar[tuple[str, ...] | None] = ()
    camera_index: Int[Array | np.ndarray, " rows"]
    parameters: Float[Array | np.ndarray, "rows parameters"]
    std: Float[Array | np.ndarray, "rows parameters"]
    loss: AbstractLoss = Linear()

    def residual(self, unknowns: Unknowns) -> Float[Array, "parameters rows"]:
        return ((rows_of(unknowns.intrinsics, self.camera_index) - self.parameters) / jnp.asarray(self.std)).T

    def rows(self, unknowns: Unknowns) -> Rows:
        num_parameters = self.parameters.shape[1]
        identity = jnp.eye(num_parameters, dtype=unknowns.intrinsics.dtype)
        return Rows(
            residual=self.residual(unknowns),
            intrinsics=JacobianBlock(self.camera_index, identity[:, :, None] / jnp.asarray(self.std).T[None]),
        )
