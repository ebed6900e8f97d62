"""Each way to solve the reduced system equals numpy for many right-hand sides, and bounds equal scipy's."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.optimize
from dense_reference import solver_view
from jax import Array
from quick_jit import quick_jit
from small_problems import EVERY_CAMERA, small_problem

from jaxba.ba import Unknowns
from jaxba.ba._factor import box_minimum, factor_solve, factorise
from jaxba.ba._linearise import linearise
from jaxba.ba._schur import Reduced, eliminate_points, one_for_fixed
from jaxba.ba._system import System


@pytest.mark.parametrize("linear_solver", ["dense", "banded", "cg"])
def test_many_right_hand_sides_equal_numpy(linear_solver):
    problem = small_problem(EVERY_CAMERA[1], num_images=26, num_points=60, seen_by=3)
    _, system, start = solver_view(problem, linear_solver=linear_solver)
    shape = system.shape
    rhs = np.random.default_rng(0).normal(size=(shape.num_images, shape.block, 7))

    @quick_jit
    def solved(system: System, start: Unknowns, rhs: Array) -> tuple[Reduced, Array, Array]:
        model = linearise(system, start)
        damping = jax.tree.map(lambda d: jnp.where(d > 0, 1e-4 * d, 1.0), model.diagonal)
        reduced = eliminate_points(system, model, one_for_fixed(system, damping))
        return reduced, *factor_solve(system, reduced, factorise(system, reduced), rhs)

    reduced, solution, iterations = jax.device_get(solved(system, start, rhs))
    blocks = np.zeros((shape.num_images, shape.block, shape.num_images, shape.block))
    for i, block in enumerate(np.asarray(reduced.diagonal)):
        blocks[i, :, i] = block
    for i, j, block in zip(system.block_row, system.block_column, np.asarray(reduced.off_diagonal), strict=True):
        blocks[i, :, j] += block
        blocks[j, :, i] += block.T
    size = shape.num_images * shape.block
    matrix = blocks.reshape(size, size)
    scale = np.sqrt(np.diag(matrix))
    np.testing.assert_allclose(matrix, matrix.T, rtol=0, atol=1e-12 * np.outer(scale, scale).max())
    expected = np.linalg.solve(matrix / scale[:, None] / scale, rhs.reshape(size, 7) / scale[:, None])
    found = np.asarray(solution).reshape(size, 7) * scale[:, None]
    # conjugate gradients stop when the preconditioned residual has fallen to 1e-8
    tolerance = 1e-6 if linear_solver == "cg" else 1e-11
    error = np.linalg.norm(found - expected, axis=0)
    assert np.all(error < tolerance * np.linalg.norm(expected, axis=0))
    assert (iterations > 0) == (linear_solver == "cg")


box_minima = quick_jit(jax.vmap(box_minimum))
minimum_without_box = quick_jit(lambda matrix, rhs: box_minimum(matrix, rhs, None, None))


@pytest.mark.parametrize("condition", [1e1, 1e4, 1e8])
@pytest.mark.parametrize("size", [1, 3, 10])
def test_box_minimum_equals_scipy(size, condition):
    rng = np.random.default_rng(size)
    count = 60
    roots, targets, lower, upper = [], [], [], []
    for _ in range(count):
        left, right = (np.linalg.qr(rng.normal(size=(size, size)))[0] for _ in range(2))
        roots.append(left * np.geomspace(1, condition**-0.5, size) @ right * 10.0 ** rng.uniform(-2, 2, size))
        free = rng.normal(size=size)
        targets.append(roots[-1] @ free)
        low, high = np.sort(free + rng.normal(size=(2, size)), axis=0)
        lower.append(np.where(rng.uniform(size=size) < 0.3, -np.inf, low))
        upper.append(np.where(rng.uniform(size=size) < 0.3, np.inf, high))
    root, target, lower, upper = (np.array(a) for a in (roots, targets, lower, upper))
    matrix, rhs = np.swapaxes(root, 1, 2) @ root, np.einsum("nij,ni->nj", root, target)
    found = np.asarray(box_minima(matrix, rhs, lower, upper))
    assert np.all((found >= lower) & (found <= upper))
    reached = np.linalg.norm(np.einsum("nij,nj->ni", root, found) - target, axis=1) ** 2
    best = [
        2 * scipy.optimize.lsq_linear(a, b, (low, high), method="bvls", tol=1e-15).cost
        for a, b, low, high in zip(root, target, lower, upper, strict=True)
    ]
    # rounding of the squared matrix's entries, relative to |target|^2
    size_of_terms = np.linalg.norm(target, axis=1) ** 2
    np.testing.assert_array_less(reached - best, 1e-9 * size_of_terms)
    unbounded = minimum_without_box(matrix[0], rhs[0])
    np.testing.assert_allclose(matrix[0] @ np.asarray(unbounded), rhs[0], rtol=0, atol=1e-9 * np.abs(rhs[0]).max())
