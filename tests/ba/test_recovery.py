"""Simulated truth: a block with one camera, GNSS and wrong matches is recovered, as well as the covariance says."""

import numpy as np
import pytest
from jaxtyping import Float
from scipy.stats import chi2

import jaxba


@pytest.mark.parametrize("num_images", [100, pytest.param(250, marks=pytest.mark.slow)])
def test_block_is_recovered_as_the_covariance_predicts(num_images: int) -> None:
    survey = jaxba.synthetic.uav_block(num_images, seed=0, outlier_fraction=0.02, num_check=30)
    truth, loss = survey.truth, jaxba.Huber(1.0)
    solution = jaxba.solve(survey.problem, loss=loss)
    assert solution.converged
    for name, tolerance in (("fx", 1e-3), ("fy", 1e-3)):
        assert getattr(solution.cameras, name)[0] == pytest.approx(getattr(truth.cameras, name)[0], rel=tolerance)
    for name in ("cx", "cy"):
        assert getattr(solution.cameras, name)[0] == pytest.approx(getattr(truth.cameras, name)[0], abs=1.0)

    covariance = jaxba.covariance(solution.apply(survey.problem), loss=loss)
    centers = np.asarray(solution.poses.center) - np.asarray(truth.poses.center)
    check = truth.check_index
    assert_within_prediction(centers, covariance.centers)
    assert_within_prediction(solution.points[check] - truth.points[check], covariance.points[check])


def assert_within_prediction(error: Float[np.ndarray, "n 3"], covariance: Float[np.ndarray, "n 3 3"]) -> None:
    squared = np.einsum("ni,nij,nj->n", error, np.linalg.inv(covariance), error)
    # neighbours share their errors, so the mean of n is not as sharp as n independent ones: a factor two each way
    assert 0.5 < squared.mean() / 3 < 2.0
    assert squared.max() < chi2.ppf(1 - 1e-3 / len(squared), 3)
