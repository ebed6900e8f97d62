"""Reprojection errors and their statistics against formulas written out once more."""

import equinox as eqx
import numpy as np
import pytest

from jaxba._errors import JaxbaError
from jaxba.ba import Observations, Problem, quality, reprojection_errors
from jaxba.geometry import OpenCVFisheye, Pinhole, Pose
from jaxba.simulation import Survey, uav_block


@pytest.fixture(scope="module")
def survey() -> Survey:
    return uav_block(12, seed=4, num_cameras=3, outlier_fraction=0.05)


def at_truth(survey: Survey) -> Problem:
    problem, truth = survey.problem, survey.truth
    return eqx.tree_at(lambda p: (p.poses, p.cameras, p.points), problem, (truth.poses, truth.cameras, truth.points))


def test_errors_at_the_truth_are_the_measurement_errors(survey: Survey):
    noise = np.linalg.norm(survey.problem.observations.xy_px - survey.truth.xy_px, axis=1)
    # pixels of some thousands are exact to 1e-12 of themselves
    np.testing.assert_allclose(reprojection_errors(at_truth(survey)), noise, atol=1e-8)


def test_fisheye_errors_are_in_float64():
    rng = np.random.default_rng(0)
    angles = rng.uniform(-0.5, 0.5, (200, 2))
    points = np.column_stack([np.tan(angles), np.ones(200)]) * rng.uniform(5, 20, (200, 1))
    camera = OpenCVFisheye(1000.0, 990.0, 800.0, 600.0, 0.02, -0.003, 0.001, 0.0)
    theta = np.arctan(np.hypot(points[:, 0], points[:, 1]) / points[:, 2])
    scale = theta * (1 + 0.02 * theta**2 - 0.003 * theta**4 + 0.001 * theta**6) / np.hypot(points[:, 0], points[:, 1])
    xy_px = points[:, :2] * scale[:, None] * [1000.0, 990.0] + [800.0, 600.0]
    seen = Observations(xy_px + np.array([3.0, 4.0]), np.ones(200), np.zeros(200, int), np.arange(200))
    problem = Problem.build(Pose(np.array([[1.0, 0, 0, 0]]), np.zeros((1, 3))), camera, points, seen)
    np.testing.assert_allclose(reprojection_errors(problem), 5.0, atol=1e-9)


def test_statistics_are_those_of_the_used_observations(survey: Survey):
    problem = at_truth(survey)
    used = np.random.default_rng(1).uniform(size=problem.num_observations) < 0.7
    found = quality(problem, used, mad_factor=3.0)
    error = reprojection_errors(problem)
    median = np.median(error[used])
    mad = np.median(np.abs(error[used] - median))
    assert found.median_px == median and found.mad_px == mad
    assert found.threshold_px == median + 3.0 * mad
    assert found.mean_px == pytest.approx(np.mean(error[used])) and found.num_infinite == 0
    assert found.rms_px == pytest.approx(np.sqrt(np.mean(error[used] ** 2)))
    np.testing.assert_array_equal(found.is_inlier, used & (error <= found.threshold_px))
    assert found.inlier_rate == np.count_nonzero(found.is_inlier) / problem.num_observations


def test_groups_have_the_medians_of_their_observations(survey: Survey):
    problem = at_truth(survey)
    used = problem.observations.image_index != 2
    found, error = quality(problem, used), reprojection_errors(problem)
    image = problem.observations.image_index
    for groups, index in (
        (found.images, image),
        (found.points, problem.observations.point_index),
        (found.cameras, problem.camera_index[image]),
    ):
        for group in range(0, len(groups.count), 1 + len(groups.count) // 50):
            mine = error[used & (index == group)]
            assert groups.count[group] == len(mine)
            if len(mine):
                assert groups.median_px[group] == np.median(mine) and groups.max_px[group] == mine.max()
    assert np.isnan(found.images.median_px[2]) and found.images.count[2] == 0


def test_default_threshold_finds_the_outliers(survey: Survey):
    found = quality(at_truth(survey))
    outlier = survey.truth.is_outlier
    gross = found.error_px > 10  # smaller ones may pass
    assert not found.is_inlier[outlier & gross].any()
    # errors of two normal components are Rayleigh: median 1.177 s and MAD 0.448 s put 92.8% below the threshold;
    # the outliers, 5%, shift both a little up
    assert 0.92 < np.mean(found.is_inlier[~outlier]) < 0.97


def test_point_behind_the_camera_has_an_infinite_error_and_is_no_inlier():
    points = np.array([[0.0, 0, 5], [0, 0, -5], [1, 0, 5]])
    seen = Observations(np.zeros((3, 2)), np.ones(3), np.zeros(3, int), np.arange(3))
    pose = Pose(np.array([[1.0, 0, 0, 0]]), np.zeros((1, 3)))
    found = quality(Problem.build(pose, Pinhole(100.0, 100.0, 0.0, 0.0), points, seen))
    assert found.error_px.tolist() == [0.0, np.inf, 20.0]
    assert found.num_infinite == 1 and found.mean_px == 10.0 and found.median_px == 20.0
    assert not found.is_inlier[1] and found.points.max_px[1] == np.inf


def test_no_used_observation_is_an_error(survey: Survey):
    with pytest.raises(JaxbaError, match="No observation is used"):
        quality(survey.problem, np.zeros(survey.problem.num_observations, bool))
