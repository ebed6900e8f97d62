from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from hypothesis.extra import numpy as hnp

from jaxba.vision import decode, measure_image
from jaxba.vision._statistics import _has_two_peaks


def noise(height: int = 600, width: int = 800, sigma_px: float = 1.5, levels: float = 30.0) -> np.ndarray:
    """Return texture without direction."""
    blurred = cv2.GaussianBlur(np.random.default_rng(0).normal(size=(height, width)), (0, 0), sigma_px)
    return 128 + levels * blurred / blurred.std()


def stripes(angle_deg: float, period_px: float, height: int = 600, width: int = 800) -> np.ndarray:
    y, x = np.mgrid[:height, :width]
    along = x * np.cos(np.deg2rad(angle_deg)) + y * np.sin(np.deg2rad(angle_deg))
    return 40 * np.sin(2 * np.pi * along / period_px)


def as_gray(levels: np.ndarray) -> np.ndarray:
    return np.clip(np.rint(levels), 0, 255).astype(np.uint8)


@pytest.mark.parametrize("angle_deg", [0.0, 30.0, 90.0, 135.0])
@pytest.mark.parametrize("period_px", [8.0, 20.0])
def test_stripes_in_noise_repeat_at_any_angle(angle_deg: float, period_px: float) -> None:
    found = measure_image(as_gray(noise(levels=12) + stripes(angle_deg, period_px)))
    assert found.repeating_share > 0.9 and found.flat_share == 0


def test_a_grid_of_panels_repeats_though_its_edges_run_both_ways() -> None:
    y, x = np.mgrid[:600, :800]
    panels = 90 + 70 * ((x % 24 > 4) & (y % 24 > 4)) + 0.1 * noise()
    assert measure_image(as_gray(panels)).repeating_share > 0.9


def test_parallel_edges_at_uneven_distances_and_texture_do_not_repeat() -> None:
    assert measure_image(as_gray(noise())).repeating_share == 0
    for seed in range(5):
        lanes = np.cumsum(np.random.default_rng(seed).uniform(12, 60, 60)).astype(int)
        uneven = np.zeros(800)
        for k, x in enumerate(lanes[lanes < 800]):
            uneven[x:] = 60 * (k % 2)
        assert measure_image(as_gray(0.6 * noise() + uneven)).repeating_share < 0.1


def test_water_is_flat_in_spite_of_sensor_noise_and_a_gradient_of_light() -> None:
    y, x = np.mgrid[:600, :800]
    grain = np.random.default_rng(0).normal(size=(600, 800))
    water = 80 + 0.1 * x + 0.05 * y + grain
    assert measure_image(as_gray(water)).flat_share == 1
    assert measure_image(as_gray(noise())).flat_share == 0
    shore = np.where(x < 400, water, noise())
    assert measure_image(as_gray(shore)).flat_share == pytest.approx(0.5, abs=0.05)


@pytest.mark.parametrize("period_px", [2, 3, 4, 5, 6])
@pytest.mark.parametrize("duty_px", [1, 2])
@pytest.mark.parametrize("kind", ["columns", "rows", "checks"])
def test_patterns_of_a_few_pixels_are_measured(period_px: int, duty_px: int, kind: str) -> None:
    x = np.where(np.arange(400) % period_px < duty_px, 200.0, 40.0)
    pattern = {"columns": np.tile(x, (400, 1)), "rows": np.tile(x[:, None], 400), "checks": np.abs(x[:, None] - x)}
    found = measure_image(as_gray(pattern[kind] + 0.2 * noise(400, 400)))
    assert 0 <= found.repeating_share <= 1


@given(hnp.arrays(float, st.integers(4, 96), elements=st.floats(-1, 1)))
@settings(max_examples=200)
def test_any_autocorrelation_has_two_peaks_or_has_not(profile: np.ndarray) -> None:
    assert _has_two_peaks(profile) in (True, False)


@pytest.mark.parametrize("period", [2, 3, 4, 8])
def test_a_pattern_of_any_period_has_two_peaks(period: int) -> None:
    profile = np.where(np.arange(48) % period == 0, 0.9, 0.0)
    assert _has_two_peaks(profile)


@pytest.mark.parametrize("shape", [(1, 1), (1, 40), (2, 2), (3, 191), (17, 900), (200, 200)])
@pytest.mark.parametrize("seed", range(3))
def test_frames_of_any_shape_are_measured(shape: tuple[int, int], seed: int) -> None:
    frame = np.random.default_rng(seed).integers(0, 256, shape).astype(np.uint8)
    found = measure_image(frame)
    assert 0 <= found.flat_share <= 1 and 0 <= found.repeating_share <= 1


def test_brightness_is_the_mean() -> None:
    assert measure_image(as_gray(noise(levels=12) - 70)).mean_brightness == pytest.approx(58, abs=0.2)


@pytest.mark.parametrize("value", [0, 255])
@pytest.mark.parametrize("shape", [(600, 800), (100, 90), (20, 20)])
def test_a_blank_frame_is_flat_and_does_not_repeat(value: int, shape: tuple[int, int]) -> None:
    found = measure_image(np.full(shape, value, np.uint8))
    assert (found.mean_brightness, found.flat_share, found.repeating_share) == (value, 1, 0)


def test_size_of_the_frame_changes_little() -> None:
    field = as_gray(noise(levels=12) + stripes(30, 16))
    double = cv2.resize(field, None, fx=3, fy=3, interpolation=cv2.INTER_CUBIC)
    assert measure_image(double).repeating_share == pytest.approx(measure_image(field).repeating_share, abs=0.1)


def test_a_ploughed_field_repeats_and_a_forest_does_not(data_dir: Path) -> None:
    shares = {}
    for name in ("seneca40", "brighton"):
        paths = sorted(p for p in (data_dir / "images" / name).iterdir() if p.suffix.lower() == ".jpg")[::6]
        shares[name] = [measure_image(decode(path).gray).repeating_share for path in paths]
    assert min(shares["seneca40"]) > max(shares["brighton"]) and np.median(shares["seneca40"]) > 0.3
    assert max(shares["brighton"]) < 0.05
