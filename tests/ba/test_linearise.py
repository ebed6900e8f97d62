"""Gradient, diagonal and curvature of the quadratic model equal those of the dense reference, for every robust loss."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from dense_reference import Dense, in_own_order, loss_derivatives, solver_view
from jax import Array
from quick_jit import quick_jit
from small_problems import LOSSES, RADIAL, one_of, small_problem

from jaxba.ba import Problem, Step, Unknowns
from jaxba.ba._linearise import cost, curvature, linearise
from jaxba.ba._system import System
from jaxba.geometry import AbstractLoss, Cauchy, Huber


def random_step(free: Step) -> Step:
    """A step of everything that is free."""
    rng = np.random.default_rng(0)
    return jax.tree.map(lambda mask: rng.normal(size=mask.shape) * np.asarray(mask), free)


def triggs_hessian(dense: Dense, bend: float) -> np.ndarray:
    """J^T H J with H the loss's Hessian by the residual, its eigenvalue along r held above (1 - bend)^2 rho'."""
    total = np.zeros((dense.size, dense.size))
    for residual, jacobian, loss in dense.groups():
        squared = np.sum(residual**2, axis=1)
        _, slope, bent = loss_derivatives(loss, squared)
        unit = residual / np.sqrt(np.where(squared > 0, squared, 1.0))[:, None]
        along = np.maximum(slope + 2 * bent * squared, (1 - bend) ** 2 * slope)
        outer = unit[:, :, None] * unit[:, None]
        hessian = slope[:, None, None] * (np.eye(residual.shape[1]) - outer) + along[:, None, None] * outer
        total += np.einsum("rcn,rcd,rdm->nm", jacobian, hessian, jacobian)
    return total


class Model(NamedTuple):
    """The solver's model at the start, its curvature along a step, and the gradient that jax gives of the cost."""

    gradient: Step
    diagonal: Step
    along: Array
    slope: Step
    cost: Array


@quick_jit
def model_of(system: System, start: Unknowns, step: Step, bend: float) -> Model:
    model = linearise(system, start, bend)
    slope = jax.grad(lambda s: cost(system, start.retract(s)))(jax.tree.map(jnp.zeros_like, step))
    return Model(model.gradient, model.diagonal, curvature(system, model, step), slope, cost(system, start))


def assert_model_is_dense(problem: Problem, loss: AbstractLoss, bend: float) -> None:
    plan, system, start = solver_view(problem, loss)
    dense = Dense(problem, loss)
    step = random_step(system.free)
    gradient, diagonal, along, slope, value = jax.device_get(model_of(system, start, step, bend))
    np.testing.assert_allclose(value, dense.cost(np.zeros(dense.size)), rtol=1e-12)
    expected = dense.square_rooted_jacobian(np.zeros(dense.size)).T @ dense.square_rooted(np.zeros(dense.size))
    hessian = triggs_hessian(dense, bend)

    def flat(step: Step) -> np.ndarray:
        return dense.flat(in_own_order(step, problem, plan))

    # rounding of sums in another order, in units of each unknown's own sigma
    scale = np.sqrt(np.diag(hessian))
    np.testing.assert_allclose(
        flat(gradient) / scale, expected / scale, rtol=0, atol=1e-10 * np.abs(expected / scale).max()
    )
    np.testing.assert_allclose(flat(gradient), flat(slope), rtol=0, atol=1e-9 * np.abs(expected).max())
    np.testing.assert_allclose(flat(diagonal), np.diag(hessian), rtol=1e-9)
    np.testing.assert_allclose(along, flat(step) @ hessian @ flat(step), rtol=1e-10)
    # what is fixed has neither a gradient nor a diagonal
    for leaf, free in zip(jax.tree.leaves((gradient, diagonal)), 2 * jax.tree.leaves(system.free), strict=True):
        assert np.all(np.asarray(leaf)[np.asarray(free) == 0] == 0)


@pytest.mark.parametrize("bend", [0.0, 0.9])
@pytest.mark.parametrize("index", range(len(LOSSES)), ids=lambda i: repr(LOSSES[i]))
def test_model_of_every_loss_is_the_dense_one(index, bend):
    problem = small_problem(RADIAL, lever_arm=True, position_offset=True, prior_loss=Cauchy(3.0), num_outliers=3)
    assert_model_is_dense(problem, one_of(index), bend)


@pytest.mark.parametrize("num_cameras", [2, 6])
def test_model_with_fixed_blocks_is_the_dense_one(num_cameras):
    problem = small_problem(RADIAL, num_images=6, num_cameras=num_cameras, lever_arm=True)
    problem = problem.fix(poses=[0, 3], points=[1, 19], intrinsics=["cx", "k2"])
    problem.free.intrinsics[1, 0] = False
    assert_model_is_dense(problem, Huber(2.0), 0.5)
