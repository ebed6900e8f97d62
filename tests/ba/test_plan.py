"""The plan holds every pair of observations once, pads with what weighs nothing, and loses nothing on the way."""

import dataclasses
import itertools
from collections import Counter

import equinox as eqx
import jax
import numpy as np
import pytest
from dense_reference import minimise, start_of
from small_problems import EVERY_CAMERA, RADIAL, small_problem

import jaxba
from jaxba.ba import Observations, Problem
from jaxba.ba._plan import ROW_RUN, make_plan
from jaxba.ba._plan_shape import bucket
from jaxba.ba._solvers import SchurLevenbergMarquardt
from jaxba.ba._system import initial_unknowns, make_system, restore
from jaxba.geometry import Linear


def shuffled(problem: Problem, seed: int = 0) -> Problem:
    """Return the problem with its observations in another order."""
    order = np.random.default_rng(seed).permutation(problem.num_observations)
    seen = problem.observations
    fields = (seen.xy_px, seen.std_px, seen.image_index, seen.point_index)
    return eqx.tree_at(lambda p: p.observations, problem, type(seen)(*(np.asarray(f)[order] for f in fields)))


PROBLEMS = {
    "strip": lambda: small_problem(EVERY_CAMERA[2], num_images=26, num_points=60, seen_by=3),
    "fixed": lambda: small_problem(EVERY_CAMERA[2]).fix(poses=[0, 3], points=[2, 7, 8]),
    "own_cameras": lambda: small_problem(EVERY_CAMERA[0], num_images=8, num_cameras=8).fix(poses=[1], points=[0]),
    "two_cameras": lambda: small_problem(EVERY_CAMERA[3], num_cameras=2),
    "nothing_in_common": lambda: small_problem(EVERY_CAMERA[2]).fix(points=True),
}


