"""The compiled work of a step in parts: up, the joint solve, down, and what the step is judged by.

Parts go up side by side: each makes its equations and eliminates its points. What they hand on adds up to the reduced
system of the block, which is solved once; each then solves for its points and refines them. The steps are those of the
block in one piece, to rounding.
"""

import functools
from collections.abc import Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float, Int

from jaxba.ba._factor import solve_reduced
from jaxba.ba._lengths import damping_scale, sum_all
from jaxba.ba._linearise import Linearisation, linearise
from jaxba.ba._schur import Eliminated, Reduced, ReducedVector, diagonal_matrix, from_reduced, one_for_fixed, to_reduced
from jaxba.ba._solvers import (
    AbstractSchurSolver,
    SchurLevenbergMarquardt,
    State,
    Tried,
    projected_gradient_norm,
    step_bounds,
    take_numbers,
    within_bounds,
)
from jaxba.ba._system import System
from jaxba.ba._unknowns import Step, Unknowns
from jaxba.ba.tiles._programs import Handed, Sums, hand_over


class JointStep(NamedTuple):
    """The solution of images and border, and the same as a step within the bounds, whose points are empty.

    - `gradient_norm`: see `Tried`. `squared_norm`: of the step.
    """

    images: Float[Array, "images block"]
    border: Float[Array, " border"]
    step: Step
    gradient_norm: Float[Array, ""]
    squared_norm: Float[Array, ""]
    linear_iterations: Int[Array, ""]


def go_up(
    system: System, unknowns: Unknowns, damping: Float[Array, ""], bend: Float[Array, ""]
) -> tuple[Linearisation, Handed]:
    """Return a part's equations and what it hands on."""
    model = linearise(system, unknowns, bend)
    return model, hand_over(system, model, damping)


def solve_joint(joint: System, handed: Sequence[Handed], unknowns: Unknowns, damping: Float[Array, ""]) -> JointStep:
    """Return the step of images and border from what all parts hand on.

    - `unknowns`: without points.
    """

    def summed(name: str) -> Any:
        return jax.tree.map(lambda *of_parts: functools.reduce(jnp.add, of_parts), *(getattr(h, name) for h in handed))

    squares, gradient, tail, corner = (summed(name) for name in ("squares", "gradient", "tail", "corner"))
    added = to_reduced(joint, one_for_fixed(joint, jax.tree.map(lambda d: damping * d, damping_scale(squares))))
    size, dtype = joint.shape.border, tail.dtype
    nothing = Eliminated(
        jnp.zeros((0, 6), dtype), jnp.zeros((0, 3, joint.shape.block), dtype), jnp.zeros((0, 3, 0), dtype)
    )
    reduced = Reduced(
        diagonal=summed("diagonal") + diagonal_matrix(added.images),
        off_diagonal=jnp.concatenate([h.off_diagonal for h in handed]),
        border=jnp.swapaxes(tail[:, :size], 1, 2),
        corner=corner[:size, :size] + diagonal_matrix(added.border),
        points=nothing,
    )
    rhs = ReducedVector(tail[:, size], corner[size, :size])
    solved = solve_reduced(joint, reduced, rhs, *step_bounds(joint, unknowns))
    step = within_bounds(joint, unknowns, from_reduced(joint, solved.vector, gradient))
    steepest = functools.reduce(jnp.maximum, [h.steepest for h in handed])
    return JointStep(
        solved.vector.images,
        solved.vector.border,
        step,
        jnp.maximum(projected_gradient_norm(joint.lower, joint.upper, unknowns.intrinsics, gradient), steepest),
        sum_all(jax.tree.map(lambda s: jnp.sum(s**2), step)),
        solved.iterations,
    )


_REST = take_numbers(SchurLevenbergMarquardt(), np.float64)[1]


def judge(
    numbers: AbstractSchurSolver, state: State, joint: JointStep, sums: Sequence[Sums], damping: Float[Array, ""]
) -> State:
    """Return the state after a step was tried, as the solver judges it in one piece.

    - `numbers`: of `SchurLevenbergMarquardt`, see `take_numbers`. `sums`: of all parts.
    """
    total = Sums(*(functools.reduce(jnp.add, of_parts) for of_parts in zip(*sums, strict=True)))
    tried = Tried(
        cost=jnp.asarray(total.cost),
        promised=jnp.asarray(-total.slope - total.curvature / 2),
        gradient_norm=joint.gradient_norm,
        shortened=1 + damping,
        in_sigmas=jnp.sqrt(total.in_sigmas),
        all_in_sigmas=jnp.sqrt(total.all_in_sigmas),
        norm=jnp.sqrt(joint.squared_norm + total.of_points),
        scaled_norm=jnp.zeros_like(total.cost),
        linear_iterations=joint.linear_iterations,
        points_held=jnp.asarray(total.points_held),
    )
    return eqx.combine(numbers, _REST).judge(state, tried)
