"""Sigmas follow the errors: all together by their tails, each point by its own."""

import threading
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from jaxba.ba import _compiler
from jaxba.scene import Block
from jaxba.sfm import Settings, _adjust, adjust
from jaxba.sfm._points import apply_points, triangulate_tracks
from jaxba.sfm._rounds import Rounds
from jaxba.sfm._spread import spread
from jaxba.sfm._uncertainty import own_factors, own_variance, uncertainty, with_own_errors
from jaxba.simulation.staged import Simulated, simulate, true_block

STD_PX = 0.5


@pytest.fixture(scope="module")
def simulated() -> Simulated:
    return simulate(20, seed=1, points_per_image=300.0, mean_track_length=5.0)


def _with_noise(simulated: Simulated, times: np.ndarray) -> Simulated:
    """Return the survey with each track's noise so many times larger."""
    tracks, exact = simulated.tracks, simulated.survey.truth.xy_px
    noise = (tracks.xy_px - exact) * times[tracks.track_index][:, None]
    return replace(simulated, tracks=replace(tracks, xy_px=exact + noise))


def _points(simulated: Simulated) -> tuple[Block, np.ndarray, np.ndarray]:
    """Return the true block with points triangulated in it, the errors of observations, and those of points."""
    block = true_block(simulated)
    found = triangulate_tracks(block, simulated.tracks, 0.026, 100.0)
    block = apply_points(block, simulated.tracks, found)
    error_px = found.error_px[found.is_used & found.is_point[found.of_track]]
    return block, error_px, block.points_m - simulated.survey.truth.points[block.track_index]


def test_points_of_like_noise_are_alike(simulated: Simulated) -> None:
    block, error_px, _ = _points(simulated)
    factor = own_factors(block, error_px)
    assert np.quantile(factor, [0.01, 0.99]) == pytest.approx([1, 1], abs=0.1)


def test_a_points_variance_follows_the_noise_of_its_track(simulated: Simulated) -> None:
    # variances of scaled inverse chi-square, 4 degrees of freedom: the model itself
    rng = np.random.default_rng(3)
    times = np.sqrt(4 / rng.chisquare(4, simulated.tracks.num_tracks))
    block, error_px, point_m = _points(_with_noise(simulated, times))
    redundancy = 2 * block.num_observations - 3 * block.num_points
    mean_px = float(np.sqrt(np.sum(error_px**2) / redundancy))
    # poses are true, so what a point is off by is due to its own observations
    alike = own_variance(block, mean_px)
    own = with_own_errors(alike, block, error_px, mean_px)
    noise = times[block.track_index]
    for group in (noise > 1.5, noise < 0.8):
        assert 0.5 < np.mean(point_m[group] ** 2 / own[group]) < 1.7
    assert np.mean(point_m[noise > 1.5] ** 2 / alike[noise > 1.5]) > 1.8
    assert np.mean(point_m[noise < 0.8] ** 2 / alike[noise < 0.8]) < 0.5
    assert np.mean(np.abs(point_m) < 3 * np.sqrt(own)) > np.mean(np.abs(point_m) < 3 * np.sqrt(alike)) + 0.005


def test_own_variance_is_that_of_repeated_measurement(simulated: Simulated) -> None:
    block, _, point_m = _points(simulated)
    assert np.mean(point_m**2 / own_variance(block, STD_PX)) == pytest.approx(1.0, abs=0.06)


def test_what_statistics_call_is_compiled_beside_the_rounds() -> None:
    survey = simulate(10, seed=5, points_per_image=100.0)
    made = adjust(
        survey.block,
        survey.tracks,
        survey.view_graph,
        survey.reference,
        survey.photos,
        Settings(),
        with_statistics=True,
    )
    assert made.compiled is not None and made.compiled.result(300) is None
    compiled = _compiler._ahead.cache_info().misses
    found = uncertainty(made, survey.reference, with_statistics=True)
    assert found.statistics is not None and _compiler._ahead.cache_info().misses == compiled


def test_a_broken_adjustment_compiles_no_more(monkeypatch: pytest.MonkeyPatch) -> None:
    survey = simulate(10, seed=5, points_per_image=100.0)
    stops: list[threading.Event] = []

    def compiler(*_: object, stop: threading.Event, **__: object) -> Callable[[], None]:
        stops.append(stop)
        return lambda: None

    def interrupted(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(_adjust, "statistics_compiler", compiler)
    monkeypatch.setattr(Rounds, "solve", interrupted)
    given = (survey.block, survey.tracks, survey.view_graph, survey.reference, survey.photos)
    with pytest.raises(KeyboardInterrupt):
        adjust(*given, Settings(), with_statistics=True)
    assert [stop.is_set() for stop in stops] == [True]


def test_long_tails_widen_the_sigmas_and_normal_errors_do_not() -> None:
    normal = simulate(10, seed=5, points_per_image=100.0)
    rng = np.random.default_rng(1)
    tailed = _with_noise(normal, 0.2 * np.sqrt(3 / rng.chisquare(3, normal.tracks.num_tracks)))
    found = []
    for survey in (normal, tailed):
        given = (survey.block, survey.tracks, survey.view_graph, survey.reference, survey.photos)
        made = adjust(*given, Settings())
        found.append(spread(made.block, made.error_px, made.std_px, made.loss).scatter)
    assert found[0] < 1.05 and 1.15 < found[1] < 2.0
