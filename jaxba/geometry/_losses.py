"""Robust losses, in scipy's form: `rho(z)` with `z = (|r| / f_scale)^2`, the cost of a residual `f_scale^2 rho(z) / 2`.

`r` is the whole residual of one observation (both pixel components over its sigma), so a loss is applied once an
observation and does not depend on the orientation of the axes. Every rho has `rho(0) = 0` and `rho'(0) = 1`: small
residuals count as in least squares.
"""

import abc
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.core import Tracer
from jaxtyping import Float

from jaxba._errors import JaxbaError
from jaxba.geometry._numbers import require_number

_LEAST_SCALE, _LARGEST_SCALE = 1e-18, 1e18  # their squares, and those over them, are finite in float32


class AbstractLoss(eqx.Module):
    """Robust loss; `f_scale` is in units of the residual's sigma.

    A scale that is not positive and finite is refused with a `JaxbaError`, here and by everything that takes a loss.
    """

    f_scale: eqx.AbstractVar[Float[Array, ""] | float]

    def __check_init__(self) -> None:
        if not any(isinstance(leaf, Tracer) or np.ndim(leaf) for leaf in jax.tree.leaves(self)):
            _check_numbers("loss", self, most_alpha=np.finfo(float).max)  # a loss of arrays is one for `vmap`

    @abc.abstractmethod
    def rho(self, z: Float[Array, "*n"]) -> Float[Array, "*n"]:
        """Return rho of the squared, scaled residual."""

    def __call__(self, squared_norm: Float[Array, "*n"]) -> Float[Array, "*n"]:
        """Return `f_scale^2 rho(squared_norm / f_scale^2)`, twice the cost."""
        squared_scale = jnp.square(jnp.asarray(self.f_scale, squared_norm.dtype))
        return squared_scale * self.rho(squared_norm / squared_scale)

    def derivatives(self, squared_norm: Float[Array, "*n"]) -> tuple[Float[Array, "*n"], ...]:
        """Return the loss and its first and second derivative with respect to the squared norm, element by element."""
        ones = jnp.ones_like(squared_norm)

        def first(s: Array) -> tuple[Array, Array]:
            return jax.jvp(self.__call__, (s,), (ones,))

        (value, slope), (_, curvature) = jax.jvp(first, (squared_norm,), (ones,))
        return value, slope, curvature


class Linear(AbstractLoss):
    """Least squares: `rho(z) = z`."""

    f_scale: Float[Array, ""] | float = 1.0

    def rho(self, z: Float[Array, "*n"]) -> Float[Array, "*n"]:
        return z


class SoftL1(AbstractLoss):
    """Smooth approximation of the absolute value: `rho(z) = 2 (sqrt(1 + z) - 1)`."""

    f_scale: Float[Array, ""] | float = 1.0

    def rho(self, z: Float[Array, "*n"]) -> Float[Array, "*n"]:
        return 2 * z / (jnp.sqrt(1 + z) + 1)


class Huber(AbstractLoss):
    """Quadratic within `f_scale`, linear beyond: `rho(z) = z if z <= 1 else 2 sqrt(z) - 1` (Huber 1964)."""

    f_scale: Float[Array, ""] | float = 1.0

    def rho(self, z: Float[Array, "*n"]) -> Float[Array, "*n"]:
        inside = z <= 1
        return jnp.where(inside, z, 2 * jnp.sqrt(jnp.where(inside, 1.0, z)) - 1)


class Cauchy(AbstractLoss):
    """`rho(z) = ln(1 + z)`: weak influence of large residuals."""

    f_scale: Float[Array, ""] | float = 1.0

    def rho(self, z: Float[Array, "*n"]) -> Float[Array, "*n"]:
        return jnp.log1p(z)


class Arctan(AbstractLoss):
    """`rho(z) = arctan(z)`: bounded cost."""

    f_scale: Float[Array, ""] | float = 1.0

    def rho(self, z: Float[Array, "*n"]) -> Float[Array, "*n"]:
        return jnp.arctan(z)


