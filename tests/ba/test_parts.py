"""Parts: how points are dealt out, and steps in parts against those in one piece."""

import dataclasses
from collections.abc import Callable

import numpy as np
import pytest
from small_problems import RADIAL, small_problem
from test_tiles import everything, with_own_cameras

import jaxba
from jaxba import Problem, Solution
from jaxba.ba import PlanShape, make_plan
from jaxba.ba._plan import lay_out_images, widened
from jaxba.ba._plan_shape import bare_shape, bucket, larger
from jaxba.ba.parts import _solve
from jaxba.ba.parts._deal import deal_out
from jaxba.geometry import AbstractLoss, Huber, Linear


def _with_bars() -> Problem:
    """Everything, with two scale bars in the first part, none in the second."""
    problem = everything()
    ends = np.array([[3, 6], [5, 7]])
    one, other = np.asarray(problem.points)[ends.T]
    return jaxba.with_scale_bars(problem, *ends.T, np.linalg.norm(one - other, axis=1), [1.0, 1.0])


def _solved(
    problem: Problem, loss: AbstractLoss, max_nfev: int, monkeypatch: pytest.MonkeyPatch, least: int
) -> Solution:
    monkeypatch.setattr(_solve, "_LEAST_OBSERVATIONS", least)
    return jaxba.solve(problem, loss=loss, max_nfev=max_nfev, ftol=1e-12, xtol=1e-12)


@pytest.mark.parametrize(
    ("make", "loss"), [(_with_bars, Huber(1.0)), (with_own_cameras, Linear())], ids=["everything", "own cameras"]
)
def test_steps_and_solution_are_those_in_one_piece(
    make: Callable[[], Problem], loss: AbstractLoss, monkeypatch: pytest.MonkeyPatch
) -> None:
    # breaks where damping, a prior or a one of a fixed unknown enters twice or not at all, bounds are left, or a part
    # judges a step by itself
    problem = make()
    for max_nfev, cost_error, pose_error in ((1, 1e-9, 1e-9), (60, 1e-9, 1e-7)):
        whole = _solved(problem, loss, max_nfev, monkeypatch, 10**9)
        parts = _solved(problem, loss, max_nfev, monkeypatch, 0)
        assert whole.report is not None and parts.report is not None
        assert parts.num_steps == whole.num_steps and parts.result == whole.result
        steps, of_parts = whole.report.history[1], parts.report.history[1]
        for name, rtol in (("cost", 1e-9), ("gradient", 1e-6), ("step_norm", 1e-6), ("trust", 1e-6)):
            np.testing.assert_allclose(getattr(of_parts, name), getattr(steps, name), rtol=rtol, err_msg=name)
        np.testing.assert_allclose(parts.final_cost, whole.final_cost, rtol=cost_error)
        np.testing.assert_allclose(parts.initial_cost, whole.initial_cost, rtol=1e-12)
        np.testing.assert_allclose(parts.plain_cost, whole.plain_cost, rtol=1e-6)
        np.testing.assert_allclose(parts.poses.translation, whole.poses.translation, rtol=0, atol=pose_error)
        np.testing.assert_allclose(parts.poses.quaternion, whole.poses.quaternion, rtol=0, atol=pose_error)
        for name in whole.cameras.parameter_names():
            np.testing.assert_allclose(getattr(parts.cameras, name), getattr(whole.cameras, name), rtol=1e-7, atol=1e-9)
        np.testing.assert_allclose(parts.lever_arm, whole.lever_arm, rtol=0, atol=1e-7)
        np.testing.assert_allclose(parts.position_offset, whole.position_offset, rtol=0, atol=1e-6)
    if make is _with_bars:
        assert parts.cameras.k1 == -0.03  # the bound is active


@pytest.mark.parametrize("count", [1, 2, 3])
def test_every_point_and_every_row_goes_to_one_part(count: int) -> None:
    # breaks where a part loses rows of a prior, parts have shapes of their own, or one has most of the work
    problem = _with_bars()
    dealt = deal_out(problem, Linear(), count, "auto", np.float64)
    points = np.concatenate([part.points for part in dealt.parts])
    assert np.array_equal(np.sort(points), np.arange(problem.num_points))
    assert len({part.orders.shape for part in dealt.parts}) == 1
    rows = [int((part.orders.row_observation >= 0).sum()) for part in dealt.parts]
    assert sum(rows) == problem.num_observations and max(rows) - min(rows) < 0.01 * problem.num_observations + 60
    for place, prior in enumerate(problem.priors):
        weight = [np.isfinite(np.asarray(_sigmas(part.system.priors[place]))).sum() for part in dealt.parts]
        assert sum(weight) == np.isfinite(np.asarray(_sigmas(prior))).sum()


def _sigmas(prior: object) -> np.ndarray:
    return next(value for name, value in vars(prior).items() if name.startswith("std"))


def test_parts_of_a_series_share_one_shape() -> None:
    # breaks where a smaller problem of the series compiles anew
    problem = everything()
    shape: PlanShape = make_plan(problem, spare=0.1).shape
    seen, few = problem.observations, np.random.default_rng(0).random(problem.num_observations) < 0.7
    kept = type(seen)(
        *(np.asarray(value)[few] for value in (seen.xy_px, seen.std_px, seen.image_index, seen.point_index))
    )
    smaller = dataclasses.replace(problem, observations=kept)
    shapes = {
        dealt.joint.shape: {part.orders.shape for part in dealt.parts}
        for dealt in (deal_out(one, Linear(), 2, "auto", np.float64, like=shape) for one in (problem, smaller))
    }
    assert len(shapes) == 1 and len(*shapes.values()) == 1


def test_a_widened_plan_is_the_one_made_of_that_shape() -> None:
    # breaks where padding of rows, points, pairs or blocks still refers to where it was
    problem = small_problem(RADIAL, num_points=400)
    order = lay_out_images(problem, bare_shape(problem), "auto").order
    plan = make_plan(problem, linear_solver="dense", image_order=order)
    names = "num_points", "num_rows", "num_pair_runs", "num_blocks"
    grown = {name: 2 * bucket(getattr(plan.shape, name), multiple=2048) for name in names}
    shape = larger(plan.shape, dataclasses.replace(plan.shape, **grown))
    made, wide = make_plan(problem, linear_solver="dense", like=shape, image_order=order), widened(plan, shape)
    assert wide.shape == made.shape
    for field in dataclasses.fields(made):
        if field.name != "shape":
            np.testing.assert_array_equal(getattr(wide, field.name), getattr(made, field.name), err_msg=field.name)
