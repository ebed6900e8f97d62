"""Derivatives of a solve against a dense Hessian, central differences of solves, and each other."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree
from small_problems import EVERY_CAMERA, RADIAL, small_problem

import jaxba
from jaxba import JaxbaError, Problem
from jaxba.ba._adjoint import _equations, _hold_saddles, _tell_held
from jaxba.ba._factor import factor_reduced, solve_factored
from jaxba.ba._hessian import hessian
from jaxba.ba._linearise import cost, curvature
from jaxba.ba._plan import make_plan
from jaxba.ba._schur import back_substitute, eliminate_points, reduce_vector
from jaxba.ba._system import System, initial_unknowns, make_system
from jaxba.ba._unknowns import Step, Unknowns
from jaxba.geometry import AbstractLoss, Cauchy, Huber

SIMPLE = EVERY_CAMERA[0]
TIGHT = {"ftol": 0.0, "xtol": 1e-13, "gtol": 0.0, "max_nfev": 60}
CASES = {
    "shared camera, every prior": lambda: small_problem(RADIAL, lever_arm=True, prior_loss=Cauchy(2.0)),
    "two cameras, fixed blocks": lambda: small_problem(RADIAL, num_cameras=2).fix(
        poses=[1], points=[2, 3], intrinsics=["k2"]
    ),
    "no intrinsics": lambda: small_problem(EVERY_CAMERA[1]).fix(intrinsics=True),
}


def _optimum(problem: Problem, loss: AbstractLoss) -> Problem:
    solution = jaxba.solve(problem, loss=loss, **{**TIGHT, "max_nfev": 300})
    assert solution.converged or solution.result == "stuck"  # at the last digit
    return solution.apply(solution.report.problem)  # without points seen once


@pytest.mark.parametrize("case", CASES)
def test_second_derivatives_and_their_solve_are_the_dense_ones(case: str):
    problem = _optimum(CASES[case](), Cauchy(3.0))
    plan = make_plan(problem)
    system, unknowns = jax.device_put((make_system(problem, plan, Cauchy(3.0)), initial_unknowns(problem, plan)))
    zero, unflatten = ravel_pytree(jax.tree.map(jnp.zeros_like, system.free))
    free = np.asarray(ravel_pytree(system.free)[0]) > 0
    dense = jax.jit(jax.hessian(lambda step: cost(system, unknowns.retract(unflatten(step)))))(zero)
    dense = np.asarray(dense)[np.ix_(free, free)]
    scale = 1 / np.sqrt(np.diag(dense))
    rng = np.random.default_rng(0)

    equations = jax.jit(lambda s, u: _equations(s, u, True))(system, unknowns)
    for _ in range(3):
        step = np.zeros(free.shape)
        step[free] = rng.normal(size=free.sum()) * scale
        along = float(curvature(system, equations.model, unflatten(jnp.asarray(step))))
        assert along == pytest.approx(step[free] @ dense @ step[free], rel=1e-10)
        solved = np.asarray(ravel_pytree(equations.solve(unflatten(jnp.asarray(step))))[0])[free]
        expected = scale * np.linalg.solve(dense * np.outer(scale, scale), scale * step[free])
        np.testing.assert_allclose(solved / scale, expected / scale, atol=1e-9 * np.abs(expected / scale).max())


def test_gradient_of_the_hessian_is_that_of_the_normal_equations():
    problem = small_problem(RADIAL, lever_arm=True, num_outliers=3, prior_loss=Huber(1.0))
    plan = make_plan(problem)
    system, unknowns = jax.device_put((make_system(problem, plan, Huber(1.5)), initial_unknowns(problem, plan)))
    of_steps = jax.grad(lambda step: cost(system, unknowns.retract(step)))(jax.tree.map(jnp.zeros_like, system.free))
    found = jax.jit(hessian)(system, unknowns).gradient
    for a, b, free in zip(*(jax.tree.leaves(t) for t in (found, of_steps, system.free)), strict=True):
        np.testing.assert_allclose(a, b * free, atol=1e-9 * max(np.abs(b).max(), 1.0))


def _points_moved(problem: Problem, weights: np.ndarray, **options: object):
    def moved(log_scale: jax.Array) -> jax.Array:
        return jnp.sum(weights * jaxba.solve(problem, loss=Cauchy(jnp.exp(log_scale)), **options).points)

    return moved


@pytest.fixture(scope="module")
def block() -> Problem:
    """With two priors, for its programs' size: what each prior adds is held to the dense Hessian and differences."""
    problem = small_problem(SIMPLE, num_outliers=4)
    return eqx.tree_at(lambda p: p.priors, problem, (problem.prior("position"), problem.prior("control")))


