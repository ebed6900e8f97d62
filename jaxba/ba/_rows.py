"""What residual groups are written in: rows of residuals with their derivatives, and how to gather and sum them.

Arrays of rows are component first, rows last: `(3, n)`, not `(n, 3)`. Elementwise code over long last axes is what XLA
turns into vector instructions on a CPU; the same formulas on `(n, 3, 6)` arrays measured ten times slower.
"""

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float, Int


class JacobianBlock(eqx.Module):
    """Derivatives of a prior's rows by one kind of unknown.

    - `index`: which one of its kind each row touches.
    - `jacobian`: by its tangent step, 6 columns for a pose, 3 for a point, one a parameter for intrinsics.
    """

    index: Int[Array | np.ndarray, " rows"]
    jacobian: Float[Array, "components columns rows"]


class Rows(eqx.Module):
    """Residuals of a prior over their sigmas, and their derivatives by what they touch; None what they do not touch.

    Rows have as many components as the prior measures, 3 for a position.
    """

    residual: Float[Array, "components rows"]
    pose: JacobianBlock | None = None
    intrinsics: JacobianBlock | None = None
    antenna: Float[Array, "components antenna rows"] | None = None
    point: JacobianBlock | None = None


def rows_of(values: Array | np.ndarray, index: Int[Array | np.ndarray, "..."]) -> Array:
    """Gather along the first axis. The host has checked the indices; jax's own check costs more than the gather."""
    return jnp.asarray(values).at[index].get(mode="promise_in_bounds")


def segments(values: Float[Array, "n *rest"], index: Int[Array | np.ndarray, "..."], count: int) -> Array:
    """Sum values by index into `count` sums along the first axis; the host has checked the indices."""
    return jax.ops.segment_sum(values, index.reshape(-1), num_segments=count, mode="promise_in_bounds")


def sum_components(values: Float[Array, "components *rest"]) -> Float[Array, "*rest"]:
    """Sum over a short leading axis, term by term: XLA's own reduction over such an axis is ten times slower."""
    return functools.reduce(jnp.add, [values[i] for i in range(values.shape[0])])


def rotation_rows(
    rotation: Float[Array, "images 3 3"], index: Int[Array | np.ndarray, " rows"]
) -> Float[Array, "3 3 rows"]:
    """Gather one rotation a row, rows last."""
    return rows_of(rotation.reshape(-1, 9), index).T.reshape(3, 3, -1)
