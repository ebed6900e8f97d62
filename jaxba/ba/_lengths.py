"""Lengths of steps and what else the solvers measure them by."""

import functools

import jax
import jax.numpy as jnp
from jax import Array
from jaxtyping import Float, PyTree

from jaxba.ba._linearise import Linearisation
from jaxba.ba._rows import rows_of
from jaxba.ba._system import System
from jaxba.ba._unknowns import Step, Unknowns

MIN_DIAGONAL = 1e-12  # of the largest entry of its kind


def sum_all(tree: PyTree) -> Float[Array, ""]:
    """Sum scalars."""
    return functools.reduce(jnp.add, jax.tree.leaves(tree))


def damping_scale(diagonal: Step) -> Step:
    """Return the diagonal of J^T J, kept away from zero relative to its kind."""

    def scale(d: Array) -> Array:
        largest = jnp.max(d, initial=0.0)
        return jnp.maximum(d, jnp.where(largest > 0, MIN_DIAGONAL * largest, 1.0))

    return jax.tree.map(scale, diagonal)


def slope_along(gradient: Step, step: Step) -> Float[Array, ""]:
    """Return the change of the cost along a step, to first order."""
    return sum_all(jax.tree.map(jnp.vdot, gradient, step))


def norm_of(step: Step) -> Float[Array, ""]:
    """Return the length of a step in its own units, metres and radians side by side."""
    return jnp.sqrt(sum_all(jax.tree.map(lambda s: jnp.sum(s**2), step)))


def scaled_norm_of(step: Step, diagonal: Step) -> Float[Array, ""]:
    """Return the length of a step in the units of damping and trust region."""
    scale = damping_scale(diagonal)
    return jnp.sqrt(sum_all(jax.tree.map(lambda s, d: jnp.sum(s**2 * d), step, scale)))


def squared_in_sigmas(model: Linearisation, step: Step) -> Float[Array, ""]:
    """Return the squared length of a step in what each unknown is known to by itself: in sigmas, all others fixed."""
    blocks = (step.poses, model.diagonal.poses), (step.intrinsics, model.diagonal.intrinsics)
    squares = sum_all([jnp.sum(s**2 * d) for s, d in (*blocks, (step.antenna, model.diagonal.antenna))])
    return squares + jnp.einsum("pi,pij,pj->", step.points, model.point_products, step.points)


def all_squared_in_sigmas(system: System, unknowns: Unknowns, model: Linearisation) -> Float[Array, ""]:
    """Return the same of a step as long as the unknowns: a radian, the way from camera to point, all intrinsics.

    `xtol` of it moves what the images see by about `xtol` radian. It depends neither on the origin of the world nor on
    its unit, and a point at infinity adds to it what others do.
    """
    ray = unknowns.points - rows_of(unknowns.poses.center, system.point_image)
    of_points = jnp.sum(ray**2, axis=1) * jnp.trace(model.point_products, axis1=1, axis2=2)
    of_intrinsics = jnp.sum(unknowns.intrinsics**2 * model.diagonal.intrinsics)
    return jnp.sum(of_points) + of_intrinsics + jnp.sum(model.diagonal.poses[:, :3])
