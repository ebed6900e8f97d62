"""Errors name the entry, its value and the cure; what is left out is counted, named and without effect."""

import dataclasses
from typing import Any

import equinox as eqx
import numpy as np
import pytest

from jaxba._errors import JaxbaError
from jaxba.ba import ControlPointPrior, Observations, PositionPrior, Problem
from jaxba.ba.checks._check import Reason, prepare
from jaxba.geometry import BAL, Pinhole, Pose
from jaxba.simulation import uav_block


@pytest.fixture(scope="module")
def block() -> Problem:
    problem = uav_block(12, seed=2, num_control=3, lever_arm_std_m=0.1).problem
    return dataclasses.replace(problem, image_names=tuple(f"DJI_{i:04d}.JPG" for i in range(12)))


def changed(array: Any, index: Any, value: Any) -> np.ndarray:
    copy = np.array(array)
    copy[index] = value
    return copy


def with_observations(problem: Problem, keep: np.ndarray) -> Problem:
    seen = problem.observations
    kept = Observations(seen.xy_px[keep], seen.std_px[keep], seen.image_index[keep], seen.point_index[keep])
    return eqx.tree_at(lambda p: p.observations, problem, kept)


def test_sound_problem_is_returned_as_it_is(block: Problem):
    prepared = prepare(block)
    assert prepared.problem is block
    assert not prepared.dropped.any() and prepared.dropped.summary() == []
    np.testing.assert_array_equal(prepared.kept, np.arange(block.num_observations))


def replaced(where: Any, index: Any, value: Any) -> Any:
    return lambda p: eqx.tree_at(where, p, changed(where(p), index, value))


def position(p: Problem) -> PositionPrior:
    return p.priors[0]


def without_last(where: Any) -> Any:
    return lambda p: eqx.tree_at(where, p, where(p)[:-1])


ERRORS = {
    "shape": (without_last(lambda p: p.observations.std_px), r"std_px has shape \(\d+,\), expected \(observations\)"),
    "free_shape": (without_last(lambda p: p.free.points), r"free.points has shape"),
    "prior_shape": (without_last(lambda p: position(p).std_m), r"prior position: std_m has shape \(11, 3\)"),
    "free_type": (lambda p: eqx.tree_at(lambda q: q.free.poses, p, np.arange(12)), r"free.poses has type int64"),
    "names": (lambda p: dataclasses.replace(p, image_names=("a", "b")), r"image_names has 2 names for 12 images"),
    "pose_nan": (replaced(lambda p: p.poses.translation, (3, 1), np.nan), r"image 3 \(DJI_0003.JPG\) has nan; give"),
    "quaternion": (replaced(lambda p: p.poses.quaternion, 3, 0.0), r"norm .* image 3 \(DJI_0003.JPG\) has 0; .*normal"),
    "point_inf": (replaced(lambda p: p.points, (17, 2), np.inf), r"points: point 17 has inf"),
    "camera_nan": (replaced(lambda p: p.cameras.fy, 0, np.nan), r"cameras.fy: camera 0 has nan"),
    "lever_arm": (replaced(lambda p: p.lever_arm, 1, np.nan), r"lever_arm: axis 1 has nan"),
    "pixel_nan": (
        replaced(lambda p: p.observations.xy_px, (5, 0), np.nan),
        r"observation 5 \(point \d+ in image .*nan",
    ),
    "std_zero": (replaced(lambda p: p.observations.std_px, 4, 0.0), r"std_px: observation 4 .* has 0; a sigma must be"),
    "std_many": (replaced(lambda p: p.observations.std_px, [4, 9], -1.0), r"has -1 \(and 1 more\)"),
    "image_index": (
        replaced(lambda p: p.observations.image_index, 7, 12),
        r"observation 7 refers to image 12, .* 12 im",
    ),
    "point_index": (replaced(lambda p: p.observations.point_index, 7, -1), r"observation 7 refers to point -1"),
    "camera_index": (
        replaced(lambda p: p.camera_index, 2, 1),
        r"camera_index: image 2 \(DJI_0002.JPG\) refers to camera",
    ),
    "index_type": (
        lambda p: eqx.tree_at(lambda q: q.camera_index, p, np.zeros(12)),
        r"camera_index has type float64; give integers",
    ),
    "bounds_crossed": (
        lambda p: replaced(lambda q: q.lower, (0, 2), 9e3)(p.bound(cx=(0.0, 5e3))),
        r"bounds of cx of camera 0: 9000,5000",
    ),
    "start_outside": (lambda p: p.bound(fx=(0.0, 100.0)), r"fx of camera 0 starts at \d+.*, outside its bounds 0,100"),
    "prior_twice": (
        lambda p: eqx.tree_at(lambda q: q.priors, p, (*p.priors, p.priors[0])),
        r"prior position is given twice",
    ),
    "prior_index": (
        replaced(lambda p: position(p).image_index, 3, 99),
        r"prior position: image_index: row 3 .* image 99",
    ),
    "prior_duplicate": (
        replaced(lambda p: position(p).image_index, 3, 4),
        r"prior position: image 4 \(DJI_0004.JPG\) has more than one row",
    ),
    "prior_std": (replaced(lambda p: position(p).std_m, (3, 1), 0.0), r"std_m .*image 3 \(DJI_0003.JPG\) has 0"),
    "prior_nan": (replaced(lambda p: position(p).xyz, (3, 1), np.nan), r"xyz .*image 3 \(DJI_0003.JPG\) has nan"),
    "empty": (lambda p: with_observations(p, np.zeros(0, int)), r"observations are empty"),
}


