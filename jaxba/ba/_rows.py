"""What residual groups are written in: the unknowns, and rows of residuals with their derivatives.

Arrays of rows are component first, rows last: `(3, n)`, not `(n, 3)`. Elementwise code over long last axes is what XLA
turns into vector instructions on a CPU; the same formulas on `(n, 3, 6)` arrays measured ten times slower.
"""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float, Int

from jaxba.geometry import Pose


class Step(eqx.Module):
    """A tangent step of all unknowns; also the shape of a gradient and of a diagonal."""

    poses: Float[Array | np.ndarray, "images 6"]
    intrinsics: Float[Array | np.ndarray, "cameras parameters"]
    lever_arm: Float[Array | np.ndarray, "3"]
    points: Float[Array | np.ndarray, "points 3"]


class Unknowns(eqx.Module):
    """Values of everything an adjustment may change; fields as in `Problem`, the intrinsics as one array."""

    poses: Pose
    intrinsics: Float[Array | np.ndarray, "cameras parameters"]
    lever_arm: Float[Array | np.ndarray, "3"]
    points: Float[Array | np.ndarray, "points 3"]

    def retract(self, step: Step) -> "Unknowns":
        """Return the unknowns after a step: poses along their tangent, everything else by addition."""
        return Unknowns(
            self.poses.retract(step.poses),
            self.intrinsics + step.intrinsics,
            self.lever_arm + step.lever_arm,
            self.points + step.points,
        )


class Rows(eqx.Module):
    """Residuals of a prior over their sigmas, and their derivatives by the blocks that each row touches.

    Rows have as many components as the prior measures (3 for a position). A block that the prior does not touch is
    None; `*_index` says which pose, camera or point each row touches.
    """

    residual: Float[Array, "components rows"]
    pose_index: Int[Array, " rows"] | None = None
    pose: Float[Array, "components 6 rows"] | None = None
    camera_index: Int[Array, " rows"] | None = None
    intrinsics: Float[Array, "components parameters rows"] | None = None
    lever_arm: Float[Array, "components 3 rows"] | None = None
    point_index: Int[Array, " rows"] | None = None
    point: Float[Array, "components 3 rows"] | None = None


def rows_of(values: Array, index: Int[Array, "..."]) -> Array:
    """Gather along the first axis. The host has checked the indices; jax's own check costs more than the gather."""
    return jnp.asarray(values).at[index].get(mode="promise_in_bounds")


def rotation_rows(rotation: Float[Array, "images 3 3"], index: Int[Array, " rows"]) -> Float[Array, "3 3 rows"]:
    """Gather one rotation a row, rows last."""
    return rows_of(rotation.reshape(-1, 9), index).T.reshape(3, 3, -1)
