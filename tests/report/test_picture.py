"""The picture of the cloud: size, sameness, and that what is drawn is there."""

import io
import sys
from dataclasses import replace

import numpy as np
import pytest
from PIL import Image

from jaxba.report import Picture, draw_picture


def picture(num_points: int = 3000) -> Picture:
    rng = np.random.default_rng(0)
    xyz = rng.uniform([565_000, 5_184_000, 200], [565_120, 5_184_080, 210], (num_points, 3))
    return Picture(
        xyz=xyz,
        rgb=np.full((num_points, 3), [0, 160, 0], np.uint8),
        error_px=rng.rayleigh(0.3, num_points),
        camera_xyz=rng.uniform([565_000, 5_184_000, 260], [565_120, 5_184_080, 262], (9, 3)),
        title="9 photos", subtitle="heights", crs="WGS 84 / UTM zone 15N", unit="m", height_label="height (m)",
    )  # fmt: skip


def pixels(png: bytes) -> np.ndarray:
    return np.asarray(Image.open(io.BytesIO(png)).convert("RGB")).astype(int)


@pytest.mark.parametrize("num_points", [3000, 150_000])
def test_picture_has_its_size_and_is_small(num_points: int):
    rgb = np.random.default_rng(0).integers(60, 200, (num_points, 3)).astype(np.uint8)  # hard to compress
    png = draw_picture(replace(picture(num_points), rgb=rgb))
    assert pixels(png).shape == (900, 1600, 3)
    assert len(png) < 600_000


def test_same_cloud_gives_the_same_bytes_and_no_window_is_opened():
    assert draw_picture(picture()) == draw_picture(picture())
    assert "matplotlib.pyplot" not in sys.modules


def test_points_have_their_colour_and_the_flight_is_drawn():
    shown = pixels(draw_picture(picture()))
    left, right = shown[:, :1010], shown[:, 1010:]
    assert np.all(left == [0, 160, 0], axis=2).sum() > 30_000
    assert not np.all(right == [0, 160, 0], axis=2).any()
    assert np.all(left == [255, 90, 54], axis=2).sum() > 500


@pytest.mark.parametrize(
    "changes",
    [
        {"camera_xyz": np.zeros((0, 3))},
        {"error_px": np.full(3000, np.nan)},
        {"unit": "", "crs": "arbitrary frame and scale"},
        {"xyz": picture().xyz * [1, 1, 0] + [0, 0, 5]},
        {"xyz": np.concatenate([picture().xyz[1:], [[9e5, 9e6, 1e4]]])},
        {"xyz": picture().xyz * [1e-3, 1, 1] + [565, 0, 0]},
    ],
    ids=["no cameras", "no errors", "no place", "flat", "an outlier", "narrow"],
)
def test_odd_clouds_are_drawn_too(changes: dict):
    shown = pixels(draw_picture(replace(picture(), **changes)))
    assert shown.shape == (900, 1600, 3)
    has_points, has_flight = (
        (np.abs(shown[:, :1010] - colour).max(axis=2) < 60).any() for colour in ([0, 160, 0], [255, 90, 54])
    )
    assert has_points and has_flight == ("camera_xyz" not in changes)


def test_outlier_does_not_shrink_the_picture():
    far = picture().xyz.copy()
    far[0] += 1e5
    green = [
        np.all(pixels(draw_picture(p)) == [0, 160, 0], axis=2).sum() for p in (picture(), replace(picture(), xyz=far))
    ]
    assert green[1] > 0.8 * green[0]  # a picture of the outlier would hold next to none
