"""The adjustment in rounds against simulated truth: wrong features, a wrong edge, wrong GNSS positions."""

import contextlib
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any, NoReturn

import numpy as np
import pytest
from completion import features_of, reduced
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from jaxba import JaxbaError, solve, solve_tiled
from jaxba.ba import HistoryStep, _descend
from jaxba.scene import Block, Tracks
from jaxba.sfm import Adjusted, Settings, Tiling, Uncertainty, _rounds, adjust, uncertainty
from jaxba.sfm._edges import match_rows, without_edges
from jaxba.simulation.staged import Simulated, measured_anew, simulate, view_graph_of

WITHOUT = [3, 7]  # images without a position


def _run(simulated: Simulated, tiling: Tiling | None = None, **settings: object) -> Adjusted:
    return adjust(
        simulated.block, simulated.tracks, simulated.view_graph, simulated.reference, simulated.photos,
        Settings(**settings), tiling=tiling,  # type: ignore[arg-type]
    )  # fmt: skip


def with_wrong_edge(simulated: Simulated, edge: tuple[int, int], shift_px: float) -> Simulated:
    """Return the survey with all matches of an edge off by so much, in tracks of these two images alone."""
    tracks = simulated.tracks
    first, second = (np.flatnonzero(tracks.image_index == i) for i in edge)
    shared = np.intersect1d(tracks.track_index[first], tracks.track_index[second])
    moved = np.isin(tracks.track_index, shared) & np.isin(tracks.image_index, edge)
    number = np.full(tracks.num_tracks, -1)
    number[shared] = tracks.num_tracks + np.arange(len(shared))
    index = np.where(moved, number[tracks.track_index], tracks.track_index)
    xy = tracks.xy_px.copy()
    xy[moved & (tracks.image_index == edge[1]), 0] += shift_px  # flown along y: x is across the base
    order = np.lexsort((tracks.image_index, index))
    changed = replace(
        tracks,
        track_index=index[order],
        image_index=tracks.image_index[order],
        feature_index=tracks.feature_index[order],
        xy_px=xy[order],
        rgb=np.concatenate([tracks.rgb, tracks.rgb[shared]]),
    )
    return replace(simulated, tracks=changed, view_graph=view_graph_of(changed))


@pytest.fixture(scope="module")
def clean() -> Simulated:
    return simulate(12, seed=4, points_per_image=150.0, mean_track_length=4.0)


@pytest.fixture(scope="module")
def adjusted_clean(clean: Simulated) -> Adjusted:
    return _run(clean)


@pytest.fixture(scope="module")
def sigmas(adjusted_clean: Adjusted, clean: Simulated) -> Uncertainty:
    return uncertainty(adjusted_clean, clean.reference)


@pytest.fixture(scope="module")
def hard_and_edge() -> tuple[Simulated, tuple[int, int]]:
    simulated = simulate(
        12, seed=4, points_per_image=150.0, mean_track_length=4.0, outlier_fraction=0.1,
        gnss_outlier_fraction=0.1, gnss_outlier_m=(1.0, 2.0),
    )  # fmt: skip
    graph = simulated.view_graph
    observations = np.bincount(simulated.tracks.image_index)
    share = graph.num_inliers / observations[graph.pairs].min(axis=1)
    edge = graph.pairs[np.argmin(np.abs(share - 0.15))]  # a side lap
    wrong = with_wrong_edge(simulated, (int(edge[0]), int(edge[1])), 5.0)
    reference = replace(wrong.reference, is_used=~np.isin(np.arange(12), WITHOUT))
    return replace(wrong, reference=reference), (int(edge[0]), int(edge[1]))


@pytest.fixture(scope="module")
def hard(hard_and_edge: tuple[Simulated, tuple[int, int]]) -> Simulated:
    return hard_and_edge[0]


@pytest.fixture(scope="module")
def adjusted_hard(hard: Simulated) -> Adjusted:
    return _run(hard)


def test_a_clean_block_loses_only_its_tail(adjusted_clean: Adjusted, clean: Simulated) -> None:
    # 7% of Rayleigh distances lie over median + 2.5 MAD; a track of two views goes as a whole
    assert adjusted_clean.num_rejected / adjusted_clean.num_judged < 0.13
    assert adjusted_clean.std_px == pytest.approx(clean.survey.truth.pixel_std_px, rel=0.1)
    assert adjusted_clean.converged and not adjusted_clean.pruned and not adjusted_clean.lost


