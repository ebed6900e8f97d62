"""Derivatives of a solve against a dense Hessian, central differences of solves, and each other."""

import dataclasses
import re
from collections import Counter
from unittest import mock

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree
from quick_jit import quick_jit
from small_problems import EVERY_CAMERA, RADIAL, small_problem, with_bars

import jaxba
from jaxba import JaxbaError, Problem
from jaxba.ba._adjoint import _equations, hold_saddles, tell_held
from jaxba.ba._factor import factor_reduced, solve_factored
from jaxba.ba._hessian import hessian
from jaxba.ba._linearise import cost, curvature
from jaxba.ba._plan import make_plan
from jaxba.ba._schur import back_substitute, eliminate_points, one_for_fixed, reduce_vector
from jaxba.ba._system import System, initial_unknowns, make_system
from jaxba.ba._unknowns import Step, Unknowns
from jaxba.geometry import Cauchy

SIMPLE = EVERY_CAMERA[0]
TIGHT = {"ftol": 0.0, "xtol": 1e-11, "gtol": 0.0, "max_nfev": 60}
# at the truth, where the second derivatives are positive definite and the gradient is not zero
CASES = {
    "shared camera, every prior": lambda: with_bars(
        small_problem(RADIAL, lever_arm=True, position_offset=True, prior_loss=Cauchy(2.0), at_truth=True)
    ),
    "two cameras, fixed blocks": lambda: small_problem(RADIAL, num_cameras=2, at_truth=True, seed=2).fix(
        poses=[1], points=[2, 3], intrinsics=["k2"]
    ),
    "no intrinsics": lambda: small_problem(EVERY_CAMERA[1], at_truth=True).fix(intrinsics=True),
}


@quick_jit
def _second_derivatives(system: System, unknowns: Unknowns, steps: jax.Array) -> tuple[jax.Array, ...]:
    """Return jax's own Hessian and gradient of the cost; then ours: the gradient, and of each step s^T H s, H^-1 s."""
    zero, unflatten = ravel_pytree(jax.tree.map(jnp.zeros_like, system.free))

    def cost_after(step: jax.Array) -> jax.Array:
        return cost(system, unknowns.retract(unflatten(step)))

    equations = _equations(system, unknowns, True)

    def of_step(step: jax.Array) -> tuple[jax.Array, jax.Array]:
        along = curvature(system, equations.model, unflatten(step))
        return along, ravel_pytree(equations.solve(unflatten(step)))[0]

    def of_unit(unit: jax.Array) -> tuple[jax.Array, jax.Array]:
        return jax.jvp(jax.grad(cost_after), (zero,), (unit,))

    slopes, dense = jax.lax.map(of_unit, jnp.eye(len(zero)))  # one derivative is traced, not one of each kind
    return dense, slopes[0], ravel_pytree(equations.model.gradient)[0], *jax.lax.map(of_step, steps)


@pytest.mark.parametrize("case", CASES)
def test_second_derivatives_and_their_solve_are_the_dense_ones(case: str):
    problem = CASES[case]()
    plan = make_plan(problem)
    system, unknowns = make_system(problem, plan, Cauchy(3.0)), initial_unknowns(problem, plan)
    free = np.concatenate([leaf.ravel() for leaf in jax.tree.leaves(system.free)]) > 0
    steps = np.random.default_rng(0).normal(size=(3, len(free))) * free
    dense, slope, gradient, along, solved = jax.device_get(_second_derivatives(system, unknowns, steps))
    assert np.all(gradient[~free] == 0)
    dense, slope = dense[np.ix_(free, free)], slope[free]
    scale = 1 / np.sqrt(np.diag(dense))
    np.testing.assert_allclose(gradient[free] * scale, slope * scale, atol=1e-9 * np.abs(slope * scale).max())
    for step, curved, moved in zip(steps[:, free], along, solved[:, free], strict=True):
        # 1e-10 of the sum of the terms' sizes: rounding of sums in another order
        assert curved == pytest.approx(step @ dense @ step, abs=1e-10 * np.abs(step) @ np.abs(dense) @ np.abs(step))
        expected = scale * np.linalg.solve(dense * np.outer(scale, scale), scale * step)
        np.testing.assert_allclose(moved / scale, expected / scale, atol=1e-9 * np.abs(expected / scale).max())


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


