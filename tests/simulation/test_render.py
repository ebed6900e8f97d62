"""Rendered pictures show each place of the ground where the camera model says, found again without the renderer."""

import cv2
import jax.numpy as jnp
import numpy as np
import pytest
from jaxtyping import Float

from jaxba._errors import JaxbaError
from jaxba.geometry import OpenCV, OpenCVFisheye, SimplePinhole
from jaxba.scene import Attitude, cam_from_enu
from jaxba.simulation import Ground, expose, ground_points, paint_ground, pixel_rays, render
from jaxba.simulation._flight import smooth_terrain
from jaxba.simulation._render import _between

SIZE_PX = (600, 450)
CAMERA = OpenCV(fx=506.0, fy=505.5, cx=303.4, cy=222.7, k1=-0.045, k2=0.015, p1=0.0006, p2=-0.0004)
FISHEYE = OpenCVFisheye(fx=420.0, fy=420.0, cx=303.4, cy=222.7, k1=0.02, k2=-0.01, k3=0.0, k4=0.0)
HILLS = smooth_terrain(np.random.default_rng(1), 12.0, 35.0)
CENTER_M = np.array([2.0, -3.0, 70.0])
DOWN, TILTED = (
    cam_from_enu(Attitude(yaw_deg=yaw, pitch_deg=pitch, roll_deg=roll))
    for yaw, pitch, roll in ((10.0, -88.0, 2.0), (-125.0, -62.0, 1.0))
)


def blobs(places_m: Float[np.ndarray, "n 2"], low_m: float, high_m: float, std_m: float) -> Ground:
    """Return a black ground with a white Gaussian spot at each place."""
    texel_m = 0.1
    at = low_m + (np.arange(round((high_m - low_m) / texel_m)) + 0.5) * texel_m
    picture = np.zeros((len(at), len(at)))
    for east, north in places_m:
        picture += np.outer(
            np.exp(-((at[::-1] - north) ** 2) / std_m**2 / 2), np.exp(-((at - east) ** 2) / std_m**2 / 2)
        )
    texture = np.repeat(np.rint(255 * picture).astype(np.uint8)[..., None], 3, axis=2)
    return Ground(HILLS, texture, low_m, high_m, texel_m)


def opencv_pixels(points_m: Float[np.ndarray, "n 3"], rotation: Float[np.ndarray, "3 3"]) -> Float[np.ndarray, "n 2"]:
    """Return OpenCV's projection through the same camera, which knows nothing of jaxba's."""
    matrix = np.array([[CAMERA.fx, 0, CAMERA.cx], [0, CAMERA.fy, CAMERA.cy], [0, 0, 1]])
    distortion = np.array([CAMERA.k1, CAMERA.k2, CAMERA.p1, CAMERA.p2])
    turn = cv2.Rodrigues(rotation)[0]
    return cv2.projectPoints(points_m, turn, -rotation @ CENTER_M, matrix, distortion)[0][:, 0]


@pytest.mark.parametrize("rotation", [DOWN, TILTED], ids=["down", "tilted"])
def test_spots_appear_where_opencv_projects_them(rotation: np.ndarray):
    points = ground_points(pixel_rays(CAMERA, SIZE_PX), rotation, CENTER_M, HILLS)
    places = points[8:-8:11, 8:-8:11, :2].reshape(-1, 2) + 0.037
    low, high = float(np.floor(points[..., :2].min())) - 1, float(np.ceil(points[..., :2].max())) + 1
    picture = render(blobs(places, low, high, 0.2), points[..., :2], SIZE_PX)[..., 0].astype(float)
    expected = opencv_pixels(np.column_stack([places, HILLS(places)]), rotation)
    y, x = np.mgrid[0.5 : SIZE_PX[1], 0.5 : SIZE_PX[0]]
    errors = []
    for px, py in expected:
        window = (np.abs(x - px) < 12) & (np.abs(y - py) < 12)
        weight = picture[window]
        errors.append([weight @ x[window] / weight.sum() - px, weight @ y[window] / weight.sum() - py])
    assert len(errors) >= 20
    # grey values are rounded, and a spot's centre of mass is not quite its centre's picture in perspective
    assert np.abs(errors).max() < 0.02
    assert np.abs(np.mean(errors, axis=0)).max() < 0.004


@pytest.mark.parametrize("rotation", [DOWN, TILTED], ids=["down", "tilted"])
def test_rays_meet_the_terrain_and_go_through_their_pixels(rotation: np.ndarray):
    points = ground_points(pixel_rays(CAMERA, SIZE_PX, 50.0), rotation, CENTER_M, HILLS).reshape(-1, 3)
    assert np.abs(points[:, 2] - HILLS(points[:, :2])).max() < 1e-5
    at = np.stack(np.meshgrid(np.linspace(0, 600, 13), np.linspace(0, 450, 10)), axis=-1).reshape(-1, 2)
    np.testing.assert_allclose(opencv_pixels(points, rotation), at, atol=1e-6)


@pytest.mark.parametrize("rotation", [DOWN, TILTED], ids=["down", "tilted"])
def test_ground_between_rays_is_as_if_each_pixel_had_its_own(rotation: np.ndarray):
    coarse = ground_points(pixel_rays(CAMERA, SIZE_PX), rotation, CENTER_M, HILLS)
    down, across = _between(coarse.shape[0], SIZE_PX[1], 2), _between(coarse.shape[1], SIZE_PX[0], 2)
    between = np.stack([(across @ (down @ coarse[..., axis]).T).T for axis in range(2)], axis=-1)
    column, row = np.random.default_rng(0).integers(0, [[2 * SIZE_PX[0]], [2 * SIZE_PX[1]]], size=(2, 2000))
    own = CAMERA.unproject(jnp.asarray(np.stack([(column + 0.5) / 2, (row + 0.5) / 2], axis=-1)))
    expected = ground_points(np.asarray(own), rotation, CENTER_M, HILLS)[:, :2]
    assert np.abs(between[row, column] - expected).max() < 5e-4  # metres; a pixel is 0.14 m or more


