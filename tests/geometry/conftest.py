"""One check for every new derivative: forward = reverse = central difference, alone and batched, compiled."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import Array


def _assert_derivative(
    function: Callable[[Array], Array], batch: np.ndarray, *, tolerance: float = 1e-8, step: float = 1e-3
) -> None:
    """Check the Jacobian at each row of `batch`.

    The central difference has five points: at a step of 1e-3 it errs by about 1e-12 of the fifth derivative and by
    1e-13 of the value from rounding; `tolerance` is relative to the largest entry (at least 1) and leaves room for
    both.
    """
    points = jnp.asarray(batch)
    forward = jax.jit(jax.vmap(jax.jacfwd(function)))(points)
    reverse = jax.jit(jax.vmap(jax.jacrev(function)))(points)
    alone = jax.jit(jax.jacfwd(function))(points[0])
    batched = jax.jit(jax.vmap(function))
    columns = []
    for axis in step * np.eye(points.shape[-1]):
        near = batched(points + axis) - batched(points - axis)
        far = batched(points + 2 * axis) - batched(points - 2 * axis)
        columns.append((8 * near - far) / (12 * step))
    central = np.stack(columns, axis=-1)
    scale = max(1.0, np.abs(central).max())
    np.testing.assert_allclose(forward, central, rtol=0, atol=tolerance * scale)
    # the same chain in another order; where quotients just take over from a series it cancels to 1e-12
    np.testing.assert_allclose(reverse, forward, rtol=0, atol=1e-11 * scale)
    np.testing.assert_allclose(alone, forward[0], rtol=0, atol=1e-11 * scale)


@pytest.fixture
def assert_derivative() -> Callable[..., None]:
    return _assert_derivative