def test_truth_lies_within_three_predicted_sigmas(
    adjusted_clean: Adjusted, clean: Simulated, sigmas: Uncertainty
) -> None:
    truth, block = clean.survey.truth, adjusted_clean.block
    position = (block.centers_m - np.asarray(truth.poses.center)) / sigmas.position_std_m
    point = (block.points_m - truth.points[block.track_index]) / sigmas.point_std_m
    assert np.abs(position).max() < 3.5  # the largest of 36 normal numbers: over 3.5 once in 60 blocks
    assert np.mean(np.abs(point) < 3) > 0.98
    focal = (block.camera_parameters[0, :2] - [3652.0, 3649.0]) / sigmas.intrinsics_std[0, :2]
    assert np.abs(focal).max() < 3


def test_squared_errors_are_what_the_sigmas_say_over_several_surveys(clean: Simulated) -> None:
    """Errors within one block are much alike, so that one says little: ten times the same flight, measured anew."""
    truth = clean.survey.truth
    names = type(clean.survey.problem.cameras).parameter_names()
    camera = np.array([float(np.ravel(getattr(truth.cameras, name))[0]) for name in names])
    cameras, points, intrinsics = [], [], []
    for seed in range(10):
        survey = measured_anew(clean, np.random.default_rng(seed), (0.02, 0.02, 0.04))
        found = _run(survey, max_rounds=3)
        sigmas, block = uncertainty(found, survey.reference), found.block
        assert sigmas.covariance is not None
        error = block.centers_m - np.asarray(truth.poses.center)
        squared = np.einsum("ni,nij,nj->n", error, np.linalg.inv(sigmas.covariance.centers), error)
        cameras.append(squared.mean() / 3)
        points.append(np.mean(((block.points_m - truth.points[block.track_index]) / sigmas.point_std_m) ** 2))
        free = sigmas.intrinsics_std[0] > 0
        intrinsics.append((block.camera_parameters[0] - camera)[free] / sigmas.intrinsics_std[0, free])
    assert 0.7 < np.mean(cameras) < 1.4 and 0.7 < np.mean(points) < 1.4
    assert 0.6 < np.mean(np.square(intrinsics)) < 1.5
    # no parameter is off the same way in all: the mean of ten has a sigma of 0.32
    assert np.abs(np.mean(intrinsics, axis=0)).max() < 1.1


def test_the_camera_is_calibrated(adjusted_clean: Adjusted, sigmas: Uncertainty) -> None:
    true = np.array([3652.0, 3649.0, 2748.5, 1816.2, -0.045, 0.015, 0.0006, -0.0004])
    error = adjusted_clean.block.camera_parameters[0, :8] - true
    assert np.all(np.abs(error) < 4 * sigmas.intrinsics_std[0, :8])
    assert adjusted_clean.block.camera_parameters[0, 8] == 0.0  # k3 is fixed


def test_wrong_features_and_positions_do_not_bend_the_block(adjusted_hard: Adjusted, hard: Simulated) -> None:
    truth, block = hard.survey.truth, adjusted_hard.block
    error = block.centers_m - np.asarray(truth.poses.center)
    assert np.sqrt(np.mean(error**2)) < 0.05  # GNSS sigmas of 3 and 6 cm
    assert adjusted_hard.medians_px[-1] < 0.6


def test_a_wrong_edge_is_pruned_and_named(
    adjusted_hard: Adjusted, hard_and_edge: tuple[Simulated, tuple[int, int]]
) -> None:
    first, second = hard_and_edge[1]
    named = {edge.name: edge for edge in adjusted_hard.pruned}
    found = named[f"DJI_{first:04d}.JPG, DJI_{second:04d}.JPG"]
    assert found.median_px > found.limit_px == 3.0 and found.num_matches > 0
    assert len(named) <= 2  # an edge of a handful of matches may be wrong features for the most part


def test_wrong_features_are_rejected(adjusted_hard: Adjusted, hard: Simulated) -> None:
    block, wrong = adjusted_hard.block, hard.survey.truth.is_outlier
    true_px = {tuple(xy) for xy in np.asarray(hard.survey.problem.observations.xy_px)[wrong].round(6)}
    kept = sum(tuple(xy) in true_px for xy in block.observation_xy_px.round(6))
    assert kept < 0.03 * wrong.sum()