def test_a_fisheye_is_rendered_through_its_own_model():
    rays = pixel_rays(FISHEYE, SIZE_PX)
    points = ground_points(rays, DOWN, CENTER_M, HILLS)
    in_cam = (points - CENTER_M) @ DOWN.T
    at = np.stack(
        np.meshgrid(*(np.linspace(0, s, n) for s, n in zip(SIZE_PX, rays.shape[1::-1], strict=True))), axis=-1
    )
    found = cv2.fisheye.projectPoints(
        in_cam.reshape(-1, 1, 3),
        np.zeros(3),
        np.zeros(3),
        np.array([[420.0, 0, 303.4], [0, 420.0, 222.7], [0, 0, 1]]),
        np.array([0.02, -0.01, 0.0, 0.0]),
    )[0]
    np.testing.assert_allclose(found[:, 0], at.reshape(-1, 2), atol=1e-6)


def test_pixel_is_the_mean_of_the_ground_that_it_covers():
    texture = np.random.default_rng(0).integers(0, 256, size=(180, 240, 3), dtype=np.uint8)
    ground = Ground(lambda plan: np.zeros(len(plan)), texture, -6.0, 4.5, 0.05)
    camera = SimplePinhole(100.0, 30.0, 22.5)  # from 20 m a pixel covers 4 x 4 texels
    down = np.diag([1.0, -1.0, -1.0])
    points = ground_points(pixel_rays(camera, (60, 45)), down, np.array([0.0, 0.0, 20.0]), ground.terrain)
    picture = render(ground, points[..., :2], (60, 45), samples=4)
    expected = texture.reshape(45, 4, 60, 4, 3).mean(axis=(1, 3))
    assert np.abs(picture - expected).max() <= 0.51  # rounding


def test_painted_target_has_its_centre_where_it_is_said_to_be():
    target = np.array([1.2345, -2.3456])
    ends = {"low_m": np.array([-6.0, -6.0]), "high_m": np.array([6.0, 6.0])}
    ground = paint_ground(np.random.default_rng(0), HILLS, **ends, texel_m=0.05, targets_m=target[None])
    rows, columns = np.indices(ground.texture.shape[:2])
    east, north = ground.west_m + (columns + 0.5) * 0.05, ground.north_m - (rows + 0.5) * 0.05
    within = np.hypot(east - target[0], north - target[1]) < 0.57  # up to the white ring
    dark = np.where(within, 245.0 - ground.texture[..., 0], 0.0)  # two quarters, whose centre of mass is the target's
    assert dark.sum() * 0.05**2 / 233 == pytest.approx(np.pi * 0.54**2 / 2, rel=0.01)
    found = np.array([(dark * east).sum(), (dark * north).sum()]) / dark.sum()
    assert np.abs(found - target).max() < 0.001  # metres; the ring's texels are not quite white


def test_painting_repeats_and_follows_the_seed():
    def texture(seed: int) -> np.ndarray:
        ends = {"low_m": np.array([0.0, 0.0]), "high_m": np.array([20.0, 15.0])}
        rng = np.random.default_rng(seed)
        return paint_ground(rng, HILLS, **ends, texel_m=0.1, targets_m=np.empty((0, 2))).texture

    assert np.array_equal(texture(1), texture(1))
    assert not np.array_equal(texture(1), texture(2))


def test_exposure_darkens_corners_and_adds_the_noise_asked_for():
    grey = np.full((201, 301, 3), 128, np.uint8)
    dark = expose(grey, np.random.default_rng(0), falloff=0.25, noise_std=0.0)
    assert (dark[0, 0] == 96).all() and (dark[100, 150] == 128).all()
    noisy = expose(grey, np.random.default_rng(0), falloff=0.0, noise_std=2.0)
    assert noisy.std() == pytest.approx(np.hypot(2.0, 12**-0.5), rel=0.02)  # rounding adds its own


def test_views_without_ground_are_refused():
    rays = pixel_rays(CAMERA, SIZE_PX, 100.0)
    level = cam_from_enu(Attitude(yaw_deg=0.0, pitch_deg=-10.0, roll_deg=0.0))
    with pytest.raises(JaxbaError, match="horizon"):
        ground_points(rays, level, CENTER_M, HILLS)
    points = ground_points(rays, DOWN, CENTER_M, HILLS)
    with pytest.raises(JaxbaError, match="paint more"):
        render(blobs(np.zeros((1, 2)), -5.0, 5.0, 0.3), points[..., :2], SIZE_PX)
    folding = OpenCV(fx=300.0, fy=300.0, cx=300.0, cy=225.0, k1=-0.5, k2=0.0, p1=0.0, p2=0.0)
    with pytest.raises(JaxbaError, match="folds back"):
        pixel_rays(folding, SIZE_PX)


def test_a_pinhole_over_a_slope_meets_the_known_plane():
    rays = pixel_rays(SimplePinhole(500.0, 300.0, 225.0), SIZE_PX, 100.0)
    points = ground_points(rays, DOWN, CENTER_M, lambda plan: 0.2 * plan[:, 0] - 0.1 * plan[:, 1])
    normal = np.array([-0.2, 0.1, 1.0])
    in_world = rays @ DOWN
    distance = -(normal @ CENTER_M) / (in_world @ normal)
    np.testing.assert_allclose(points, CENTER_M + distance[..., None] * in_world, atol=1e-6)
