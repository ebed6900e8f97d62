"""Control points: points whose world coordinates were surveyed, `r = (x - g) / sigma`."""

from typing import ClassVar

import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float, Int

from jaxba.ba._problem import AbstractPrior
from jaxba.ba._rows import JacobianBlock, Rows, rows_of
from jaxba.ba._unknowns import Unknowns
from jaxba.geometry import AbstractLoss, Linear


class ControlPointPrior(AbstractPrior):
    """Surveyed coordinates of some points.

    - `xyz`: metres, world. `std_m`: sigma an axis; infinite where an axis is not known (horizontal control).
    """

    name: ClassVar[str] = "control"
    in_world: ClassVar[tuple[str, ...] | None] = ("xyz",)
    point_index: Int[Array | np.ndarray, " rows"]
    xyz: Float[Array | np.ndarray, "rows 3"]
    std_m: Float[Array | np.ndarray, "rows 3"]
    loss: AbstractLoss = Linear()

    def residual(self, unknowns: Unknowns) -> Float[Array, "3 rows"]:
        return ((rows_of(unknowns.points, self.point_index) - self.xyz) / jnp.asarray(self.std_m)).T

    def rows(self, unknowns: Unknowns) -> Rows:
        identity = jnp.eye(3, dtype=unknowns.points.dtype)
        return Rows(
            residual=self.residual(unknowns),
            point=JacobianBlock(self.point_index, identity[:, :, None] / jnp.asarray(self.std_m).T[None]),
        )