@pytest.fixture(scope="module")
def weights(block: Problem) -> np.ndarray:
    return np.random.default_rng(0).normal(size=block.points.shape)


def test_modes_and_transformations_agree(block: Problem, weights: np.ndarray):
    moved = _points_moved(block, weights)
    gradient = float(jax.grad(moved)(0.5))
    assert float(jax.jvp(moved, (0.5,), (1.0,))[1]) == pytest.approx(gradient, rel=1e-9)
    several = jax.jit(jax.vmap(jax.grad(moved)))(jnp.array([0.5, 1.0]))
    np.testing.assert_allclose(several, [gradient, jax.grad(moved)(1.0)], rtol=1e-6)  # other steps to the optimum
    plan = jaxba.make_plan(block)
    of_points = jax.jacrev(lambda s: jaxba.solve(block, loss=Cauchy(jnp.exp(s)), plan=plan).points)(0.5)
    assert float(jnp.sum(weights * of_points)) == pytest.approx(gradient, rel=1e-9)


def test_default_tolerances_suffice(block: Problem, weights: np.ndarray):
    loose = float(jax.grad(_points_moved(block, weights))(0.5))
    tight = float(jax.grad(_points_moved(block, weights, **TIGHT))(0.5))
    assert loose == pytest.approx(tight, rel=1e-5)


def test_second_derivative_is_the_difference_of_gradients(block: Problem, weights: np.ndarray):
    moved, step = _points_moved(block, weights, **TIGHT), 1e-4
    difference = (jax.grad(moved)(0.5 + step) - jax.grad(moved)(0.5 - step)) / (2 * step)
    assert float(jax.grad(jax.grad(moved))(0.5)) == pytest.approx(float(difference), rel=1e-5)


def test_unrolled_derivative_nears_the_implicit_one(block: Problem, weights: np.ndarray):
    exact = float(jax.grad(_points_moved(block, weights))(0.5))
    unrolled = float(jax.grad(_points_moved(block, weights, adjoint="unrolled", **{**TIGHT, "max_nfev": 40}))(0.5))
    assert unrolled == pytest.approx(exact, rel=0.05)


def test_memory_does_not_grow_with_the_steps(block: Problem, weights: np.ndarray):
    def temporary_bytes(max_nfev: int) -> int:
        lowered = jax.jit(jax.grad(_points_moved(block, weights, max_nfev=max_nfev))).lower(0.5)
        compiled = lowered.compile(compiler_options={"xla_backend_optimization_level": 0})  # 1 would take a minute
        return compiled.memory_analysis().temp_size_in_bytes

    assert temporary_bytes(50) == temporary_bytes(5) > 0


def test_cost_and_residuals_have_derivatives(block: Problem):
    def at(std_px: jax.Array) -> tuple[jax.Array, jax.Array]:
        changed = eqx.tree_at(lambda p: p.observations.std_px, block, std_px)
        solution = jaxba.solve(changed, loss=Cauchy(2.0), **TIGHT)
        pose = jax.tree.map(lambda a: a[0], solution.poses)
        camera = jax.tree.map(lambda a: a[0], solution.cameras)
        return solution.final_cost, camera.project(pose.transform(solution.points[3]))

    std, step = np.asarray(block.observations.std_px), 1e-3  # shorter ones drown in the last digits of the optima
    direction = np.random.default_rng(1).normal(size=std.shape)
    found = jax.jvp(at, (std,), (direction,))[1]
    high, low = (jax.jvp(at, (std + s * direction,), (direction,))[0] for s in (step, -step))
    for a, b, c in zip(found, high, low, strict=True):
        np.testing.assert_allclose(a, (np.asarray(b) - np.asarray(c)) / (2 * step), rtol=2e-4)