@pytest.fixture(scope="module")
def gradient(block: Problem, weights: np.ndarray) -> float:
    """The derivative of `_points_moved` at 0.5; nothing calls back from a program, which jax would not keep on disk."""
    with mock.patch.object(eqx, "error_if") as error_if, mock.patch.object(jax.debug, "callback") as callback:
        found = float(jax.grad(_points_moved(block, weights, **TIGHT))(0.5))
    assert not error_if.called and not callback.called
    return found


def test_modes_and_transformations_agree(block: Problem, weights: np.ndarray, gradient: float):
    moved = _points_moved(block, weights, **TIGHT)
    assert float(jax.jvp(moved, (0.5,), (1.0,))[1]) == pytest.approx(gradient, rel=1e-9)
    plan = jaxba.make_plan(block)

    def points(log_scale: jax.Array) -> jax.Array:
        return jaxba.solve(block, loss=Cauchy(jnp.exp(log_scale)), plan=plan, **TIGHT).points

    of_points = np.asarray(quick_jit(jax.vmap(jax.jacrev(points)))(np.array([0.5, 1.0])))
    expected = [gradient, float(jax.grad(moved)(1.0))]
    np.testing.assert_allclose(np.sum(weights * of_points, axis=(1, 2)), expected, rtol=1e-6)  # other steps to there


def test_default_tolerances_suffice(block: Problem, weights: np.ndarray, gradient: float):
    assert float(jax.grad(_points_moved(block, weights))(0.5)) == pytest.approx(gradient, rel=1e-5)


def test_second_derivative_is_the_difference_of_gradients(block: Problem, weights: np.ndarray):
    moved, step = _points_moved(block, weights, **TIGHT), 1e-4
    difference = (jax.grad(moved)(0.5 + step) - jax.grad(moved)(0.5 - step)) / (2 * step)
    assert float(jax.grad(jax.grad(moved))(0.5)) == pytest.approx(float(difference), rel=1e-5)


def test_unrolled_derivative_nears_the_implicit_one(block: Problem, weights: np.ndarray, gradient: float):
    moved = _points_moved(block, weights, adjoint="unrolled", **{**TIGHT, "max_nfev": 40})
    assert float(quick_jit(jax.grad(moved))(0.5)) == pytest.approx(gradient, rel=0.05)


def test_memory_does_not_grow_with_the_steps(block: Problem, weights: np.ndarray):
    def shapes(max_nfev: int) -> Counter[str]:
        """Types of everything that the derivative's program computes, such as f64[5,6]."""
        moved = _points_moved(block, weights, max_nfev=max_nfev)
        return Counter(re.findall(r"\b[a-z]+\d*\[[\d,]*\]", str(jax.make_jaxpr(jax.grad(moved))(0.5))))

    few = shapes(5)
    assert few[f"f64[{jaxba.make_plan(block).shape.num_points},3]"] > 0  # the padded points
    assert shapes(50) == few


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
    problem = small_problem(SIMPLE, at_truth=True)
    plan = make_plan(problem.fix(points=[7]))  # one plan for both
    point = int(np.argsort(plan.point_order)[7])
    unknowns = initial_unknowns(problem, plan)
    free, fixed = (make_system(p, plan, Cauchy(3.0)) for p in (problem, problem.fix(points=[7])))

    @quick_jit
    def solutions(free: System, fixed: System, unknowns: Unknowns) -> tuple[Step, Step, Step]:
        rhs = fixed.free  # a one for everything that is free
        model = hessian(free, unknowns)
        bent = eqx.tree_at(lambda m: m.point_products, model, model.point_products.at[point, 2, 2].multiply(-1.0))
        system, held = hold_saddles(free, bent)
        reduced = eliminate_points(system, held, one_for_fixed(system, jax.tree.map(jnp.zeros_like, rhs)))
        vector = solve_factored(
            system, reduced, factor_reduced(system, reduced), reduce_vector(system, reduced.points, rhs)
        )
        return (
            back_substitute(system, reduced.points, rhs, vector),
            _equations(fixed, unknowns, True).solve(rhs),
            system.free,
        )

    found, expected, left = jax.device_get(solutions(free, fixed, unknowns))
    for a, b in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
        np.testing.assert_allclose(a, b, atol=1e-9 * np.abs(b).max())
    with pytest.warns(RuntimeWarning, match=r"1 of 20 points rest on a saddle .*solve_and_reject"):
        tell_held(jnp.asarray(free.free.points[:, 0].sum()), jnp.asarray(left.points[:, 0].sum()))