@pytest.mark.parametrize("case", ERRORS)
def test_impossible_problem_is_named(block: Problem, case: str):
    change, message = ERRORS[case]
    with pytest.raises(JaxbaError, match=message):
        prepare(change(block))


def test_nothing_free_is_an_error(block: Problem):
    fixed = block.fix(poses=True, points=True, intrinsics=True)
    fixed = eqx.tree_at(lambda p: p.free.lever_arm, fixed, np.array(False))
    with pytest.raises(JaxbaError, match="Nothing is free"):
        prepare(fixed)


def test_duplicate_observation_is_named(block: Problem):
    twice = with_observations(block, np.append(np.arange(block.num_observations), 100))
    point, label = block.observations.point_index[100], block.image_label(int(block.observations.image_index[100]))
    with pytest.raises(JaxbaError) as error:
        prepare(twice)
    assert f"observations 100 and {block.num_observations}: point {point} is measured twice in {label}" in str(
        error.value
    )


def test_fixed_intrinsic_may_lie_outside_its_bounds(block: Problem):
    prepare(block.bound(fx=(0.0, 100.0)).fix(intrinsics=["fx"]))


def test_points_seen_once_are_left_out_and_control_points_stay(block: Problem):
    seen = block.observations
    first = np.unique(seen.point_index, return_index=True)[1]
    keep = np.ones(block.num_observations, bool)
    for point in (0, 20, 30):  # point 0 is a control point
        keep[seen.point_index == point] = False
        keep[first[point]] = True
    prepared = prepare(with_observations(block, keep))
    dropped, problem = prepared.dropped, prepared.problem
    assert dropped.points.tolist() == [20, 30]
    assert dropped.summary() == ["2 points seen once left out (first: 20, 30)"]
    assert dropped.count(Reason.SEEN_ONCE) == dropped.observations.sum() == 2
    assert not problem.free.points[[20, 30]].any() and problem.free.points[0]
    assert not np.isin([20, 30], problem.observations.point_index).any()
    given = with_observations(block, keep).observations
    np.testing.assert_array_equal(problem.observations.xy_px, given.xy_px[prepared.kept])
    np.testing.assert_array_equal(problem.observations.point_index, given.point_index[prepared.kept])


def test_control_point_without_height_seen_once_is_left_out(block: Problem):
    control = block.priors[1]
    assert isinstance(control, ControlPointPrior)
    flat = eqx.tree_at(lambda p: p.priors[1].std_m, block, changed(control.std_m, (0, 2), np.inf))
    seen = block.observations
    keep = (seen.point_index != 0) | (np.arange(len(seen.point_index)) == np.flatnonzero(seen.point_index == 0)[0])
    prepared = prepare(with_observations(flat, keep))
    assert prepared.dropped.points.tolist() == [0]
    assert np.isinf(prepared.problem.priors[1].std_m[0]).all()


def test_fixed_point_seen_once_stays(block: Problem):
    seen = block.observations
    first = np.unique(seen.point_index, return_index=True)[1][20]
    keep = (seen.point_index != 20) | (np.arange(len(seen.point_index)) == first)
    assert not prepare(with_observations(block, keep).fix(points=[20])).dropped.any()


