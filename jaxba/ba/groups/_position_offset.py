"""Position offset prior: what is known of the offsets that measured positions share, `r = (d - d0) / sigma`.

The base of an RTK survey may stand beside its mark, and the errors of a single receiver are those of its satellites:
what all positions of a flight have in common is no error of each. It is an unknown of its own, a row of
`position_offset` of a problem, and this prior says how large it may be.
"""

from typing import ClassVar

import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float, Int

from jaxba.ba._problem import AbstractPrior
from jaxba.ba._rows import Rows, rows_of
from jaxba.ba._unknowns import Unknowns
from jaxba.geometry import AbstractLoss, Linear


class PositionOffsetPrior(AbstractPrior):
    """Expected offsets of positions.

    - `xyz`: metres, world, mostly zero. `std_m`: sigma an axis.
    - `offset_index`: which of the problem's offsets each row is about; all in their order where it is left out.
    """

    name: ClassVar[str] = "position_offset"
    in_world: ClassVar[tuple[str, ...] | None] = ()
    xyz: Float[Array | np.ndarray, "rows 3"]
    std_m: Float[Array | np.ndarray, "rows 3"]
    loss: AbstractLoss = Linear()
    offset_index: Int[Array | np.ndarray, " rows"] | None = None

    def _index(self) -> Int[Array | np.ndarray, " rows"]:
        return np.arange(len(self.xyz), dtype=np.int32) if self.offset_index is None else self.offset_index

    def residual(self, unknowns: Unknowns) -> Float[Array, "3 rows"]:
        offset = rows_of(unknowns.position_offset, self._index())
        return ((offset - self.xyz) / jnp.asarray(self.std_m)).T

    def rows(self, unknowns: Unknowns) -> Rows:
        count = len(unknowns.position_offset)
        columns = jnp.eye(3 * count, dtype=unknowns.antenna.dtype).reshape(count, 3, 3 * count)
        by_antenna = jnp.pad(jnp.transpose(rows_of(columns, self._index()), (1, 2, 0)), ((0, 0), (3, 0), (0, 0)))
        return Rows(residual=self.residual(unknowns), antenna=by_antenna / jnp.asarray(self.std_m).T[:, None])
