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
            self.poses.retract(jnp.asarray(step.poses)),
            self.intrinsics + step.intrinsics,
            self.lever_arm + step.lever_arm,
            self.points + step.points,
        )