def test_rounds_are_deterministic(clean: Simulated, adjusted_clean: Adjusted) -> None:
    again = _run(clean)
    for name in ("quaternion", "translation_m", "camera_parameters", "points_m", "observation_xy_px"):
        np.testing.assert_array_equal(getattr(again.block, name), getattr(adjusted_clean.block, name))


def test_early_rounds_end_early_and_the_last_at_the_optimum(clean: Simulated, monkeypatch: pytest.MonkeyPatch) -> None:
    # breaks where a round that settles keeps the end of an early one, at 1e-4 of the cost
    solves = []
    monkeypatch.setattr(_rounds, "solve", lambda *a, **options: solves.append(options) or solve(*a, **options))
    found = _run(clean, max_rounds=9)  # it settles before
    ends = [options["ftol"] for options in solves]
    assert ends[0] == 1e-4 and ends[-1] == Settings().ftol and set(ends) == {1e-4, Settings().ftol}
    assert len(ends) == len(found.medians_px) + 1  # the round that settled went on
    plan = solves[-1]["plan"]  # whose programs are there
    history = solve(found.problem, loss=found.loss, plan=plan, ftol=1e-13, xtol=1e-12).report.history
    assert history[0].cost - history[-1].cost < 1e-9 * history[0].cost


IN_TILES = Tiling(chunk_size=5)


def test_a_block_in_tiles_is_that_in_one_piece(
    clean: Simulated, adjusted_clean: Adjusted, sigmas: Uncertainty, monkeypatch: pytest.MonkeyPatch
) -> None:
    # breaks where a tile loses an observation, a round ends elsewhere, or tiles are not asked for
    solves = []
    monkeypatch.setattr(
        _rounds, "solve_tiled", lambda *a, **options: solves.append(options) or solve_tiled(*a, **options)
    )
    tiled = _run(clean, IN_TILES)
    assert len(solves) >= len(tiled.medians_px) and {options["num_tiles"] for options in solves} == {3}
    assert tiled.block.num_observations == adjusted_clean.block.num_observations
    np.testing.assert_allclose(tiled.medians_px, adjusted_clean.medians_px, atol=1e-7)
    np.testing.assert_allclose(tiled.block.centers_m, adjusted_clean.block.centers_m, atol=1e-6)
    np.testing.assert_allclose(tiled.block.points_m, adjusted_clean.block.points_m, atol=1e-6)
    of_tiles = uncertainty(tiled, clean.reference)
    np.testing.assert_allclose(of_tiles.point_std_m, sigmas.point_std_m, atol=1e-6)
    np.testing.assert_allclose(of_tiles.position_std_m, sigmas.position_std_m, atol=1e-6)


@pytest.mark.parametrize("tiling", [None, IN_TILES], ids=["in one piece", "in tiles"])
def test_ctrl_c_ends_the_rounds(clean: Simulated, tiling: Tiling | None, monkeypatch: pytest.MonkeyPatch) -> None:
    # breaks where a round goes on from what a solve had reached when it was interrupted
    def press(*_: object) -> NoReturn:
        raise KeyboardInterrupt

    monkeypatch.setattr(_descend, "_history_step", press)
    with pytest.raises(KeyboardInterrupt):
        _run(clean, tiling)


