"""Compiler options: they are accepted by this XLA, and change no result beyond rounding."""

import jax
import jax.numpy as jnp
import numpy as np

from jaxba.ba._compiler import compiler_options, fast_jit


def test_options_are_known_to_this_compiler() -> None:
    assert jax.default_backend() != "cpu" or len(compiler_options()) == 2


def test_programs_compiled_fast_give_the_same_numbers() -> None:
    def function(x: jax.Array) -> jax.Array:
        return jnp.linalg.cholesky(x @ x.T + jnp.eye(40, dtype=x.dtype)) * jnp.sin(x)

    x = np.random.default_rng(0).normal(size=(40, 40))
    with jax.enable_x64(True):
        np.testing.assert_allclose(fast_jit(function)(x), jax.jit(function)(x), rtol=1e-12, atol=1e-12)
