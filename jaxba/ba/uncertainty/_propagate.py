"""Propagation of covariances: any function of the adjusted unknowns, to first order (the delta method).

With g the derivatives of the functions by tangent steps of all unknowns and N = J^T J,

    Cov(f) = g^T N^-1 g

exactly joint, whatever the functions share: a distance between two points, an angle, a volume, a camera's view. The
derivatives are jax's, the product is that of `tiles/_functionals.py`: N is factored once, and its inverse is nowhere.
"""

import os
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float

from jaxba._errors import JaxbaError
from jaxba.ba._problem import Problem
from jaxba.ba._system import own_unknowns
from jaxba.ba._unknowns import Step, Unknowns
from jaxba.ba.checks import Dropped, prepare, require_gauge
from jaxba.ba.tiles._dense import NotPositive
from jaxba.ba.tiles._functionals import joint_covariance
from jaxba.ba.tiles._opened import TILE_OBSERVATIONS, opened
from jaxba.geometry import AbstractLoss, Linear, check_loss


class Propagated(NamedTuple):
    """Values of functions of the unknowns, and how well they are known.

    - `covariance`: joint, a priori; as in `Covariance`. `dropped`: what took no part.
    """

    value: Float[np.ndarray, " m"]
    covariance: Float[np.ndarray, "m m"]
    dropped: Dropped

    @property
    def std(self) -> Float[np.ndarray, " m"]:
        """The sigma of each."""
        return np.sqrt(np.maximum(np.diagonal(self.covariance), 0.0))


def propagate(
    function: Callable[[Problem], Any],
    problem: Problem,
    *,
    loss: AbstractLoss | None = None,
    max_memory: float | str | None = None,
    max_observations: float = TILE_OBSERVATIONS,
    folder: str | os.PathLike[str] | None = None,
    workers: int | None = None,
) -> Propagated:
    """Return the values of a function at the problem's present unknowns, and their joint covariance.

    - `function`: of a problem, whose poses, cameras, lever arm, position offset and points it may use; returns a number
      or an array, which is taken apart into m numbers.
    - The rest: as of `covariance`, whose errors it raises.

    >>> import jaxba, jax.numpy as jnp
    >>> problem = jaxba.synthetic.uav_block(8).problem
    >>> found = jaxba.propagate(lambda p: jnp.linalg.norm(p.points[1] - p.points[0]), problem)
    >>> found.value.shape, found.std.shape
    ((1,), (1,))
    """
    loss = Linear() if loss is None else loss
    check_loss("propagate: loss", loss)
    prepared = prepare(problem)
    problem = prepared.problem
    require_gauge(problem, "Propagation")
    unknowns = own_unknowns(problem)
    with jax.enable_x64(True):
        value, gradients = _gradients(function, problem, unknowns)
    room: dict[str, Any] = {
        "max_memory": max_memory,
        "max_observations": max_observations,
        "folder": folder,
        "workers": workers,
    }
    with opened("propagate", problem, loss, columns=len(value), **room) as engine:
        try:
            return Propagated(value, joint_covariance(engine, unknowns, gradients), prepared.dropped)
        except NotPositive as error:
            raise JaxbaError(
                "Propagation: the measurements do not determine all unknowns; jaxba.covariance(problem) names one."
            ) from error


def _gradients(
    function: Callable[[Problem], Any], problem: Problem, unknowns: Unknowns
) -> tuple[Float[np.ndarray, " m"], list[Step]]:
    """Return the values and their derivatives by a tangent step of what is free."""
    free = problem.free
    masks = Step(
        np.asarray(free.poses, float)[:, None] * np.ones(6),
        np.asarray(free.intrinsics, float),
        problem.free_antenna.astype(float),
        np.asarray(free.points, float)[:, None] * np.ones(3),
    )
    model = type(problem.cameras)

    def values(step: Step) -> Array:
        moved = unknowns.retract(jax.tree.map(jnp.multiply, step, masks))
        parts = (
            moved.poses, model.from_parameters(moved.intrinsics), moved.points, moved.lever_arm, moved.position_offset,
        )  # fmt: skip
        at = eqx.tree_at(lambda p: (p.poses, p.cameras, p.points, p.lever_arm, p.position_offset), problem, parts)
        return jnp.ravel(jnp.asarray(function(at)))

    zero = jax.tree.map(jnp.zeros_like, masks)
    value, pull = jax.vjp(values, zero)
    if not len(value):
        raise JaxbaError("propagate: the function returns no number; return one or an array of some.")
    gradients: list[Step] = [jax.tree.map(np.asarray, pull(row)[0]) for row in jnp.eye(len(value))]
    found = np.asarray(value)
    if not all(np.isfinite(leaf).all() for leaf in (found, *jax.tree.leaves(gradients))):
        raise JaxbaError("propagate: the function's value or its derivatives are not finite at the adjusted unknowns.")
    return found, gradients