class Tukey(AbstractLoss):
    """Biweight, no influence beyond `f_scale`: `rho(z) = (1 - (1 - z)^3) / 3 if z <= 1 else 1/3` (Tukey 1974)."""

    f_scale: Float[Array, ""] | float = 1.0

    def rho(self, z: Float[Array, "*n"]) -> Float[Array, "*n"]:
        inside = jnp.minimum(z, 1.0)
        return inside * (1 - inside + inside * inside / 3)  # the same, multiplied out: keeps its digits near zero


class GemanMcClure(AbstractLoss):
    """`rho(z) = z / (1 + z)`: bounded cost (Geman and McClure 1987)."""

    f_scale: Float[Array, ""] | float = 1.0

    def rho(self, z: Float[Array, "*n"]) -> Float[Array, "*n"]:
        share = 1 / (1 + z)
        # equal; each is used where its derivative, as computed, cannot round to a negative number
        return jnp.where(z < 1, z * share, 1 - share)


class Barron(AbstractLoss):
    """General loss with shape `alpha` (Barron 2019, eq. 8, doubled so that rho'(0) = 1).

    `alpha = 2` least squares, 1 `SoftL1`, 0 `Cauchy(sqrt(2))`, -2 `GemanMcClure(2)`, -inf Welsch: lower is stronger.
    Every derivative is finite; the one by alpha grows as `-ln |alpha - 2|` towards 2, a property of the loss itself.
    """

    alpha: Float[Array, ""] | float = 1.0
    f_scale: Float[Array, ""] | float = 1.0

    def rho(self, z: Float[Array, "*n"]) -> Float[Array, "*n"]:
        eps = float(jnp.finfo(z.dtype).eps)
        alpha = jnp.maximum(jnp.asarray(self.alpha, z.dtype), -1 / eps)  # Welsch to rounding, also for -inf
        b = jnp.maximum(jnp.abs(alpha - 2), eps)
        # 2 b/alpha ((z/b + 1)^(alpha/2) - 1) = b log expm1(e)/(e), e = alpha/2 log: a series in e around alpha = 0
        log = jnp.log1p(z / b)
        small = jnp.abs(alpha) < eps**0.25
        safe = jnp.where(small, 1.0, alpha)
        e = jnp.where(small, alpha, 0.0) / 2 * log
        series = b * log * (1 + e / 2 * (1 + e / 3 * (1 + e / 4 * (1 + e / 5))))
        return jnp.where(small, series, 2 * b / safe * _expm1(safe / 2 * log))


@jax.custom_jvp
def _expm1(x: Array) -> Array:
    return jnp.expm1(x)


@_expm1.defjvp
def _expm1_jvp(primals: tuple[Array], tangents: tuple[Array]) -> tuple[Array, Array]:
    # jax's own derivative, expm1(x) + 1, loses the digits of the small weights that outliers get
    return jnp.expm1(primals[0]), jnp.exp(primals[0]) * tangents[0]


def check_loss(label: str, loss: Any) -> None:
    """Raise `JaxbaError` where a loss, called `label` in messages, is none that an adjustment can use.

    Traced values pass, as they do in the constructor of a loss; values put in later are found here, and a shape over 2,
    under which large residuals count more than in least squares.
    """
    if not isinstance(loss, AbstractLoss):
        raise JaxbaError(f"{label} is {loss!r}; give a loss, such as Huber(f_scale=1.0).")
    _check_numbers(label, loss, most_alpha=2.0)


def _check_numbers(label: str, loss: AbstractLoss, *, most_alpha: float) -> None:
    name = type(loss).__name__
    cure = f"give a positive number of sigmas, such as 1 ({_LEAST_SCALE:g} to {_LARGEST_SCALE:g})"
    require_number(f"{label} {name}: f_scale", loss.f_scale, _LEAST_SCALE, _LARGEST_SCALE, cure)
    if isinstance(loss, Barron):
        cure = "give 2 (least squares) or less, down to -inf"
        require_number(f"{label} {name}: alpha", loss.alpha, -np.inf, most_alpha, cure)


LOSSES: dict[str, type[AbstractLoss]] = {
    "linear": Linear,
    "soft_l1": SoftL1,
    "huber": Huber,
    "cauchy": Cauchy,
    "arctan": Arctan,
    "tukey": Tukey,
    "geman_mcclure": GemanMcClure,
    "barron": Barron,
}
"""Losses by the name that the command line takes; the first five are scipy's."""
