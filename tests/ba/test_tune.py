"""Tuning against the truth of simulated surveys, and what it refuses."""

import sys

import numpy as np
import pytest

import jaxba
from jaxba import JaxbaError

pytestmark = pytest.mark.filterwarnings("ignore:Derivatives. .* rest on a saddle")  # a fifth of the matches are wrong


@pytest.fixture(scope="module")
def survey() -> jaxba.synthetic.Survey:
    return jaxba.synthetic.uav_block(
        8, seed=3, outlier_fraction=0.2, num_check=20, camera=jaxba.SimplePinhole(4000.0, 2736.0, 1824.0)
    )


def _rms(survey: jaxba.synthetic.Survey, points: np.ndarray) -> float:
    check = survey.truth.check_index
    return float(np.sqrt(np.mean(np.sum((np.asarray(points)[check] - survey.truth.points[check]) ** 2, axis=1))))


FAR = jaxba.Huber(30.0)


@pytest.fixture(scope="module")
def tuned(survey: jaxba.synthetic.Survey) -> jaxba.Tuned:
    """A scale learned from held-out observations; its problem, without them, has programs that the tests share."""
    return jaxba.tune(survey.problem, loss=FAR, hold_out=0.1, steps=8, learning_rate=0.5)


def test_a_scale_learned_from_held_out_observations_is_nearer_the_truth(
    survey: jaxba.synthetic.Survey, tuned: jaxba.Tuned
):
    assert tuned.history[-1, 0] < tuned.history[0, 0] and tuned.score == tuned.history.min()
    assert tuned.learned["loss scale"] == pytest.approx(float(tuned.loss.f_scale)) and tuned.loss.f_scale < 10.0
    before = _rms(survey, jaxba.solve(tuned.problem, loss=FAR).points)
    assert _rms(survey, jaxba.solve(tuned.problem, loss=tuned.loss).points) < 0.8 * before
    assert tuned.problem.num_observations < survey.problem.num_observations  # the held-out data was not in the fit


def test_several_starts_at_once_end_at_the_best(survey: jaxba.synthetic.Survey, tuned: jaxba.Tuned):
    check, problem = survey.truth.check_index, tuned.problem
    tuned = jaxba.tune(
        problem,
        loss=jaxba.Huber(5.0),
        learn=("loss scale", "position sigmas"),
        check_points=(check, survey.truth.points[check]),
        starts=2,
        steps=2,
    )
    assert tuned.history.shape == (3, 2) and tuned.score == tuned.history.min()
    assert set(tuned.learned) == {"loss scale", "position sigmas"}
    given, learned = problem.priors[0], tuned.problem.priors[0]
    np.testing.assert_allclose(learned.std_m, given.std_m * tuned.learned["position sigmas"])


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({}, "give check_points or hold_out, one of them"),
        (
            {"hold_out": 0.1, "learn": ("loss shape",)},
            r"learn='loss shape': this problem and loss have loss scale, pixel",
        ),
        ({"hold_out": 1.5}, "hold_out=1.5: give a share"),
        ({"hold_out": 0.1, "steps": 0}, "steps is 0; give a whole number, 1 or more"),
        ({"hold_out": 0.1, "seed": -1}, "seed is -1; give a whole number, 0 or more"),
        ({"hold_out": 0.1, "learning_rate": np.nan}, "learning_rate is nan; give a positive"),
        ({"hold_out": np.nan}, "hold_out=nan: give a share"),
        ({"check_points": (np.array([10**6]), np.zeros((1, 3)))}, "check_points: index 1000000, but there are"),
        ({"check_points": ([-1], np.zeros((1, 3)))}, "check_points: index -1, but there are"),
        ({"check_points": (np.ones(3, bool), np.zeros((3, 3)))}, r"check_points: a mask of shape \(3,\)"),
        ({"check_points": ([1, 2], np.zeros((1, 3)))}, r"\(2,\) indices and \(1, 3\) coordinates"),
    ],
)
def test_what_cannot_be_tuned_is_refused(survey: jaxba.synthetic.Survey, options: dict, message: str):
    with pytest.raises(JaxbaError, match=message):
        jaxba.tune(survey.problem, loss=jaxba.Huber(1.0), **options)


def test_tuning_without_optax_names_the_extra(survey: jaxba.synthetic.Survey, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setitem(sys.modules, "optax", None)
    with pytest.raises(JaxbaError, match=r"pip install 'jaxba\[tune\]'"):
        jaxba.tune(survey.problem, loss=jaxba.Huber(1.0), hold_out=0.1)


def test_a_check_point_must_not_be_control_of_the_fit():
    survey = jaxba.synthetic.uav_block(4, num_control=3)
    with pytest.raises(JaxbaError, match="point 1 is a check point and a control point"):
        jaxba.tune(survey.problem, loss=jaxba.Huber(1.0), check_points=(np.array([1]), survey.truth.points[[1]]))
