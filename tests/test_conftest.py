"""The guards that all other tests lean on are up."""

import jax.numpy as jnp
import jaxtyping
import pytest

from jaxba.geometry import hat


def test_functions_refuse_wrong_shapes():
    with pytest.raises(jaxtyping.TypeCheckError):
        hat(jnp.zeros(4))


def test_arrays_are_float64():
    assert hat(jnp.zeros(3)).dtype == jnp.float64