def test_a_point_on_a_saddle_is_held_and_told():
    problem = _optimum(small_problem(SIMPLE), Cauchy(3.0))
    plan = make_plan(problem.fix(points=[7]))  # one plan for both
    point = int(np.argsort(plan.point_order)[7])
    unknowns = initial_unknowns(problem, plan)
    free, fixed = (make_system(p, plan, Cauchy(3.0)) for p in (problem, problem.fix(points=[7])))
    rhs = jax.tree.map(np.ones_like, fixed.free)
    rhs = jax.tree.map(jnp.multiply, rhs, fixed.free)

    @jax.jit
    def solutions(free: System, fixed: System, unknowns: Unknowns) -> tuple[Step, Step, Step]:
        model = hessian(free, unknowns)
        bent = eqx.tree_at(lambda m: m.point_products, model, model.point_products.at[point, 2, 2].multiply(-1.0))
        system, held = _hold_saddles(free, bent)
        reduced = eliminate_points(system, held, jax.tree.map(jnp.zeros_like, rhs))
        vector = solve_factored(system, reduced, factor_reduced(system, reduced), reduce_vector(system, reduced, rhs))
        return back_substitute(system, reduced, rhs, vector), _equations(fixed, unknowns, True).solve(rhs), system.free

    found, expected, left = solutions(free, fixed, unknowns)
    for a, b in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
        np.testing.assert_allclose(a, b, atol=1e-9 * np.abs(b).max())
    with pytest.warns(RuntimeWarning, match=r"1 of 20 points rest on a saddle .*solve_and_reject"):
        _tell_held(jnp.sum(free.free.points[:, 0]), jnp.sum(left.points[:, 0]))


def test_a_free_gauge_is_solved_where_no_derivative_is_asked_for(block: Problem):
    free = eqx.tree_at(lambda p: p.priors, block, ())
    cost_of = jax.jit(lambda s: jaxba.solve(free, loss=Cauchy(s)).final_cost)
    assert float(cost_of(2.0)) == pytest.approx(float(jaxba.solve(free, loss=Cauchy(2.0)).final_cost), rel=1e-6)


def test_a_free_gauge_is_refused_with_the_cure(block: Problem):
    free = eqx.tree_at(lambda p: p.priors, block, ())
    with pytest.raises(JaxbaError, match=r"Derivatives: problem has no gauge, 7 directions .* Add a position prior"):
        jax.grad(lambda s: jaxba.solve(free, loss=Cauchy(s)).final_cost)(1.0)
    pixels = np.asarray(free.observations.xy_px)
    with pytest.raises(JaxbaError, match=r"no isolated minimum.*jaxba\.free_gauge"):
        jax.grad(lambda xy: jaxba.solve(eqx.tree_at(lambda p: p.observations.xy_px, free, xy)).points[0, 0])(pixels)


def test_where_the_solver_has_not_converged_is_refused(block: Problem, weights: np.ndarray):
    with pytest.raises(JaxbaError, match="stopped before it converged"):
        jax.grad(_points_moved(block, weights, max_nfev=1))(-3.0)


def test_traced_indices_need_a_plan(block: Problem):
    with pytest.raises(JaxbaError, match=r"plan=jaxba\.make_plan\(problem\), made outside"):
        jax.jit(lambda p: jaxba.solve(p).points)(block)


def test_every_input_has_the_derivative_of_central_differences():
    loss = jaxba.Barron(0.5, 2.0)
    problem = small_problem(SIMPLE, lever_arm=True, num_outliers=3, prior_loss=Cauchy(3.0))
    at = jaxba.solve(problem, loss=loss)
    free = float(np.asarray(at.cameras.cx)[0])
    problem = eqx.tree_at(lambda p: p.cameras.cx, problem, np.array([free - 6.0]))
    problem = problem.bound(cx=(free - 9.0, free - 3.0)).fix(points=[4], intrinsics=["cy"])
    checked = jaxba.check_gradients(problem, loss=loss)
    assert checked.passed, checked.table()
    names = {row.name for row in checked.rows}
    assert {
        "pixels",
        "pixel sigmas",
        "loss scale",
        "loss shape",
        "position xyz",
        "attitude std_rad",
        "lever_arm std_m",
        "position loss scale",
        "active upper bounds",
        "fixed cy",
    } <= names
    # a wrong derivative does not pass: J^T J in place of the second derivatives is off by percents
    assert checked.rows[0].gauss_newton_error > 1e-3
    wrong = [dataclasses.replace(row, error=row.gauss_newton_error) for row in checked.rows]
    refused = jaxba.GradientCheck(tuple(wrong), checked.tolerance)
    assert not refused.passed and "over 1e-05" in refused.table()