def test_image_that_sees_nothing_is_held_and_its_prior_does_not_pull(block: Problem):
    prepared = prepare(with_observations(block, block.observations.image_index != 5))
    problem = prepared.problem
    assert "1 image without observations held fixed (number 5 DJI_0005.JPG)" in prepared.dropped.summary()
    assert not problem.free.poses[5] and problem.free.poses.sum() == 11
    prior = problem.priors[0]
    assert np.isinf(prior.std_m[5]).all() and np.isfinite(prior.std_m[:5]).all()


def test_camera_of_no_image_is_held():
    problem = uav_block(12, num_cameras=3).problem
    moved = eqx.tree_at(lambda p: p.camera_index, problem, np.where(problem.camera_index == 1, 2, problem.camera_index))
    prepared = prepare(moved)
    assert prepared.dropped.cameras.tolist() == [1] and prepared.dropped.any()
    assert prepared.dropped.summary() == ["1 camera without observations held fixed (number 1)"]
    assert not prepared.problem.free.intrinsics[1].any() and prepared.problem.free.intrinsics[0].any()


def two_views(camera: Any, points: Any) -> Problem:
    """Two images side by side, looking along z, that see every point."""
    points = np.asarray(points, float)
    poses = Pose(np.tile([1.0, 0, 0, 0], (2, 1)), np.array([[0.0, 0, 0], [-1, 0, 0]]))
    count = len(points)
    seen = Observations(
        np.zeros((2 * count, 2)), np.ones(2 * count), np.repeat([0, 1], count), np.tile(np.arange(count), 2)
    )
    return Problem.build(poses, camera, points, seen)


def test_points_behind_the_camera_are_left_out():
    problem = two_views(Pinhole(100.0, 100.0, 50.0, 50.0), [[0, 0, 5], [1, 0, -5], [0, 1, 0], [1, 1, 8], [2, 1, 6]])
    dropped = prepare(problem.fix(intrinsics=True)).dropped  # three points do for two poses
    np.testing.assert_array_equal(np.flatnonzero(dropped.reason == Reason.BEHIND), [1, 2, 6, 7])
    assert dropped.points.tolist() == [1, 2]
    assert dropped.summary() == [
        "4 observations of points behind the camera left out (first: 1, 2, 6, ...)",
        "2 points seen fewer than twice after that left out (first: 1, 2)",
    ]


def test_model_that_sees_behind_keeps_what_has_a_pixel():
    problem = two_views(BAL(100.0, 0.0, 0.0), [[0, 0, 5], [1, 0, -5], [0, 1, 0], [1, 1, 8]])
    dropped = prepare(problem).dropped
    np.testing.assert_array_equal(np.flatnonzero(dropped.reason == Reason.NO_PIXEL), [2, 6])
    assert dropped.count(Reason.BEHIND) == 0


def test_block_that_looks_the_wrong_way_is_an_error():
    problem = two_views(Pinhole(100.0, 100.0, 50.0, 50.0), [[0, 0, -5], [1, 0, -5]])
    with pytest.raises(JaxbaError, match=r"No observation is left of 4: 4 are of points behind .* give cam_from_world"):
        prepare(problem)


@pytest.mark.parametrize("through", ["float32", "float32, then float64", "float64", "whole metres"])
@pytest.mark.parametrize(
    ("offset_m", "std_m", "step_m"), [(4.6e6, 0.02, 0.5), (4.6e6, 1.0, 0), (5e5, 0.02, 0.03125), (300.0, 0.02, 0)]
)
def test_coordinates_rounded_by_more_than_their_sigma_are_refused(
    block: Problem, through: str, offset_m: float, std_m: float, step_m: float
):
    given = position(block)
    xyz = np.asarray(given.xyz) + offset_m
    if through.startswith("float32"):
        xyz = xyz.astype(np.float32)
    if through == "float32, then float64":
        xyz = xyz.astype(float)
    if through == "whole metres":
        xyz = np.round(xyz)
    prior = dataclasses.replace(given, xyz=xyz, std_m=np.full(xyz.shape, std_m))
    problem = dataclasses.replace(block, priors=(prior, *block.priors[1:]))
    if step_m and through.startswith("float32"):
        said = (
            rf"prior position: xyz.*: image 0 \(DJI_0000.JPG\): .* steps of {step_m:g} m, .* sigma of {std_m:g} m; sub"
        )
        with pytest.raises(JaxbaError, match=said):
            prepare(problem)
    else:
        prepare(problem)