@pytest.mark.parametrize("linear_solver", ["dense", "banded"])
@pytest.mark.parametrize("name", PROBLEMS)
def test_pairs_are_all_pairs_of_observations_of_free_points_from_free_images(name, linear_solver):
    problem = shuffled(PROBLEMS[name]())
    plan = make_plan(problem, linear_solver=linear_solver)
    image, point = problem.observations.image_index, problem.observations.point_index
    own = plan.shape.own_cameras  # then a fixed image's camera is still free
    used = [i for i in range(len(image)) if problem.free.points[point[i]] and (own or problem.free.poses[image[i]])]
    expected = {frozenset(p) for p in itertools.combinations(used, 2) if point[p[0]] == point[p[1]]}

    first, second = plan.row_observation[plan.pair_first.ravel()], plan.row_observation[plan.pair_second.ravel()]
    real = (first >= 0) & (second >= 0)
    found = [frozenset(p) for p in zip(first[real].tolist(), second[real].tolist(), strict=True)]
    assert Counter(found) == Counter(expected)
    assert np.all((first[~real] == -1) & (second[~real] == -1))

    block = np.repeat(plan.pair_block, plan.pair_first.shape[-1])[real]
    rank = np.argsort(plan.image_order)
    np.testing.assert_array_equal(plan.block_row[block], rank[image[first[real]]])
    np.testing.assert_array_equal(plan.block_column[block], rank[image[second[real]]])
    blocks = len(np.unique(block))
    assert np.all(plan.block_row[:blocks] > plan.block_column[:blocks])
    assert np.all(plan.block_row[blocks:] == plan.shape.num_images - 1)
    assert np.all(plan.block_column[blocks:] == plan.shape.num_images - 1)
    if linear_solver == "banded":
        panel = plan.shape.panel_images
        assert np.all(plan.block_row // panel - plan.block_column // panel <= plan.shape.band_panels)


def test_strip_is_ordered_into_a_narrow_band():
    plan = make_plan(shuffled(PROBLEMS["strip"]()), linear_solver="banded")
    # a point lies in three of the nearest images: two apart, or three where one observation is missing
    assert np.max(plan.block_row - plan.block_column) <= 3
    assert plan.shape.num_images >= 4 * plan.shape.panel_images and plan.shape.band_panels == 1


@pytest.mark.parametrize("name", PROBLEMS)
def test_rows_hold_every_observation_once_and_runs_see_one_image(name):
    problem = shuffled(PROBLEMS[name]())
    plan = make_plan(problem)
    system = make_system(problem, plan, Linear())
    real = plan.row_observation >= 0
    assert sorted(plan.row_observation[real]) == list(range(problem.num_observations))
    assert not real[-1] and len(real) % ROW_RUN == 0

    seen, source = problem.observations, plan.row_observation[real]
    np.testing.assert_array_equal(plan.image_order[plan.row_image[real]], seen.image_index[source])
    np.testing.assert_array_equal(plan.point_order[plan.row_point[real]], seen.point_index[source])
    assert np.all(plan.row_image.reshape(-1, ROW_RUN) == plan.row_image[::ROW_RUN, None])
    assert np.all(np.diff(plan.row_image) >= 0)

    group = system.reprojection
    weight = np.asarray(group.weight).ravel()
    np.testing.assert_array_equal(weight[real], 1 / seen.std_px[source])
    assert np.all(weight[~real] == 0)
    np.testing.assert_array_equal(np.asarray(group.xy_px).reshape(2, -1)[:, real].T, seen.xy_px[source])


@pytest.mark.parametrize("linear_solver", ["dense", "banded"])
@pytest.mark.parametrize("name", PROBLEMS)
def test_unknowns_come_back_as_they_went_in(name, linear_solver):
    problem = shuffled(PROBLEMS[name]())
    plan = make_plan(problem, linear_solver=linear_solver)
    unknowns = initial_unknowns(problem, plan)
    assert all(np.all(np.isfinite(leaf)) for leaf in jax.tree.leaves(unknowns))
    np.testing.assert_allclose(np.linalg.norm(unknowns.poses.quaternion, axis=1), 1.0, rtol=1e-12)
    jax.tree.map(np.testing.assert_array_equal, restore(unknowns, plan), start_of(problem))


def test_bucket_adds_at_most_an_eighth_and_small_counts_have_two_sizes_an_octave():
    counts = range(1, 9000)
    sizes = [bucket(count) for count in counts]
    most = [1.125 if count >= 2048 else 1.5 for count in counts]
    assert all(n <= size <= max(n * m, n + 1) for n, size, m in zip(counts, sizes, most, strict=True))
    assert sizes == sorted(sizes)
    assert len({size for size in sizes if 4096 < size <= 8192}) == 8
    assert {size for size in sizes if 512 < size <= 1024} == {768, 1024}
    assert all(bucket(bucket(count)) == bucket(count) for count in counts)
    assert bucket(100, multiple=7) % 7 == 0
    assert bucket(100, multiple=7) >= 100


def test_tiny_problems_share_one_shape() -> None:
    """They would compile anew for each, which takes a thousand times as long as solving it."""
    shapes = {make_plan(small_problem(RADIAL, num_points=count)).shape for count in (20, 30, 45)}
    assert len(shapes) == 1


def test_plans_of_a_series_share_one_shape() -> None:
    problem = small_problem(RADIAL, num_points=400)
    seen = problem.observations
    few = np.sort(np.random.default_rng(0).permutation(problem.num_observations)[: int(0.7 * problem.num_observations)])
    part = Observations(*(np.asarray(column)[few] for column in (
        seen.xy_px, seen.std_px, seen.image_index, seen.point_index)))  # fmt: skip
    smaller = dataclasses.replace(problem, observations=part)
    whole = make_plan(problem, spare=0.2)
    plan = make_plan(smaller, like=whole.shape)
    assert plan.shape == whole.shape != make_plan(smaller).shape
    same = jaxba.solve(smaller, plan=plan)
    own = minimise(same.report.problem, Linear(), SchurLevenbergMarquardt())
    np.testing.assert_allclose(same.final_cost, own.state.cost, rtol=1e-9)
    np.testing.assert_allclose(same.points, own.unknowns.points, atol=1e-5)  # metres; sums in another order
