"""One check for every new derivative: forward = reverse = central difference, alone and batched, compiled."""

from collections.abc import Callable

import jax
import numpy as np
import pytest
from jax import Array
from quick_jit import quick_jit


def _assert_derivative(
    function: Callable[[Array], Array], batch: np.ndarray, *, tolerance: float = 1e-8, step: float = 1e-3
) -> None:
    """Check the Jacobian at each row of `batch`: forward mode on all of them together, reverse mode on each alone.

    The central difference has five points: at a step of 1e-3 it errs by about 1e-12 of the fifth derivative and by
    1e-13 of the value from rounding; `tolerance` is relative to the largest entry (at least 1) and leaves room for
    both.
    """
    axes = step * np.eye(batch.shape[-1])
    around = batch + np.stack([axes, -axes, 2 * axes, -2 * axes])[:, :, None]

    @quick_jit
    def every(points: Array, around: Array) -> tuple[Array, Array, Array]:
        forward, reverse = jax.vmap(jax.jacfwd(function)), jax.jacrev(function)
        return forward(points), jax.lax.map(reverse, points), jax.vmap(function)(around)

    forward, reverse, values = (np.asarray(a) for a in every(batch, around.reshape(-1, batch.shape[-1])))
    values = values.reshape(*around.shape[:-1], *values.shape[1:])
    near, far = values[0] - values[1], values[2] - values[3]
    central = np.moveaxis((8 * near - far) / (12 * step), 0, -1)
    scale = max(1.0, np.abs(central).max())
    np.testing.assert_allclose(forward, central, rtol=0, atol=tolerance * scale)
    # the same chain in another order; where quotients just take over from a series it cancels to 1e-12
    np.testing.assert_allclose(reverse, forward, rtol=0, atol=1e-11 * scale)


@pytest.fixture
def assert_derivative() -> Callable[..., None]:
    return _assert_derivative
