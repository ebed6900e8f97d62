"""Footprints and their overlaps against areas counted by projecting a grid of ground points, and closed forms."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jaxba.scene import Attitude, Footprints, cam_from_enu, footprint_overlaps, footprint_pairs, ground_footprints
from jaxba.scene._candidates import joining_pairs, nearest_pairs, window_pairs
from jaxba.scene._graph import components

SIZE = np.array([4000.0, 3000.0])
FOCAL = 3000.0
DOWN = Rotation.from_matrix(np.diag([1.0, -1.0, -1.0]))


def footprints(xyz_m, rotation=None, height_m=50.0, margin_m=0.0) -> Footprints:
    count = len(xyz_m)
    quaternion = np.full((count, 4), np.nan) if rotation is None else rotation.as_quat(scalar_first=True)
    heights, margins = np.full(count, float(height_m)), np.full(count, float(margin_m))
    sizes = np.tile(SIZE, (count, 1))
    return ground_footprints(sizes, np.full(count, FOCAL), np.asarray(xyz_m, float), quaternion, heights, margins)


def looking_north(pitch_deg: float) -> Rotation:
    attitude = Attitude(yaw_deg=0.0, pitch_deg=pitch_deg, roll_deg=0.0)
    return Rotation.from_matrix(cam_from_enu(attitude)[None])


def is_seen(ground, center, rotation) -> np.ndarray:
    """Project points of the ground into a photo."""
    in_cam = rotation.apply(ground - center)
    xy_px = FOCAL * in_cam[:, :2] / np.where(in_cam[:, 2:] > 0, in_cam[:, 2:], np.nan) + SIZE / 2
    return np.all((xy_px >= 0) & (xy_px <= SIZE), axis=1)


def test_overlap_is_the_share_of_ground_points_that_both_photos_show():
    rng = np.random.default_rng(0)
    tilts = Rotation.from_euler("xyz", rng.normal(size=(8, 3)) * [0.25, 0.25, 2.0])
    rotation = tilts * DOWN
    centers = np.column_stack([rng.uniform(-25, 25, size=(8, 2)), np.full(8, 50.0)])
    grid = np.stack(np.meshgrid(np.arange(-150, 150, 0.5), np.arange(-150, 150, 0.5)), axis=-1).reshape(-1, 2)
    ground = np.column_stack([grid, np.zeros(len(grid))])
    seen = [is_seen(ground, center, turn) for center, turn in zip(centers, rotation, strict=True)]
    pairs = np.stack(np.triu_indices(8, 1), axis=1)
    counted = [(seen[i] & seen[j]).sum() / min(seen[i].sum(), seen[j].sum()) for i, j in pairs]
    # a grid of 0.5 m counts an area of 3000 square metres to about 0.3 percent
    np.testing.assert_allclose(footprint_overlaps(footprints(centers, rotation), pairs), counted, atol=0.01)


def test_level_photos_overlap_as_rectangles_do():
    xyz_m = np.array([[0, 0, 9], [20, 0, 9], [20, 30, 9], [500, 0, 9]])
    pairs = np.array([[0, 1], [0, 2], [1, 2], [0, 3]])
    width, height = SIZE / FOCAL * 50
    expected = [1 - 20 / width, (1 - 20 / width) * (1 - 30 / height), 1 - 30 / height, 0]
    level = Rotation.concatenate([DOWN] * 4)
    np.testing.assert_allclose(footprint_overlaps(footprints(xyz_m, level), pairs), expected, atol=1e-12)


def test_without_attitude_photos_overlap_as_circles_through_the_corners_do():
    radius = np.hypot(*(SIZE / 2 / FOCAL)) * 50
    half = 20 / 2 / radius
    lens = 2 * (np.arccos(half) - half * np.sqrt(1 - half**2)) / np.pi
    overlap = footprint_overlaps(footprints([[0, 0, 9], [12, 16, 9]]), np.array([[0, 1]]))
    np.testing.assert_allclose(overlap, lens, atol=0.005)  # a polygon of 24 corners stands for the circle


@pytest.mark.parametrize("pitch_deg", [-45.0, -20.0, 0.0])
def test_rays_near_and_over_the_horizon_end_at_a_largest_distance_ahead(pitch_deg):
    outline = footprints([[0, 0, 0]], looking_north(pitch_deg)).outline_m[0]
    reach = 50 * np.tan(np.deg2rad(70))
    assert np.linalg.norm(outline, axis=1).max() == pytest.approx(reach)
    # the lower edge of the frame, at atan(1500 / 3000) below the axis, meets the ground or the same limit
    near = 50 / np.tan(np.deg2rad(-pitch_deg) + np.arctan(0.5))
    assert outline[:, 1].min() == pytest.approx(near, rel=0.02)
    assert outline[:, 1].max() > near


def test_a_photo_of_the_sky_has_no_footprint():
    assert not footprints([[0, 0, 0]], looking_north(30.0)).is_known.any()


def test_what_is_not_known_makes_a_footprint_unknown_and_its_overlap_nan():
    prints = footprints([[0, 0, 9], [np.nan, 0, 9], [1, 0, 9]])
    assert prints.is_known.tolist() == [True, False, True]
    assert np.isnan(footprint_overlaps(prints, np.array([[0, 1], [0, 2]]))).tolist() == [True, False]
    assert footprint_pairs(prints, 0.1)[0].tolist() == [[0, 2]]
    assert not footprints([[0, 0, 9]], height_m=0.0).is_known.any()
    assert not footprints([[0, 0, 9]], margin_m=np.inf).is_known.any()


@pytest.mark.parametrize("margin_m", [0.0, 4.0])
def test_pairs_are_all_whose_overlap_within_the_margin_reaches_the_least(margin_m):
    rng = np.random.default_rng(1)
    xyz_m = rng.uniform(0, 300, size=(60, 3))
    level = Rotation.concatenate([DOWN] * 60)
    found, _ = footprint_pairs(footprints(xyz_m, level, margin_m=margin_m), 0.3)
    i, j = np.triu_indices(60, 1)
    step = xyz_m[i, :2] - xyz_m[j, :2]
    distance = np.linalg.norm(step, axis=1)
    step *= np.maximum(0, 1 - np.sqrt(2) * margin_m / distance)[:, None]
    overlap = np.prod(np.maximum(0, 1 - np.abs(step) / (SIZE / FOCAL * 50)), axis=1)
    assert found.tolist() == np.stack([i, j], axis=1)[overlap >= 0.3].tolist()


def test_nearest_pairs_are_those_of_all_distances_sorted():
    xy_m = np.random.default_rng(2).uniform(size=(40, 2))
    distance = np.linalg.norm(xy_m[:, None] - xy_m, axis=-1) + 9 * np.eye(40)
    expected = {(min(i, int(j)), max(i, int(j))) for i in range(40) for j in np.argsort(distance[i])[:5]}
    assert set(map(tuple, nearest_pairs(xy_m, 5).tolist())) == expected


def test_nearest_pairs_of_many_photos_at_one_place():
    found = nearest_pairs(np.zeros((30, 2)), 4)
    assert np.all(found[:, 0] < found[:, 1])
    assert np.bincount(found.reshape(-1), minlength=30).min() >= 4


def test_window_pairs_stand_at_most_the_window_apart():
    order = np.random.default_rng(3).permutation(20)
    place = np.argsort(order)
    expected = [[i, j] for i in range(20) for j in range(i + 1, 20) if abs(place[i] - place[j]) <= 3]
    assert window_pairs(order, 3).tolist() == expected
    assert window_pairs(np.arange(1), 3).shape == window_pairs(np.arange(0), 3).shape == (0, 2)


def test_joining_pairs_leave_one_group():
    rng = np.random.default_rng(4)
    xy_m = np.concatenate([rng.uniform(size=(9, 2)) + np.array([50 * k, 0]) for k in range(4)])
    pairs = nearest_pairs(xy_m, 3)
    assert len(components(pairs, 36)) >= 4
    joining = joining_pairs(pairs, xy_m, 2)
    assert len(components(np.concatenate([pairs, joining]), 36)) == 1
    assert np.ptp(xy_m[joining, 0], axis=1).max() < 52  # neighbouring groups are joined, none across another
    assert joining_pairs(np.stack(np.triu_indices(36, 1), axis=1), xy_m, 2).shape == (0, 2)
