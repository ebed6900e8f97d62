"""Aspect prior: pixels are square, or nearly so, `r = (fx / fy - ratio) / sigma`.

Two focal lengths are two unknowns that a block flown up and down in parallel lines tells apart from a block stretched
along them only by its GNSS positions. What is known of a sensor is that its pixels are square to a few parts in ten
thousand; resizing to whole pixels adds as much.
"""

from typing import ClassVar

import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float, Int

from jaxba.ba._problem import AbstractPrior
from jaxba.ba._rows import JacobianBlock, Rows, rows_of
from jaxba.ba._unknowns import Unknowns
from jaxba.geometry import AbstractLoss, Linear


class AspectPrior(AbstractPrior):
    """Ratio of the first two parameters, `fx` and `fy`, of some cameras; for models that have both."""

    name: ClassVar[str] = "aspect"
    in_world: ClassVar[tuple[str, ...] | None] = ()
    camera_index: Int[Array | np.ndarray, " rows"]
    ratio: Float[Array | np.ndarray, " rows"]
    std: Float[Array | np.ndarray, " rows"]
    loss: AbstractLoss = Linear()

    def residual(self, unknowns: Unknowns) -> Float[Array, "1 rows"]:
        fx, fy = self._focal(unknowns)
        return ((fx / fy - self.ratio) / jnp.asarray(self.std))[None]

    def rows(self, unknowns: Unknowns) -> Rows:
        fx, fy = self._focal(unknowns)
        parameters = unknowns.intrinsics.shape[1]
        jacobian = jnp.zeros((1, parameters, fx.shape[0]), fx.dtype)
        jacobian = jacobian.at[0, 0].set(1 / fy).at[0, 1].set(-fx / fy**2) / jnp.asarray(self.std)
        return Rows(residual=self.residual(unknowns), intrinsics=JacobianBlock(self.camera_index, jacobian))

    def _focal(self, unknowns: Unknowns) -> tuple[Array, Array]:
        values = rows_of(unknowns.intrinsics, self.camera_index)
        return values[:, 0], values[:, 1]
