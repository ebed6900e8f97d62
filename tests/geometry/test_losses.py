"""Losses against scipy, published formulas in 50 digits, and central differences."""

from decimal import Decimal, localcontext
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.optimize
from jax import Array
from quick_jit import quick_jit

from jaxba._errors import JaxbaError
from jaxba.geometry import (
    LOSSES,
    AbstractLoss,
    Arctan,
    Barron,
    Cauchy,
    GemanMcClure,
    Huber,
    Linear,
    SoftL1,
    Tukey,
    check_loss,
)

# squared residuals from nothing to a gross outlier, beside the corner of Huber and Tukey at 1
SQUARED = np.array([0.0, 1e-12, 1e-3, 0.4, 0.999, 1.001, 2.5, 30.0, 1e4, 1e8])
FAR = np.logspace(-300, 40, 2001)
EVERY = [
    *(loss() for loss in LOSSES.values()),
    *(Barron(alpha=alpha) for alpha in (-np.inf, -1e6, -7.0, -2.0, -1e-9, 0.0, 1e-9, 0.5, 1.999, 2.0)),
]

# rho, rho', rho'' as scipy's documentation and the papers give them, in z
FORMULAS = {
    Linear: (lambda z: z, lambda z: np.ones_like(z), lambda z: np.zeros_like(z)),
    SoftL1: (lambda z: 2 * (np.sqrt(1 + z) - 1), lambda z: (1 + z) ** -0.5, lambda z: -((1 + z) ** -1.5) / 2),
    Huber: (
        lambda z: np.where(z <= 1, z, 2 * np.sqrt(z) - 1),
        lambda z: np.where(z <= 1, 1.0, np.maximum(z, 1) ** -0.5),
        lambda z: np.where(z <= 1, 0.0, -(np.maximum(z, 1) ** -1.5) / 2),
    ),
    Cauchy: (np.log1p, lambda z: 1 / (1 + z), lambda z: -1 / (1 + z) ** 2),
    Arctan: (np.arctan, lambda z: 1 / (1 + z**2), lambda z: -2 * z / (1 + z**2) ** 2),
    Tukey: (
        lambda z: np.where(z <= 1, (1 - (1 - z) ** 3) / 3, 1 / 3),
        lambda z: np.where(z <= 1, (1 - z) ** 2, 0.0),
        lambda z: np.where(z <= 1, -2 * (1 - z), 0.0),
    ),
    GemanMcClure: (lambda z: z / (1 + z), lambda z: (1 + z) ** -2.0, lambda z: -2 * (1 + z) ** -3.0),
}

_derivatives = quick_jit(lambda loss, squared: loss.derivatives(squared))


def derivatives(loss: AbstractLoss, squared: np.ndarray) -> list[np.ndarray]:
    """Return value, slope and curvature; each class compiles once, for so many values as `SQUARED` and `FAR` have."""
    padded = np.ones(len(SQUARED) + len(FAR))
    padded[: len(squared)] = squared
    return [np.asarray(result)[: len(squared)] for result in _derivatives(loss, padded)]


@pytest.mark.parametrize("name", ["linear", "soft_l1", "huber", "cauchy", "arctan"])
@pytest.mark.parametrize("f_scale", [1.0, 0.3])
def test_cost_equals_scipy_of_the_square_rooted_residual(name, f_scale):
    cost = 0.5 * np.sum(derivatives(LOSSES[name](f_scale=f_scale), SQUARED)[0])
    residual = np.sqrt(SQUARED)
    oracle = scipy.optimize.least_squares(
        lambda x: residual + 0 * x[0], [0.0], jac=lambda x: np.zeros((len(SQUARED), 1)), loss=name, f_scale=f_scale
    )
    np.testing.assert_allclose(cost, oracle.cost, rtol=1e-14)


@pytest.mark.parametrize("loss", FORMULAS, ids=lambda loss: loss.__name__)
@pytest.mark.parametrize("f_scale", [1.0, 2.5])
def test_value_slope_and_curvature_equal_the_published_formulas(loss, f_scale):
    z = SQUARED / f_scale**2
    rho, slope, curvature = (formula(z) for formula in FORMULAS[loss])
    expected = f_scale**2 * rho, slope, curvature / f_scale**2
    for result, value in zip(derivatives(loss(f_scale), SQUARED), expected, strict=True):
        # 1e-15: what the published forms lose near zero, where ours do not
        np.testing.assert_allclose(result, value, rtol=2e-12, atol=1e-15)


@pytest.mark.parametrize("loss", EVERY, ids=repr)
def test_small_residuals_count_as_in_least_squares(loss):
    value, slope, _ = derivatives(loss, np.array([0.0, 1e-12]))
    np.testing.assert_allclose(value, [0.0, 1e-12], rtol=1e-11)
    np.testing.assert_allclose(slope, 1.0, rtol=1e-11)


@pytest.mark.parametrize("loss", EVERY, ids=repr)
def test_weights_are_never_negative_and_all_is_finite_for_gross_outliers(loss):
    value, slope, curvature = derivatives(loss, FAR)
    for result in (value, slope, curvature):
        assert np.all(np.isfinite(result))
    assert np.all(slope >= 0)
    assert np.all(np.diff(value) >= 0)


@pytest.mark.parametrize(
    ("alpha", "expected"),
    [
        (2.0, Linear()),
        (1.0, SoftL1()),
        (0.0, Cauchy(2**0.5)),
        (-2.0, GemanMcClure(2.0)),
    ],
)
def test_barron_has_its_published_special_cases(alpha, expected):
    results, values = (derivatives(loss, SQUARED)[:2] for loss in (Barron(alpha=alpha), expected))
    for result, value in zip(results, values, strict=True):
        # expm1(log1p(z/b)) multiplies a rounding by log(z/b), at most 55 at alpha = 2
        np.testing.assert_allclose(result, value, rtol=2e-14)


