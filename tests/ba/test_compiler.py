"""Compiler options: they are accepted by this XLA, and change no result beyond rounding."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxba
from jaxba.ba import _descend, _kept_programs, _products
from jaxba.ba._compiler import compiler_options, fast_jit, platform


def test_options_are_known_to_this_compiler() -> None:
    assert jax.default_backend() != "cpu" or len(compiler_options()) == 2


def test_programs_compiled_fast_give_the_same_numbers() -> None:
    def function(x: jax.Array) -> jax.Array:
        return jnp.linalg.cholesky(x @ x.T + jnp.eye(40, dtype=x.dtype)) * jnp.sin(x)

    x = np.random.default_rng(0).normal(size=(40, 40))
    with jax.enable_x64(True):
        np.testing.assert_allclose(fast_jit(function)(x), jax.jit(function)(x), rtol=1e-12, atol=1e-12)


def test_the_products_for_a_gpu_lead_to_the_same_steps(monkeypatch: pytest.MonkeyPatch) -> None:
    # breaks where what is computed off the CPU, and compiled here for it, is something else
    problem = jaxba.synthetic.uav_block(12, points_per_image=20.0, mean_track_length=4.0).problem
    here = jaxba.solve(problem, max_nfev=3)
    products, einsum = [], jnp.einsum
    monkeypatch.setattr(jnp, "einsum", lambda form, *of: products.append(form) or einsum(form, *of))
    monkeypatch.setattr(_kept_programs, "_folder", lambda: None)
    monkeypatch.setattr(_products, "platform", lambda: "gpu")
    monkeypatch.setattr(_descend, "platform", lambda: "gpu")
    there = jaxba.solve(problem, max_nfev=3)
    assert products and "rka,rkb->rab" not in products  # it was traced again, in the other form
    costs = [[step.cost for step in solution.report.history] for solution in (here, there)]
    np.testing.assert_allclose(costs[1], costs[0], rtol=1e-11)
    np.testing.assert_allclose(there.points, here.points, atol=1e-9)


def test_where_programs_run_is_that_of_the_default_device() -> None:
    assert platform() == jax.default_backend()
    with jax.default_device(jax.devices("cpu")[0]):
        assert platform() == "cpu" and len(compiler_options()) == 2
    with jax.default_device("gpu"):
        assert platform() == "gpu" and not compiler_options()
