"""Robust reweighting of residuals and their derivatives.

With s = |r|^2 of a row and loss rho(s), the row enters the normal equations as in Triggs et al. 2000 (section 4.3),
which keeps the curvature of rho along r:

    r~ = sqrt(rho') / (1 - alpha) r        J~ = sqrt(rho') (I - alpha r r^T / s) J

with alpha the smaller root of `alpha^2 / 2 - alpha - rho'' s / rho' = 0`. `J~^T r~ = rho' J^T r` is the exact gradient
for any alpha, so alpha is free to be held below `bend`: 0 is iteratively reweighted least squares, a safe overestimate
of the curvature far from the optimum, 1 the full curvature, fast near it.
"""

import functools
from collections.abc import Callable, Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float

from jaxba.ba._compiler import fast_jit
from jaxba.geometry import AbstractLoss, Linear

Components = list[Array]
"""A row's components, each an array over rows."""

_CHUNK = 4096


def reweighting(
    residual: Sequence[Array], loss: AbstractLoss, bend: Float[Array, ""]
) -> tuple[Components, Callable[[Sequence[Array]], Components]]:
    """Return the robust residual, and the function that makes a column of J one of J~."""
    if isinstance(loss, Linear):
        return list(residual), list
    squared = functools.reduce(jnp.add, [r * r for r in residual])
    _, slope, curvature = loss.derivatives(squared)
    slope = jnp.maximum(slope, 1e-12)  # a loss that has levelled off leaves a row without weight, not without a shape
    root = jnp.sqrt(slope)
    bent = 1 + 2 * curvature * squared / slope
    alpha = jnp.minimum(1 - jnp.where(bent > 0, jnp.sqrt(jnp.where(bent > 0, bent, 1.0)), 0.0), bend)
    length = jnp.sqrt(jnp.where(squared > 0, squared, 1.0))
    unit = [r / length for r in residual]

    def reweighted(column: Sequence[Array]) -> Components:
        along = alpha * functools.reduce(jnp.add, [u * c for u, c in zip(unit, column, strict=True)])
        return [root * (c - u * along) for u, c in zip(unit, column, strict=True)]

    return [root / (1 - alpha) * r for r in residual], reweighted


def loss_derivatives(
    loss: AbstractLoss, squared_norm: Float[np.ndarray, " n"]
) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"]]:
    """Return a loss's first and second derivative by the squared norm, for use on the host.

    They are computed in pieces of one size, so that one program serves any number of them.

    >>> from jaxba.geometry import Cauchy
    >>> loss_derivatives(Cauchy(), np.array([0.0, 1.0]))[0].tolist()
    [1.0, 0.5]
    """
    numbers = jax.tree.map(lambda number: np.asarray(number, float), loss)
    found = np.empty((2, len(squared_norm)))
    with jax.enable_x64(True):
        for start in range(0, len(squared_norm), _CHUNK):
            piece = squared_norm[start : start + _CHUNK]
            filled = np.pad(piece, (0, _CHUNK - len(piece)))
            found[:, start : start + len(piece)] = np.stack(_derivatives(numbers, filled))[:, : len(piece)]
    return found[0], found[1]


@fast_jit
def _derivatives(loss: AbstractLoss, squared_norm: Float[Array, " n"]) -> tuple[Float[Array, " n"], ...]:
    return loss.derivatives(squared_norm)[1:]
