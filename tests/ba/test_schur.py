"""One damped step, by elimination of the points and each way to solve the reduced system, equals the dense solution."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from dense_reference import Dense, in_own_order, solver_view
from quick_jit import quick_jit
from small_problems import EVERY_CAMERA, RADIAL, small_problem

from jaxba.ba import Problem, Step, Unknowns
from jaxba.ba._factor import solve_reduced
from jaxba.ba._linearise import linearise
from jaxba.ba._schur import back_substitute, eliminate_points, one_for_fixed, reduce_vector
from jaxba.ba._system import System
from jaxba.geometry import SimpleRadial

SIMPLE_RADIAL = next(camera for camera in EVERY_CAMERA if isinstance(camera, SimpleRadial))


def partly_fixed(problem: Problem) -> Problem:
    problem = problem.fix(poses=[1], points=[0, 5], intrinsics=["cy"])
    problem.free.intrinsics[0, 0] = False  # one camera's focal length
    return problem


def strip(**options: Any) -> Problem:
    return small_problem(
        RADIAL, num_images=26, num_points=60, seen_by=3, lever_arm=True, position_offset=True, **options
    )


def own_cameras() -> Problem:
    return small_problem(SIMPLE_RADIAL, num_images=27, num_cameras=27, num_points=60, seen_by=3, lever_arm=True)


# problems of one size share the dense reference's program
CASES: dict[str, tuple[Callable[[], Problem], str]] = {
    "shared-dense": (strip, "dense"),
    "shared-banded": (strip, "banded"),
    "shared-cg": (strip, "cg"),
    "two-dense": (lambda: partly_fixed(strip(num_cameras=2)), "dense"),
    "two-banded": (lambda: partly_fixed(strip(num_cameras=2)), "banded"),
    "own-dense": (lambda: partly_fixed(own_cameras()), "dense"),
    "own-banded": (own_cameras, "banded"),
    "own-cg": (lambda: partly_fixed(own_cameras()), "cg"),
    "poses-alone": (lambda: strip().fix(points=True, intrinsics=True), "dense"),
    "points-alone": (lambda: strip().fix(poses=True, intrinsics=True), "dense"),
}


@quick_jit
def damped_step(system: System, start: Unknowns, relative: Step) -> tuple[Step, Step]:
    model = linearise(system, start)
    damping = jax.tree.map(lambda d, r: jnp.where(d > 0, r * d, 1.0), model.diagonal, relative)
    reduced = eliminate_points(system, model, one_for_fixed(system, damping))
    rhs = jax.tree.map(jnp.negative, model.gradient)
    solved = solve_reduced(system, reduced, reduce_vector(system, reduced.points, rhs))
    return back_substitute(system, reduced.points, rhs, solved.vector), damping


@pytest.mark.parametrize("case", CASES)
def test_damped_step_equals_the_dense_solution(case):
    make, linear_solver = CASES[case]
    problem = make()
    plan, system, start = solver_view(problem, linear_solver=linear_solver)
    assert plan.shape.linear_solver == linear_solver
    assert plan.shape.own_cameras == case.startswith("own")
    rng = np.random.default_rng(0)
    relative = jax.tree.map(lambda leaf: rng.uniform(1e-4, 1e-3, leaf.shape), system.free)
    step, damping = jax.device_get(damped_step(system, start, relative))
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