def test_rounds_that_were_stopped_go_on_to_the_same_bytes(
    clean: Simulated, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    # breaks where a solve's beginning depends on what was broken off, where steps are taken again, or progress is false
    def steps_of(stop_at: tuple[int, int] | None = None) -> list[tuple[int, int]]:
        steps, plain = [], _rounds._Told.step

        def step(told: _rounds._Told, tried: HistoryStep) -> None:
            plain(told, tried)
            steps.append((told.round, tried.step))
            if steps[-1] == stop_at:
                raise KeyboardInterrupt

        monkeypatch.setattr(_rounds._Told, "step", step)
        found.append(None)
        with contextlib.suppress(KeyboardInterrupt):
            found[-1] = _run(clean, replace(IN_TILES, folder=tmp_path if stop_at or len(found) > 1 else None))
        monkeypatch.setattr(_rounds._Told, "step", plain)
        return steps

    found: list[Adjusted | None] = []
    caplog.set_level("INFO", "jaxba.sfm")
    monkeypatch.setattr(_rounds, "_TELL_EVERY_S", 0.0)
    whole = steps_of()
    assert "round 1, step 2, 50% of 3 tiles" in caplog.text and "round 1, step 2, 100% of 3 tiles" in caplog.text
    stop_at = next(pair for pair in whole if pair[0] == 2)
    assert steps_of(stop_at) == whole[: whole.index(stop_at) + 1] and found[1] is None
    assert steps_of() == whole[whole.index(stop_at) + 1 :]
    once, again = found[0], found[2]
    assert once is not None and again is not None
    for name in ("centers_m", "points_m", "camera_parameters", "observation_xy_px"):
        np.testing.assert_array_equal(getattr(once.block, name), getattr(again.block, name))
    assert once.medians_px == again.medians_px and once.solution.result == again.solution.result


def test_no_step_of_scipy_lowers_the_cost() -> None:
    tiny = simulate(3, seed=1, points_per_image=25.0, num_check=0, terrain_relief_m=20.0, num_lines=1)
    found = _run(tiny, loss="linear")
    block = found.block
    cost = _cost(found)
    start = np.zeros(6 * block.num_images + 3 * block.num_points + 9)
    first = cost(start)
    scale = np.concatenate([np.tile([1e-4, 1e-4, 1e-4, 1e-2, 1e-2, 1e-2], 3), np.full(3 * block.num_points, 1e-2),
                            [1, 1, 1, 1, 1e-3, 1e-3, 1e-4, 1e-4, 1e-9]])  # fmt: skip
    better = least_squares(cost, start, x_scale=scale, max_nfev=20, xtol=1e-12, ftol=1e-12)
    assert float(first @ first) / 2 == pytest.approx(float(found.solution.final_cost), rel=1e-6)
    assert 2 * better.cost > float(first @ first) * (1 - 1e-5)


def _priors(found: Adjusted) -> dict[str, Any]:
    return {prior.name: prior for prior in found.problem.priors}


def _cost(found: Adjusted) -> Callable[[np.ndarray], np.ndarray]:
    """Residuals in plain numpy: pixels by OpenCV's formulas, then every prior, about the adjusted values."""
    block, priors = found.block, _priors(found)
    rotation0 = Rotation.from_quat(block.quaternion, scalar_first=True)
    image, point = block.observation_image, block.observation_point

    def residual(x: np.ndarray) -> np.ndarray:
        n = block.num_images
        pose, points = x[: 6 * n].reshape(n, 6), block.points_m + x[6 * n : -9].reshape(-1, 3)
        rotation = Rotation.from_rotvec(pose[:, :3]) * rotation0
        translation = Rotation.from_rotvec(pose[:, :3]).apply(block.translation_m) + pose[:, 3:]
        camera = block.camera_parameters[0] + x[-9:]
        fx, fy, cx, cy, k1, k2, p1, p2, k3 = camera
        a, b, c = (rotation[image].apply(points[point]) + translation[image]).T
        a, b = a / c, b / c
        r2 = a * a + b * b
        radial = 1 + k1 * r2 + k2 * r2**2 + k3 * r2**3
        u = fx * (a * radial + 2 * p1 * a * b + p2 * (r2 + 2 * a * a)) + cx
        v = fy * (b * radial + p1 * (r2 + 2 * b * b) + 2 * p2 * a * b) + cy
        pixels = (np.stack([u, v], axis=1) - block.observation_xy_px) / found.std_px
        centers = -rotation.inv().apply(translation)
        gnss = (centers - priors["position"].xyz) / priors["position"].std_m
        z = np.sum(gnss**2, axis=1) / 16  # Geman-McClure at four sigmas
        gnss *= np.sqrt(1 / (1 + z))[:, None]
        parts = [pixels.ravel(), gnss.ravel()]
        parts.append((camera - priors["intrinsics"].parameters[0]) / priors["intrinsics"].std[0])
        parts.append([(fx / fy - 1) / priors["aspect"].std[0]])
        if "attitude" in priors:
            turn = (rotation * Rotation.from_quat(priors["attitude"].quaternion, scalar_first=True).inv()).as_rotvec()
            turn = turn / priors["attitude"].std_rad
            s = np.sum(turn**2, axis=1) / 9  # Cauchy at three sigmas
            parts.append((turn * np.sqrt(np.log1p(s) / np.where(s > 0, s, 1))[:, None]).ravel())
        return np.concatenate(parts)

    return residual


def test_images_without_a_position_are_adjusted(adjusted_hard: Adjusted, hard: Simulated) -> None:
    error = adjusted_hard.block.centers_m - np.asarray(hard.survey.truth.poses.center)
    assert np.abs(error[WITHOUT]).max() < 0.15


def test_an_image_that_loses_its_points_is_named(clean: Simulated) -> None:
    xy = clean.tracks.xy_px.copy()
    mine = clean.tracks.image_index == 6
    xy[mine] = np.random.default_rng(0).uniform([100, 100], [5300, 3500], (mine.sum(), 2))
    found = _run(replace(clean, tracks=replace(clean.tracks, xy_px=xy)), max_rounds=3)
    assert [left.name for left in found.lost] == ["DJI_0006.JPG"]
    assert 6 not in found.block.image_index and found.block.num_images == 11
    assert found.block.unregistered[-1].name == "DJI_0006.JPG"
    truth = np.asarray(clean.survey.truth.poses.center)[found.block.image_index]
    assert np.sqrt(np.mean((found.block.centers_m - truth) ** 2)) < 0.06


def test_without_gnss_the_block_keeps_its_start_frame(clean: Simulated) -> None:
    found = _run(replace(clean, block=replace(clean.block, is_georeferenced=False)), max_rounds=2)
    truth = np.asarray(clean.survey.truth.poses.center)
    # a similarity takes it to the truth: seven parameters
    a, b = found.block.centers_m - found.block.centers_m.mean(axis=0), truth - truth.mean(axis=0)
    u, s, vt = np.linalg.svd(b.T @ a)
    scale, turn = s.sum() / np.sum(a**2), u @ np.diag([1, 1, np.linalg.det(u @ vt)]) @ vt
    assert np.sqrt(np.mean((scale * a @ turn.T - b) ** 2)) < 0.1
    none = uncertainty(found, clean.reference)
    assert np.isnan(none.position_std_m).all() and none.why_not is not None and "no scale" in none.why_not
    assert np.isfinite(none.intrinsics_std).all()


def test_tracks_fall_apart_where_a_pruned_edge_held_them() -> None:
    # images 0-1-2-3 in one track, joined by the edges 0-1, 1-2, 2-3
    tracks = Tracks(
        track_index=np.zeros(4, int), image_index=np.arange(4), feature_index=np.array([5, 6, 7, 8]),
        xy_px=np.zeros((4, 2)), rgb=np.array([[1, 2, 3]], np.uint8), components=((0, 1, 2, 3),),
    )  # fmt: skip
    graph = view_graph_of(tracks)
    chain = graph.select(np.diff(graph.pairs, axis=1)[:, 0] == 1)
    split, _ = without_edges(tracks, match_rows(chain, tracks), np.array([False, True, False]))
    assert split.track_index.tolist() == [0, 0, 1, 1] and split.feature_index.tolist() == [5, 6, 7, 8]
    assert split.rgb.tolist() == [[1, 2, 3], [1, 2, 3]]
    end, _ = without_edges(tracks, match_rows(chain, tracks), np.array([True, False, False]))
    assert end.image_index.tolist() == [1, 2, 3]


def test_tracks_are_completed_also_after_an_edge_was_pruned() -> None:
    whole = simulate(12, seed=4, points_per_image=60.0, mean_track_length=4.0)
    index = whole.tracks.track_index
    place = np.arange(len(index)) - np.searchsorted(index, index)
    cut = with_wrong_edge(replace(whole, tracks=reduced(whole.tracks, place < 2, index)), (0, 2), 20.0)
    settings = Settings(max_rounds=4)
    given = cut.block, cut.tracks, cut.view_graph, cut.reference, cut.photos, settings
    without, completed = adjust(*given), adjust(*given, features_of(whole, 1))
    assert len(completed.pruned) == len(without.pruned) == 1
    assert _seen_thrice(without.block) == 0
    assert _seen_thrice(completed.block) > 0.7 * np.count_nonzero(np.bincount(index) >= 3)
    off = replace(settings, complete_radius=0.0)
    assert adjust(*given[:-1], off, features_of(whole, 1)).block.num_observations == without.block.num_observations


def _seen_thrice(block: Block) -> int:
    return int(np.count_nonzero(np.bincount(block.observation_point) >= 3))


def test_a_single_image_is_refused(clean: Simulated) -> None:
    one = replace(
        clean.block, image_index=np.array([0]), quaternion=clean.block.quaternion[:1],
        translation_m=clean.block.translation_m[:1], camera_index=np.array([0]),
    )  # fmt: skip
    assert isinstance(one, Block)
    with pytest.raises(JaxbaError, match="1 images with start values"):
        adjust(one, clean.tracks, clean.view_graph, clean.reference, clean.photos, Settings())