def test_barron_becomes_welsch_for_very_negative_alpha():
    welsch = -2 * np.expm1(-SQUARED / 2)
    for alpha, tolerance in ((-np.inf, 1e-14), (-1e300, 1e-14), (-1e12, 1e-10)):  # it differs by z^2/b
        np.testing.assert_allclose(derivatives(Barron(alpha=alpha), SQUARED)[0], welsch, rtol=tolerance)


ALPHAS = [-300.0, -5.3, -1.0, -2e-4, -1.21e-4, -1e-6, 1e-300, 1e-9, 1e-4, 1.3e-4, 0.01, 1.4, 1.9999, 2.0001, 3.0]


def _barron_in_50_digits(squared: float, alpha: float) -> float:
    with localcontext() as context:
        context.prec = 340  # alpha = 1e-300 as well
        a = Decimal(alpha)
        b = abs(a - 2)
        return float(2 * b / a * ((Decimal(squared) / b + 1) ** (a / 2) - 1))


def test_barron_equals_its_definition_in_high_precision():
    squared = SQUARED[[1, 3, 6, 8]]
    expected = [[_barron_in_50_digits(s, alpha) for s in squared] for alpha in ALPHAS]
    result = [derivatives(Barron(alpha=alpha), squared)[0] for alpha in ALPHAS]
    np.testing.assert_allclose(result, expected, rtol=1e-14)


def test_barron_has_derivatives_by_residual_alpha_and_scale_that_match_central_difference(assert_derivative):
    alphas = np.array([-300.0, -5.3, -1.0, -1.2e-4, -1e-9, 0.0, 1e-9, 1.3e-4, 0.01, 1.0, 1.4, 2.3, 3.0])
    batch = np.array([[s, alpha, 1.3] for s in (0.01, 0.7, 9.0) for alpha in alphas])
    assert_derivative(lambda p: Barron(alpha=p[1], f_scale=p[2])(p[0]), batch)


def test_barron_has_finite_derivatives_by_alpha_where_its_formula_is_0_over_0():
    alphas = np.array([-np.inf, -1e12, 0.0, 2.0, 2 - 1e-12])
    slopes = quick_jit(jax.vmap(jax.vmap(jax.grad(lambda a, s: Barron(alpha=a)(s)))))(*np.meshgrid(alphas, SQUARED))
    assert np.all(np.isfinite(slopes))


@pytest.mark.parametrize("loss", FORMULAS, ids=lambda loss: loss.__name__)
def test_losses_have_derivatives_that_match_central_difference(loss, assert_derivative):
    batch = np.array([[s, f] for s in (0.01, 0.4, 2.5, 30.0) for f in (1.0, 1.3)])
    assert_derivative(lambda p: loss(f_scale=p[1])(p[0]), batch)


WITHIN = "give a positive number of sigmas"


@pytest.mark.parametrize("name", LOSSES)
@pytest.mark.parametrize("scale", [0.0, -1.0, np.nan, np.inf, -np.inf, 1e-200, 1e200, np.float64(0), jnp.array(-2.0)])
def test_a_scale_that_is_none_is_named(name: str, scale: Any):
    with pytest.raises(JaxbaError, match=f"{LOSSES[name].__name__}: f_scale is .*; {WITHIN}"):
        LOSSES[name](f_scale=scale)


@pytest.mark.parametrize("scale", ["1.0", None, True, 1j], ids=str)
def test_a_scale_of_another_kind_is_named(scale: Any):
    with pytest.raises(JaxbaError, match=f"Huber: f_scale is .*no number; {WITHIN}"):
        check_loss("loss", _with_scale(scale))


@pytest.mark.parametrize("alpha", [np.nan, np.inf, 2.0001, 3.0])
def test_a_shape_that_is_none_is_named(alpha: float):
    with pytest.raises(JaxbaError, match=f"Barron: alpha is {alpha:g}; give 2 .least squares. or less"):
        check_loss("solve: loss", Barron(alpha=alpha))


@pytest.mark.parametrize(("loss", "text"), [("huber", "'huber'"), (Huber, "class"), (None, "None"), (1.0, "1.0")])
def test_what_is_no_loss_is_named(loss: Any, text: str):
    with pytest.raises(JaxbaError, match=f"^solve: loss is .*{text}.*; give a loss, such as Huber"):
        check_loss("solve: loss", loss)


def test_a_value_put_in_later_is_found():
    with pytest.raises(JaxbaError, match="f_scale is 0"):
        check_loss("loss", _with_scale(0.0))
    with pytest.raises(JaxbaError, match=r"f_scale has shape \(2,\); it is one number"):
        check_loss("loss", _with_scale(np.ones(2)))


def test_traced_and_batched_scales_are_losses():
    def cost(scale: Array) -> Array:
        loss = Barron(alpha=scale - 1, f_scale=scale)
        check_loss("loss", loss)
        return loss(jnp.array(4.0))

    scales = jnp.array([1.0, 2.0])
    batch = jax.vmap(lambda scale: Barron(alpha=scale - 1, f_scale=scale))(scales)
    each = jax.vmap(lambda loss: loss(jnp.array(4.0)))(batch)
    np.testing.assert_allclose(each, jax.vmap(cost)(scales), rtol=1e-6)
    assert np.isfinite(jax.grad(cost)(2.0))


def _with_scale(scale: Any) -> Huber:
    return eqx.tree_at(lambda loss: loss.f_scale, Huber(), scale, is_leaf=lambda leaf: leaf is None)
