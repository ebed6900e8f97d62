"""One damped step, by elimination of the points and each way to solve the reduced system, equals the dense solution."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from dense_reference import Dense, in_own_order, solver_view
from small_problems import EVERY_CAMERA, small_problem

from jaxba.ba import Problem, Step, Unknowns
from jaxba.ba._factor import solve_reduced
from jaxba.ba._linearise import linearise
from jaxba.ba._schur import back_substitute, eliminate_points, reduce_vector
from jaxba.ba._system import System
from jaxba.geometry import Pinhole, Radial, SimpleRadial

PINHOLE = next(camera for camera in EVERY_CAMERA if isinstance(camera, Pinhole))
SIMPLE_RADIAL = next(camera for camera in EVERY_CAMERA if isinstance(camera, SimpleRadial))
RADIAL = next(camera for camera in EVERY_CAMERA if isinstance(camera, Radial))


def partly_fixed(problem: Problem) -> Problem:
    problem = problem.fix(poses=[1], points=[0, 5], intrinsics=["cy"])
    problem.free.intrinsics[0, 0] = False  # one camera's focal length
    return problem


CASES: dict[str, tuple[Callable[[], Problem], str]] = {
    "shared-dense": (lambda: small_problem(RADIAL, lever_arm=True), "dense"),
    "shared-banded": (lambda: small_problem(RADIAL, num_images=26, num_points=60, seen_by=3), "banded"),
    "shared-cg": (lambda: small_problem(RADIAL, num_images=11, lever_arm=True), "cg"),
    "two-dense": (lambda: partly_fixed(small_problem(RADIAL, num_cameras=2, lever_arm=True)), "dense"),
    "two-banded": (lambda: partly_fixed(small_problem(RADIAL, num_images=9, num_cameras=2)), "banded"),
    "own-dense": (lambda: partly_fixed(small_problem(PINHOLE, num_cameras=5)), "dense"),
    "own-banded": (
        lambda: small_problem(SIMPLE_RADIAL, num_images=27, num_cameras=27, num_points=60, seen_by=3, lever_arm=True),
        "banded",
    ),
    "own-cg": (lambda: partly_fixed(small_problem(PINHOLE, num_images=7, num_cameras=7)), "cg"),
    "poses-alone": (lambda: small_problem(RADIAL).fix(points=True, intrinsics=True), "dense"),
    "points-alone": (lambda: small_problem(RADIAL).fix(poses=True, intrinsics=True), "dense"),
}


@pytest.mark.parametrize("case", CASES)
def test_damped_step_equals_the_dense_solution(case):
    make, linear_solver = CASES[case]
    problem = make()
    plan, system, start = solver_view(problem, linear_solver=linear_solver)
    assert plan.shape.linear_solver == linear_solver
    assert plan.shape.own_cameras == case.startswith("own")
    rng = np.random.default_rng(0)
    relative = jax.tree.map(lambda leaf: jnp.asarray(rng.uniform(1e-4, 1e-3, leaf.shape)), system.free)

    @jax.jit
    def damped(system: System, start: Unknowns) -> tuple[Step, Step]:
        model = linearise(system, start)
        damping = jax.tree.map(lambda d, r: jnp.where(d > 0, r * d, 1.0), model.diagonal, relative)
        reduced = eliminate_points(system, model, damping)
        rhs = jax.tree.map(jnp.negative, model.gradient)
        solved = solve_reduced(system, reduced, reduce_vector(system, reduced, rhs))
        return back_substitute(system, reduced, rhs, solved.vector), damping

    step, damping = damped(system, start)
    dense = Dense(problem)
    residual = np.concatenate([group.residual.ravel() for group in dense.groups()])
    jacobian = np.concatenate([group.jacobian.reshape(-1, dense.size) for group in dense.groups()])
    hessian = jacobian.T @ jacobian + np.diag(dense.flat(in_own_order(damping, problem, plan)))
    scale = np.sqrt(np.diag(hessian))
    expected = np.linalg.solve(hessian / scale[:, None] / scale, -jacobian.T @ residual / scale)
    found = dense.flat(in_own_order(step, problem, plan)) * scale
    # damping of 1e-4 bounds the condition: rounding stays below 1e-10; conjugate gradients stop at 1e-8 of the start
    tolerance = 1e-6 if linear_solver == "cg" else 1e-10
    assert np.linalg.norm(found - expected) < tolerance * np.linalg.norm(expected)
    for leaf, free in zip(jax.tree.leaves(step), jax.tree.leaves(system.free), strict=True):
        assert np.all(np.asarray(leaf)[np.asarray(free) == 0] == 0)
