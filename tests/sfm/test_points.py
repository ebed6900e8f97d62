"""Triangulation of tracks against simulated truth and against the minimum of the reprojection error."""

from dataclasses import fields, replace
from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from jaxba import JaxbaError
from jaxba.geometry import OpenCV
from jaxba.scene import Block
from jaxba.sfm import _edges, _points, _uncertainty, with_points
from jaxba.sfm._edges import edge_medians_px, match_rows
from jaxba.sfm._points import Triangulated, apply_points, triangulate_tracks
from jaxba.sfm._uncertainty import own_variance
from jaxba.simulation.staged import Simulated, simulate, true_block

ANGLE = 0.02


@pytest.fixture(scope="module")
def exact() -> Simulated:
    return simulate(8, seed=2, pixel_std_px=0.0)


@pytest.fixture(scope="module")
def noisy() -> Simulated:
    return simulate(30, seed=3, pixel_std_px=0.5, outlier_fraction=0.1)


def test_exact_pixels_give_the_true_points(exact: Simulated) -> None:
    block = with_points(true_block(exact), exact.tracks, min_angle_rad=ANGLE, max_error_px=1.0)
    assert block.num_points == exact.tracks.num_tracks
    assert block.num_observations == exact.tracks.num_observations
    # rounding of a pixel, 1e-12 of 5000 px, over a small angle
    np.testing.assert_allclose(block.points_m, exact.survey.truth.points[block.track_index], atol=1e-6)
    np.testing.assert_array_equal(block.rgb, exact.tracks.rgb[block.track_index])
    assert np.all(np.diff(block.observation_point) >= 0)


def test_points_minimise_the_reprojection_error(noisy: Simulated) -> None:
    block = with_points(true_block(noisy), noisy.tracks, min_angle_rad=0.1, max_error_px=2.0)
    for point in (0, 100, 500, 900):
        rows = np.flatnonzero(block.observation_point == point)
        image = block.observation_image[rows]
        found = least_squares(_residual(block, image, block.observation_xy_px[rows]), block.points_m[point], xtol=1e-12)
        # linear about the measured pixel: exact at an error of zero, 1% of the point's sigma of some cm at a pixel
        np.testing.assert_allclose(block.points_m[point], found.x, atol=5e-4)


def _residual(block: Block, image: np.ndarray, xy_px: np.ndarray) -> Any:
    rotation = Rotation.from_quat(block.quaternion[image], scalar_first=True).as_matrix()
    camera = OpenCV(*block.camera_parameters[0])

    def residual(x: np.ndarray) -> np.ndarray:
        in_cam = rotation @ x + block.translation_m[image]
        return np.asarray(camera.project(jnp.asarray(in_cam)) - xy_px).ravel()

    return residual


def test_tracks_survive_one_wrong_feature(noisy: Simulated) -> None:
    truth, tracks = noisy.survey.truth, noisy.tracks
    found = triangulate_tracks(true_block(noisy), tracks, ANGLE, 2.5)
    wrong = truth.is_outlier
    used = np.zeros(tracks.num_observations, bool)
    used[found.row[found.is_used & found.is_point[found.of_track]]] = True
    # wrong ones that happen to lie along the epipolar line of a two-view track cannot be told
    assert np.count_nonzero(used & wrong) <= 0.02 * np.count_nonzero(wrong)
    good = np.bincount(tracks.track_index[~wrong], minlength=tracks.num_tracks)
    survivors = found.is_point[good[found.track_index] >= 3]
    assert survivors.mean() > 0.995
    errors = np.linalg.norm(found.point_m - truth.points[found.track_index], axis=1)[found.is_point]
    assert np.percentile(errors, 98) < 1.0  # at 100 m


def test_every_kept_observation_is_within_the_limit_and_ahead(noisy: Simulated) -> None:
    block = with_points(true_block(noisy), noisy.tracks, min_angle_rad=ANGLE, max_error_px=1.5)
    counts = np.bincount(block.observation_point, minlength=block.num_points)
    assert counts.min() == 2 < counts.max()
    rotation = Rotation.from_quat(block.quaternion, scalar_first=True)[block.observation_image]
    in_cam = rotation.apply(block.points_m[block.observation_point]) + block.translation_m[block.observation_image]
    assert in_cam[:, 2].min() > 0
    pixel = np.asarray(OpenCV(*block.camera_parameters[0]).project(jnp.asarray(in_cam)))
    assert np.linalg.norm(pixel - block.observation_xy_px, axis=1).max() < 1.5 * 1.001


def test_only_registered_images_count(exact: Simulated) -> None:
    block = true_block(exact)
    part = replace(
        block,
        image_index=block.image_index[[1, 2, 5]],
        quaternion=block.quaternion[[1, 2, 5]],
        translation_m=block.translation_m[[1, 2, 5]],
        camera_index=block.camera_index[[1, 2, 5]],
    )
    found = with_points(part, exact.tracks, min_angle_rad=ANGLE, max_error_px=1.0)
    assert found.num_points > 50
    np.testing.assert_allclose(found.points_m, exact.survey.truth.points[found.track_index], atol=1e-6)
    registered = np.isin(exact.tracks.image_index, [1, 2, 5])
    times = np.bincount(exact.tracks.track_index[registered], minlength=exact.tracks.num_tracks)
    np.testing.assert_array_equal(found.track_index, np.flatnonzero(times >= 2))


def test_points_at_a_small_angle_are_left_out(exact: Simulated) -> None:
    every = triangulate_tracks(true_block(exact), exact.tracks, 0.0, 1.0)
    few = triangulate_tracks(true_block(exact), exact.tracks, 0.5, 1.0)
    assert 0 < few.is_point.sum() < every.is_point.sum()
    assert few.is_used.all()  # they fit; the angle alone leaves them out


def test_points_behind_the_cameras_are_left_out(exact: Simulated) -> None:
    block = true_block(exact)
    mirrored = replace(block, translation_m=-block.translation_m)  # centres mirrored: rays meet behind
    assert with_points(mirrored, exact.tracks, min_angle_rad=ANGLE, max_error_px=1.0).num_points == 0


def test_pieces_give_what_one_piece_gives(noisy: Simulated, monkeypatch: pytest.MonkeyPatch) -> None:
    # breaks where a track or a match is cut, or taken from a neighbour's rows
    block, tracks = true_block(noisy), noisy.tracks
    num_edges = len(noisy.view_graph.pairs)

    def made() -> tuple[Triangulated, np.ndarray, np.ndarray]:
        found = triangulate_tracks(block, tracks, ANGLE, 2.0, by_redundancy=True)
        medians = edge_medians_px(match_rows(noisy.view_graph, tracks), found, block, tracks, num_edges)
        return found, medians, own_variance(apply_points(block, tracks, found), 0.5)

    whole, medians, variance = made()
    assert np.isfinite(medians).any()
    for module, rows in ((_points, 2000), (_edges, 5000), (_uncertainty, 3001)):
        monkeypatch.setattr(module, "_PIECE", rows)
    cut, cut_medians, cut_variance = made()
    for field in fields(Triangulated):
        np.testing.assert_array_equal(getattr(cut, field.name), getattr(whole, field.name), err_msg=field.name)
    np.testing.assert_array_equal(cut_medians, medians)
    np.testing.assert_array_equal(cut_variance, variance)


def test_limits_out_of_range_are_refused(exact: Simulated) -> None:
    with pytest.raises(JaxbaError, match="max_error_px=0"):
        with_points(exact.block, exact.tracks, min_angle_rad=ANGLE, max_error_px=0.0)
