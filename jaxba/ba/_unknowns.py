"""What an adjustment may change: values of all unknowns, and a tangent step of them."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float

from jaxba.geometry import Pose


class Step(eqx.Module):
    """A tangent step of all unknowns; also the shape of a gradient and of a diagonal."""

    poses: Float[Array | np.ndarray, "images 6"]
    intrinsics: Float[Array | np.ndarray, "cameras parameters"]
    antenna: Float[Array | np.ndarray, " antenna"]
    points: Float[Array | np.ndarray, "points 3"]


class Unknowns(eqx.Module):
    """Values of everything an adjustment may change; fields as in `Problem`, the intrinsics as one array.

    `antenna`: the lever arm, then the offsets that measured positions have in common, where the problem has any.
    """

    poses: Pose
    intrinsics: Float[Array | np.ndarray, "cameras parameters"]
    antenna: Float[Array | np.ndarray, " antenna"]
    points: Float[Array | np.ndarray, "points 3"]

    @property
    def lever_arm(self) -> Float[Array | np.ndarray, "3"]:
        """From the camera's centre to the antenna, metres, camera frame."""
        return self.antenna[:3]

    @property
    def position_offset(self) -> Float[Array | np.ndarray, "offsets 3"]:
        """Measured minus true positions, metres, world: a row an offset, none where the problem has no such unknown."""
        return self.antenna[3:].reshape(-1, 3)

    def retract(self, step: Step) -> "Unknowns":
        """Return the unknowns after a step: poses along their tangent, everything else by addition."""
        return Unknowns(
            self.poses.retract(jnp.asarray(step.poses)),
            self.intrinsics + step.intrinsics,
            self.antenna + step.antenna,
            self.points + step.points,
        )


def antenna_names(num_offsets: int) -> list[str]:
    """Return names for the entries of `Unknowns.antenna`; offsets are numbered where there are several.

    >>> antenna_names(1)[3:], antenna_names(2)[3:5]
    (['position offset x', 'position offset y', 'position offset z'], ['position offset 0 x', 'position offset 0 y'])
    """
    numbers = [""] if num_offsets == 1 else [f" {number}" for number in range(num_offsets)]
    return [f"{of} {axis}" for of in ("lever arm", *(f"position offset{n}" for n in numbers)) for axis in "xyz"]
