"""Options out of range are refused by name, value and cure, before anything is computed."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import numpy as np
import pytest
from small_problems import RADIAL, small_problem

import jaxba
from jaxba._errors import JaxbaError
from jaxba.ba import _descend, quality
from jaxba.ba._solvers import SchurDogleg, SchurLevenbergMarquardt
from jaxba.geometry import require_number

PROBLEM = small_problem(RADIAL)


def solve_with(**options: Any) -> Callable[[], Any]:
    return lambda: jaxba.solve(PROBLEM, **options)


@pytest.mark.parametrize("value", [-1e-8, -1.0, np.nan, np.inf, -np.inf, np.float64(-1)], ids=repr)
@pytest.mark.parametrize("name", ["ftol", "xtol", "gtol"])
def test_a_tolerance_that_is_none_is_named(name: str, value: Any):
    with pytest.raises(JaxbaError, match=rf"solve: {name} (is|has) .*give 0 \(never stop for it\) or a small positive"):
        jaxba.solve(PROBLEM, **{name: value})


@pytest.mark.parametrize("value", [0, -1, True], ids=repr)
def test_a_number_of_steps_that_is_none_is_named(value: Any):
    with pytest.raises(JaxbaError, match=r"solve: max_nfev (is|has) .*give a whole number of steps, 1 or more"):
        jaxba.solve(PROBLEM, max_nfev=value)


def test_other_tolerances_stop_elsewhere_and_compile_nothing():
    # breaks where a tolerance is a constant of the program, or the program keeps the first one
    tight = jaxba.solve(PROBLEM)
    compiled = _descend._compile.cache_info().misses
    loose, by_steps = jaxba.solve(PROBLEM, ftol=1e-2), jaxba.solve(PROBLEM, ftol=0.0, gtol=0.0, xtol=1e-2)
    assert _descend._compile.cache_info().misses == compiled
    assert loose.num_steps < tight.num_steps and by_steps.num_steps < tight.num_steps
    assert (tight.result, loose.result, by_steps.result) == ("ftol", "ftol", "xtol")


@pytest.mark.parametrize("make", [SchurLevenbergMarquardt, SchurDogleg])
@pytest.mark.parametrize(
    ("name", "value"), [("rtol", np.nan), ("atol", -1.0), ("xtol", np.inf), ("initial_trust", 0.0)]
)
def test_a_solver_of_ones_own_is_checked(make: Any, name: str, value: float):
    with pytest.raises(JaxbaError, match=f"{make.__name__}: {name} is {value:g}; give"):
        make(**{name: value})


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (solve_with(dtype=np.int32), "dtype 'int32': choose one of float64, float32"),
        (solve_with(dtype=None), "dtype 'None': choose"),
        (solve_with(dtype="double precision"), "dtype 'double precision': choose"),
        (lambda: jaxba.make_plan(PROBLEM, spare=-0.5), "spare is -0.5; give a share"),
        (lambda: jaxba.solve_and_reject(PROBLEM, rounds=-1), "rounds is -1; give a whole number"),
        (lambda: jaxba.solve_and_reject(PROBLEM, mad_factor=np.nan), "mad_factor is nan; give a positive"),
        (lambda: quality(PROBLEM, mad_factor=-1.0), "mad_factor is -1; give a positive"),
        (lambda: quality(PROBLEM, np.ones(3, bool)), r"used: a mask of shape \(3,\)"),
        (lambda: jaxba.check_gradients(PROBLEM, tolerance=np.inf), "tolerance is inf; give a positive"),
    ],
)
def test_an_option_out_of_range_is_named(call: Callable[[], Any], message: str):
    with pytest.raises(JaxbaError, match=message):
        call()


def test_the_loss_of_a_prior_is_checked_however_it_got_there():
    bad = eqx.tree_at(lambda p: p.priors[0].loss, PROBLEM, eqx.tree_at(lambda x: x.f_scale, jaxba.Cauchy(1.0), 0.0))
    with pytest.raises(JaxbaError, match="prior position: loss Cauchy: f_scale is 0; give a positive number"):
        jaxba.solve(bad)


KINDS = {
    "text": ("1", "is '1', which is no number"),
    "None": (None, "is None, which is no number"),
    "bool": (True, "is True, which is no number"),
    "complex": (1j, "is 1j, which is no number"),
    "list": ([1], r"has shape \(1,\); it is one number"),
    "array": (np.ones(2), r"has shape \(2,\)"),
    "fraction": (1.5, "is 1.5"),
    "nan": (np.float32(np.nan), "is nan"),
    "jax": (jax.numpy.array(-1), "is -1"),
}


@pytest.mark.parametrize("kind", KINDS)
def test_a_number_of_another_kind_is_named(kind: str):
    value, message = KINDS[kind]
    with pytest.raises(JaxbaError, match=f"rounds {message}.*give 0 or more"):
        require_number("rounds", value, 0.0, np.inf, "give 0 or more", whole=True)
