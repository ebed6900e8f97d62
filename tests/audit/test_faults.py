"""Limits of faults: angles between rays, images beside all others, what is no fault."""

import numpy as np
import pytest

from jaxba.audit._faults import image_limits, images_off, is_fault, largest_angles_rad
from jaxba.audit._moved import MovedImages
from jaxba.scene import Block, Finding


def moved(over_sigma: np.ndarray, apart_px: np.ndarray) -> MovedImages:
    nothing = np.zeros(len(over_sigma))
    return MovedImages(shift=nothing, turn_rad=nothing, over_sigma=over_sigma, apart_px=apart_px)


def test_images_that_moved_by_chance_are_off_in_one_of_a_thousand_models():
    rng = np.random.default_rng(0)
    count = 0
    for _ in range(2000):
        by_chance = np.sqrt(rng.chisquare(3, 20))
        count += images_off(moved(by_chance, np.full(20, 9.0) + 100 * (by_chance > 3))).any()
    assert count <= 8  # 2 are expected


def test_images_that_all_moved_alike_are_not_off_and_one_of_them_that_moved_farther_is():
    sigmas, pixels = np.full(12, 40.0), np.full(12, 20.0)
    assert not images_off(moved(sigmas, pixels)).any()
    sigmas[4], pixels[4] = 600.0, 150.0
    assert np.flatnonzero(images_off(moved(sigmas, pixels))).tolist() == [4]
    pixels[4] = 90.0  # within 5 times the median
    assert not images_off(moved(sigmas, pixels)).any()
    limit_sigma, least_px = image_limits(moved(sigmas, pixels))
    assert least_px == pytest.approx(100.0)
    assert limit_sigma == pytest.approx(40 / 1.538 * 4.65, rel=0.01)


def test_a_shift_of_many_sigmas_that_no_pixel_shows_is_none():
    sigmas, pixels = np.ones(10), np.full(10, 0.01)
    sigmas[3], pixels[3] = 50.0, 0.9
    assert not images_off(moved(sigmas, pixels)).any()


def test_largest_angles_are_those_of_all_pairs_of_rays():
    rng = np.random.default_rng(1)
    centers = rng.normal(0, 5, (6, 3))
    points = rng.normal(0, 1, (40, 3)) + np.array([0, 0, 20])
    pairs = [(p, i) for p in range(40) for i in sorted(rng.choice(6, rng.integers(2, 6), replace=False))]
    point, image = np.array(pairs).T
    count = len(point)
    block = Block(
        image_index=np.arange(6), quaternion=np.tile([1.0, 0, 0, 0], (6, 1)), translation_m=-centers,
        camera_model="SIMPLE_PINHOLE", camera_names=("a",), camera_parameters=np.ones((1, 3)),
        camera_index=np.zeros(6, int), points_m=points, track_index=np.arange(40), rgb=np.zeros((40, 3), np.uint8),
        observation_image=image, observation_point=point, observation_xy_px=np.zeros((count, 2)),
        is_georeferenced=False,
    )  # fmt: skip
    expected = []
    for p in range(40):
        rays = points[p] - centers[image[point == p]]
        rays /= np.linalg.norm(rays, axis=1, keepdims=True)
        expected.append(max(np.arccos(np.clip(a @ b, -1, 1)) for a in rays for b in rays))
    np.testing.assert_allclose(largest_angles_rad(block), expected, rtol=0, atol=1e-7)


def test_notes_are_no_faults_and_what_control_contradicts_is():
    assert not is_fault(Finding.of("audit note", text="a"))
    assert not is_fault(Finding.of("few points", names=["a"], points=[3], least=20))
    assert is_fault(Finding.of("control labels exchanged", names=["a", "b"], apart_m=1.0, rivals=[]))
    assert is_fault(Finding.of("points behind", count=1, points=1, names=["a"]))
