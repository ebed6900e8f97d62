"""Position offset prior: what is known of the offset that all measured positions share, `r = (d - d0) / sigma`.

The base of an RTK survey may stand beside its mark, and the errors of a single receiver are those of its satellites:
what all positions of a flight have in common is no error of each. It is an unknown of its own, `position_offset` of a
problem, and this prior says how large it may be.
"""

from typing import ClassVar

import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float

from jaxba.ba._problem import AbstractPrior
from jaxba.ba._rows import Rows
from jaxba.ba._unknowns import Unknowns
from jaxba.geometry import AbstractLoss, Linear


class PositionOffsetPrior(AbstractPrior):
    """Expected offset of positions: `xyz` metres in the world, mostly zero, `std_m` a sigma an axis; one row."""

    name: ClassVar[str] = "position_offset"
    in_world: ClassVar[tuple[str, ...] | None] = ()
    xyz: Float[Array | np.ndarray, "rows 3"]
    std_m: Float[Array | np.ndarray, "rows 3"]
    loss: AbstractLoss = Linear()

    def residual(self, unknowns: Unknowns) -> Float[Array, "3 rows"]:
        offset = jnp.sum(jnp.asarray(unknowns.position_offset), axis=0)
        return ((offset[None] - self.xyz) / jnp.asarray(self.std_m)).T

    def rows(self, unknowns: Unknowns) -> Rows:
        by_antenna = jnp.eye(3, len(unknowns.antenna), k=3, dtype=unknowns.antenna.dtype)
        derivative = by_antenna[:, :, None] / jnp.asarray(self.std_m).T[:, None]
        return Rows(residual=self.residual(unknowns), antenna=derivative)