@pytest.fixture(scope="module")
def free_block(block: Problem) -> Problem:
    """Priors whose sigmas are infinite fix nothing; the programs are those of the block."""
    return eqx.tree_at(
        lambda p: [q.std_m for q in p.priors], block, [np.full_like(q.std_m, np.inf) for q in block.priors]
    )


def test_a_free_gauge_is_solved_where_no_derivative_is_asked_for(free_block: Problem):
    assert jaxba.solve(free_block, loss=Cauchy(2.0), **TIGHT).final_cost > 0
    jax.eval_shape(lambda s: jaxba.solve(free_block, loss=Cauchy(s), **TIGHT).final_cost, 2.0)  # inside jit as well


def test_a_free_gauge_is_refused_with_the_cure(free_block: Problem):
    with pytest.raises(JaxbaError, match=r"Derivatives: problem has no gauge, 7 directions .* Add a position prior"):
        jax.grad(lambda s: jaxba.solve(free_block, loss=Cauchy(s), **TIGHT).final_cost)(1.0)

    def first_point(xy_px: jax.Array) -> jax.Array:  # the problem's values are traced: only the solve can tell
        changed = eqx.tree_at(lambda p: p.observations.xy_px, free_block, xy_px)
        return jaxba.solve(changed, loss=Cauchy(2.0), **TIGHT).points[0, 0]

    with pytest.raises(JaxbaError, match=r"no isolated minimum.*jaxba\.free_gauge"):
        jax.grad(first_point)(np.asarray(free_block.observations.xy_px))


def test_where_the_solver_has_not_converged_is_refused(block: Problem, weights: np.ndarray):
    with pytest.raises(JaxbaError, match="stopped before it converged"):
        jax.grad(_points_moved(block, weights, **{**TIGHT, "max_nfev": 1}))(-3.0)


def test_traced_indices_need_a_plan(block: Problem):
    with pytest.raises(JaxbaError, match=r"plan=jaxba\.make_plan\(problem\), made outside"):
        jax.jit(lambda p: jaxba.solve(p).points)(block)


def test_every_input_has_the_derivative_of_central_differences():
    loss = jaxba.Barron(0.5, 2.0)
    problem = with_bars(
        small_problem(SIMPLE, lever_arm=True, position_offset=True, num_outliers=3, prior_loss=Cauchy(3.0))
    )
    true = 500.0  # the optimum without bounds is some 2 px off
    problem = eqx.tree_at(lambda p: p.cameras.cx, problem, np.array([true - 9.0]))
    problem = problem.bound(cx=(true - 12.0, true - 6.0)).fix(points=[4], intrinsics=["cy"])
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
        "position_offset std_m",
        "scale_bar length_m",
        "scale_bar std_m",
        "position loss scale",
        "active upper bounds",
        "fixed cy",
    } <= names
    # a wrong derivative does not pass: J^T J in place of the second derivatives is off by percents
    assert checked.rows[0].gauss_newton_error > 1e-3
    wrong = [dataclasses.replace(row, error=row.gauss_newton_error) for row in checked.rows]
    refused = jaxba.GradientCheck(tuple(wrong), checked.tolerance)
    assert not refused.passed and "over 1e-05" in refused.table()
