"""Scale bars: known distances between two points, `r = (|x - y| - L) / sigma`.

The normal equations have no block of two points. Each end of a bar is therefore an unknown of its own beside the point
that it stands at, q beside x: a point is tied to its end, and the length is one of two ends.

    r_tie = (x - q) / (sigma / 2)      r_length = (|q - q'| - L) / (sigma / sqrt(2))

With the best q the three squares of a bar sum up to r^2 at any x and y, since the misclosure goes to tie, length and
tie as 1 : 2 : 1, as their variances do; so solutions, covariances and tests are those of r itself.
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


class ScaleBarPrior(AbstractPrior):
    """Known distances between points; two rows a bar, one for each end: `with_scale_bars` makes them.

    - `offset_index`: the end, a row of the problem's `position_offset`; a bar's second end is the one after its first.
    - `end_index`: 0 for a first end, 1 for a second one. `point_index`: the point that the end stands at.
    - `xyz`, `other_xyz`: what this end and the bar's other one are counted from, metres, world.
    - `length_m`, `std_m`: length of the bar and its sigma, the same in both rows. `loss`: none but least squares.
    """

    name: ClassVar[str] = "scale_bar"
    in_world: ClassVar[tuple[str, ...] | None] = ("xyz", "other_xyz")
    offset_index: Int[Array | np.ndarray, " rows"]
    end_index: Int[Array | np.ndarray, " rows"]
    point_index: Int[Array | np.ndarray, " rows"]
    xyz: Float[Array | np.ndarray, "rows 3"]
    other_xyz: Float[Array | np.ndarray, "rows 3"]
    length_m: Float[Array | np.ndarray, " rows"]
    std_m: Float[Array | np.ndarray, "rows 1"]
    loss: AbstractLoss = Linear()

    def residual(self, unknowns: Unknowns) -> Float[Array, "4 rows"]:
        return self._residual(unknowns)[0]

    def _residual(self, unknowns: Unknowns) -> tuple[Float[Array, "4 rows"], Float[Array, "3 rows"]]:
        """Return the residuals, and the direction from each bar's second end to its first; zero in the second's row."""
        std_m = jnp.asarray(self.std_m)[:, 0]
        is_first = (jnp.asarray(self.end_index) == 0) & jnp.isfinite(std_m)  # padding may have both ends in one place
        end = self.xyz + rows_of(unknowns.position_offset, self.offset_index)
        other = self.other_xyz + rows_of(unknowns.position_offset, self._next(unknowns))
        along = jnp.where(is_first[:, None], end - other, jnp.array([1.0, 0.0, 0.0], end.dtype)).T
        distance = jnp.sqrt(along[0] ** 2 + along[1] ** 2 + along[2] ** 2)
        tie = (rows_of(unknowns.points, self.point_index) - end).T / (std_m / 2)
        length = jnp.where(is_first, (distance - self.length_m) / (std_m / np.sqrt(2)), 0.0)
        return jnp.concatenate([tie, length[None]]), jnp.where(is_first, along / distance, 0.0)

    def _next(self, unknowns: Unknowns) -> Int[Array, " rows"]:
        return jnp.minimum(jnp.asarray(self.offset_index) + 1, len(unknowns.position_offset) - 1)

    def rows(self, unknowns: Unknowns) -> Rows:
        residual, along = self._residual(unknowns)
        std_m, count = jnp.asarray(self.std_m)[:, 0], len(unknowns.position_offset)
        zero = jnp.zeros_like(along)[None]
        by_point = jnp.concatenate([jnp.eye(3, dtype=along.dtype)[:, :, None] / (std_m / 2), zero])
        by_length = (along / (std_m / np.sqrt(2)))[None]
        by_end = jnp.concatenate([-by_point[:3], by_length])
        by_other = jnp.concatenate([jnp.zeros_like(by_point[:3]), -by_length])
        ends = jnp.eye(count, dtype=along.dtype)
        columns = jnp.einsum("cin,nk->ckin", by_end, rows_of(ends, self.offset_index))
        columns += jnp.einsum("cin,nk->ckin", by_other, rows_of(ends, self._next(unknowns)))
        by_antenna = jnp.pad(columns.reshape(4, 3 * count, -1), ((0, 0), (3, 0), (0, 0)))
        return Rows(residual=residual, antenna=by_antenna, point=JacobianBlock(self.point_index, by_point))
