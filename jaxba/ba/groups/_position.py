"""Position priors: GNSS positions of the antenna, with a sigma an axis, a lever arm, and offsets that many share.

    r = (C + R^T l + d - g) / sigma,   C = -R^T t

With the step (w, v) on the left of the pose, `dC/dw = 0`, `dC/dv = -R^T`, `d(R^T l)/dw = R^T [l]_x`, `d/dl = R^T`.
"""

from typing import ClassVar

import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float, Int

from jaxba.ba._problem import AbstractPrior
from jaxba.ba._rows import JacobianBlock, Rows, rotation_rows, rows_of
from jaxba.ba._unknowns import Unknowns
from jaxba.geometry import AbstractLoss, Linear


class PositionPrior(AbstractPrior):
    """Measured antenna positions of some images.

    - `xyz`: metres, world. `std_m`: sigma an axis; infinite where an axis is not measured.
    - `offset_weights`: by which each of the problem's position offsets counts in each row: 1 for that of all or of its
      flight, a time for a drift; all count by 1 where it is left out.
    - `loss`: robust against single bad fixes, e.g. `Cauchy(3.0)`, in units of sigma.
    """

    name: ClassVar[str] = "position"
    in_world: ClassVar[tuple[str, ...] | None] = ("xyz",)
    image_index: Int[Array | np.ndarray, " rows"]
    xyz: Float[Array | np.ndarray, "rows 3"]
    std_m: Float[Array | np.ndarray, "rows 3"]
    loss: AbstractLoss = Linear()
    offset_weights: Float[Array | np.ndarray, "rows offsets"] | None = None

    def offset(self, offsets: Float[Array | np.ndarray, "offsets 3"]) -> Float[Array | np.ndarray, "rows 3"]:
        """Return the offset of each row, metres, world; zero where a problem has none."""
        return self._weights(offsets) @ offsets

    def _weights(self, offsets: Float[Array | np.ndarray, "offsets 3"]) -> Float[Array | np.ndarray, "rows offsets"]:
        if self.offset_weights is None:
            return np.ones((len(self.image_index), len(offsets)), offsets.dtype)
        return self.offset_weights

    def residual(self, unknowns: Unknowns) -> Float[Array, "3 rows"]:
        rotation = rotation_rows(unknowns.poses.rotation, jnp.asarray(self.image_index))
        translation = rows_of(unknowns.poses.translation, self.image_index).T
        antenna = jnp.einsum("jin,jn->in", rotation, unknowns.lever_arm[:, None] - translation)
        offset = jnp.asarray(self.offset(unknowns.position_offset)).T
        return (antenna + offset - jnp.asarray(self.xyz).T) / jnp.asarray(self.std_m).T

    def rows(self, unknowns: Unknowns) -> Rows:
        rotation = rotation_rows(unknowns.poses.rotation, jnp.asarray(self.image_index))
        transposed = jnp.swapaxes(rotation, 0, 1) / jnp.asarray(self.std_m).T[:, None]
        x, y, z = unknowns.lever_arm
        by_offset = jnp.eye(3, dtype=transposed.dtype)[:, :, None] / jnp.asarray(self.std_m).T[:, None]
        weights = jnp.asarray(self._weights(unknowns.position_offset))
        # R^T [l]_x, column by column
        turn = [
            transposed[:, 1] * z - transposed[:, 2] * y,
            transposed[:, 2] * x - transposed[:, 0] * z,
            transposed[:, 0] * y - transposed[:, 1] * x,
        ]
        return Rows(
            residual=self.residual(unknowns),
            pose=JacobianBlock(self.image_index, jnp.concatenate([jnp.stack(turn, axis=1), -transposed], axis=1)),
            antenna=jnp.concatenate([transposed, *[by_offset * each for each in weights.T]], axis=1),
        )
