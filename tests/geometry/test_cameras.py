"""Cameras against pycolmap, formulas written out in numpy, and central differences."""

import jax
import jax.numpy as jnp
import numpy as np
import pycolmap
import pytest
from quick_jit import quick_jit

from jaxba.geometry import BAL, CAMERAS, AbstractCamera, OpenCV, OpenCVFisheye, Pinhole, SimpleRadial

PARAMETERS = {
    "SIMPLE_PINHOLE": [900.0, 640.3, 355.2],
    "PINHOLE": [900.0, 880.0, 640.3, 355.2],
    "SIMPLE_RADIAL": [900.0, 640.3, 355.2, -0.12],
    "RADIAL": [900.0, 640.3, 355.2, -0.25, 0.09],
    "OPENCV": [900.0, 880.0, 640.3, 355.2, -0.25, 0.09, 1.5e-3, -2e-3],
    "OPENCV_FISHEYE": [500.0, 510.0, 640.3, 355.2, 0.05, 0.01, -3e-3, 5e-4],
    "BAL": [900.0, -0.25, 0.09],
}
project = quick_jit(lambda camera, point: camera.project(point))
unproject = quick_jit(lambda camera, xy_px: camera.unproject(xy_px))
undistort = quick_jit(lambda camera, xy_px: camera.undistort(xy_px))

_RNG = np.random.default_rng(0)
# directions up to 40 degrees from the axis, at depths from 1 to 100 m, among them the axis and two beside it
POINTS = np.concatenate([_RNG.uniform(-0.6, 0.6, (40, 2)), np.ones((40, 1))], axis=1)
POINTS = np.concatenate([POINTS, [[0, 0, 1], [1e-9, 0, 1], [9e-4, 4.5e-4, 1]]]) * _RNG.uniform(1, 100, (43, 1))


def _camera(name: str) -> AbstractCamera:
    parameters = np.array(PARAMETERS[name])
    if name == "OPENCV":  # k3 stands last and is none of COLMAP's
        parameters = np.append(parameters, 0.0)
    return CAMERAS[name].from_parameters(parameters)


def _parameters(camera: AbstractCamera) -> np.ndarray:
    return np.array([getattr(camera, name) for name in camera.parameter_names()])


@pytest.mark.parametrize("name", [name for name in PARAMETERS if name != "BAL"])
def test_projection_and_its_inverse_equal_colmap(name):
    colmap = pycolmap.Camera(model=name, width=1280, height=720, params=PARAMETERS[name])
    xy_px = np.asarray(project(_camera(name), POINTS))
    np.testing.assert_allclose(xy_px, colmap.img_from_cam(POINTS), rtol=0, atol=1e-10)  # pixels up to 1e3
    ray = np.asarray(unproject(_camera(name), xy_px))
    # COLMAP stops its iteration at a change of 1e-10
    np.testing.assert_allclose(ray[:, :2] / ray[:, 2:], colmap.cam_from_img(xy_px), rtol=0, atol=1e-8)


def test_opencv_with_k3_equals_its_published_formula():
    k1, k2, k3, p1, p2 = -0.2, 0.08, -0.03, 1e-3, -2e-3
    a, b = POINTS[:, 0] / POINTS[:, 2], POINTS[:, 1] / POINTS[:, 2]
    r = np.hypot(a, b)
    radial = 1 + k1 * r**2 + k2 * r**4 + k3 * r**6
    u = 900 * (a * radial + 2 * p1 * a * b + p2 * (r**2 + 2 * a**2)) + 640
    v = 880 * (b * radial + p1 * (r**2 + 2 * b**2) + 2 * p2 * a * b) + 355
    camera = OpenCV(fx=900.0, fy=880.0, cx=640.0, cy=355.0, k1=k1, k2=k2, k3=k3, p1=p1, p2=p2)
    camera = jax.tree.map(np.float64, camera)
    np.testing.assert_allclose(project(camera, POINTS), np.stack([u, v], axis=-1), rtol=0, atol=1e-10)


def test_bal_equals_its_published_formula_after_turning_to_look_along_minus_z():
    f, k1, k2 = PARAMETERS["BAL"]
    published = POINTS * [1, -1, -1]  # y up, looking along -z
    p = -published[:, :2] / published[:, 2:]
    r2 = np.sum(p**2, axis=1, keepdims=True)
    expected = f * (1 + k1 * r2 + k2 * r2**2) * p  # y up
    np.testing.assert_allclose(project(_camera("BAL"), POINTS), expected * [1, -1], rtol=0, atol=1e-10)


def _fisheye_points() -> np.ndarray:
    theta, phi = np.meshgrid([1e-9, 9e-4, 1.1e-3, 0.6, 1.5, np.pi / 2, 1.8, 2.1], [0.0, 1.0, 4.0])
    ray = np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)], axis=-1)
    return np.concatenate([3.0 * ray.reshape(-1, 3), [[1.0, 0.0, 0.0], [0.0, 2.0, 0.0]]])


def test_fisheye_sees_beyond_90_degrees_by_its_published_formula():
    fx, fy, cx, cy, *k = PARAMETERS["OPENCV_FISHEYE"]
    points = _fisheye_points()
    radius = np.hypot(points[:, 0], points[:, 1])
    theta = np.arctan2(radius, points[:, 2])
    distorted = theta * (1 + k[0] * theta**2 + k[1] * theta**4 + k[2] * theta**6 + k[3] * theta**8)
    expected = np.array([fx, fy]) * (distorted / radius)[:, None] * points[:, :2] + [cx, cy]
    camera = _camera("OPENCV_FISHEYE")
    np.testing.assert_allclose(project(camera, points), expected, rtol=0, atol=1e-10)
    ray = unproject(camera, expected)
    np.testing.assert_allclose(ray, points / np.linalg.norm(points, axis=1, keepdims=True), rtol=0, atol=1e-13)


def test_fisheye_does_not_project_the_direction_opposite_to_its_axis():
    xy_px = np.asarray(project(_camera("OPENCV_FISHEYE"), np.array([[0.0, 0.0, -1.0], [1e-12, 0.0, -1.0]])))
    assert np.all(np.isnan(xy_px[0]))
    assert xy_px[1, 0] > 1e3  # nearly opposite: at the rim, not at the centre


@pytest.mark.parametrize("name", PARAMETERS)
def test_projection_has_derivatives_that_match_central_difference(name, assert_derivative):
    camera = _camera(name)
    parameters = _parameters(camera)
    points = _fisheye_points() if name == "OPENCV_FISHEYE" else POINTS[-12:] / POINTS[-12:, 2:]
    batch = np.concatenate([points, np.tile(parameters, (len(points), 1))], axis=1)
    # the distortion's higher derivatives along z limit the difference: 1e-8 of the largest entry, 1e3 px
    assert_derivative(lambda p: type(camera).from_parameters(p[3:]).project(p[:3]), batch)


@pytest.mark.parametrize("name", PARAMETERS)
def test_unprojection_inverts_projection_and_has_the_implicit_derivative(name, assert_derivative):
    camera = _camera(name)
    ray = POINTS / np.linalg.norm(POINTS, axis=1, keepdims=True)
    xy_px = np.asarray(project(camera, POINTS))
    np.testing.assert_allclose(unproject(camera, xy_px), ray, rtol=0, atol=1e-14)
    batch = np.concatenate([xy_px[-6:], np.tile(_parameters(camera), (6, 1))], axis=1)
    function = lambda p: type(camera).from_parameters(p[2:]).unproject(p[:2])  # noqa: E731
    if name in ("OPENCV", "OPENCV_FISHEYE"):  # one Newton iteration for all: the two that differ stand for the others
        assert_derivative(function, batch)
    if name == "RADIAL":  # the second derivative too: the two last Newton steps carry it
        assert_derivative(lambda p: jax.jacfwd(function)(p).ravel(), batch[:2], tolerance=1e-7)


def test_undistortion_gives_the_pixel_of_the_pinhole_camera():
    camera = _camera("OPENCV")
    pinhole = Pinhole(*np.array(PARAMETERS["OPENCV"][:4]))
    xy_px = project(camera, POINTS)
    np.testing.assert_allclose(undistort(camera, xy_px), project(pinhole, POINTS), rtol=0, atol=1e-10)


def test_pixels_that_no_direction_projects_to_have_no_ray():
    camera = SimpleRadial(1000.0, 500.0, 500.0, -0.3)  # r - 0.3 r^3 is at most 0.7027 at r = 1.054
    xy_px = np.array([[500.0 + 702.0, 500.0], [500.0 + 704.0, 500.0], [500.0 + 3000.0, 500.0]])
    ray = np.asarray(unproject(camera, xy_px))
    np.testing.assert_array_equal(np.isfinite(ray).all(axis=1), [True, False, False])
    assert ray[0, 0] / ray[0, 2] < 1.054
    fisheye = _camera("OPENCV_FISHEYE")
    behind = project(fisheye, np.array([[1.0, 0.0, -0.1]]))
    assert np.all(np.isfinite(unproject(fisheye, behind)))
    assert np.all(np.isnan(undistort(fisheye, behind)))  # no pinhole sees it


def test_a_pixel_without_a_ray_leaves_the_gradient_of_the_others_finite():
    xy_px = jnp.asarray([[600.0, 500.0], [3500.0, 500.0]])

    def used(k1):
        ray = SimpleRadial(1000.0, 500.0, 500.0, k1).unproject(xy_px)
        return jnp.sum(jnp.where(jnp.isfinite(ray), ray, 0.0))

    assert np.isfinite(quick_jit(jax.grad(used))(-0.3))


def test_strong_mixed_distortion_is_inverted_wherever_it_is_monotonic():
    # pincushion within, barrel without: Newton's method from the distorted direction itself leaves the branch
    rng = np.random.default_rng(3)
    slope = np.linspace(0, 1.2, 200)
    for k1, k2, k3 in zip(rng.uniform(0.1, 0.5, 20), rng.normal(0, 0.1, 20), rng.uniform(-0.1, 0, 20), strict=True):
        growth = 1 + 3 * k1 * slope**2 + 5 * k2 * slope**4 + 7 * k3 * slope**6
        monotonic = slope[: np.argmax(growth < 0.02)] if np.any(growth < 0.02) else slope
        points = np.tile([0.0, 0.0, 1.0], (200, 1))
        points[: len(monotonic), 0], points[: len(monotonic), 1] = 0.8 * monotonic, -0.6 * monotonic
        camera = OpenCV(*np.array([900.0, 900.0, 640.0, 360.0, k1, k2, 0.0, 0.0, k3]))
        ray = unproject(camera, project(camera, points))
        # near a fold a rounding of the pixel is up to 50 roundings of the direction
        np.testing.assert_allclose(ray, points / np.linalg.norm(points, axis=1, keepdims=True), rtol=0, atol=1e-12)


def test_cameras_broadcast_over_their_batch():
    cameras = OpenCV(*(np.array([v, 1.1 * v]) for v in PARAMETERS["OPENCV"]))  # k3 stays one number
    both = np.asarray(project(cameras, POINTS[:, None]))
    rays = np.asarray(unproject(cameras, both))
    for i in range(2):
        one = OpenCV(*np.append(PARAMETERS["OPENCV"], 0.0) * (1 + 0.1 * i))
        np.testing.assert_allclose(both[:, i], project(one, POINTS), rtol=0, atol=1e-12)  # roundings of 1e3 px
        np.testing.assert_allclose(rays[:, i], unproject(one, both[:, i]), rtol=0, atol=1e-14)
    stacked, again = quick_jit(lambda c: (c.parameters, OpenCV.from_parameters(c.parameters).parameters))(cameras)
    np.testing.assert_array_equal(stacked, [_parameters(_camera("OPENCV")) * (1 + 0.1 * i) for i in range(2)])
    np.testing.assert_array_equal(again, stacked)
    assert OpenCV.parameter_names() == ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3")


def test_float32_projects_to_a_hundredth_of_a_pixel():
    points = _fisheye_points().astype(np.float32)
    camera = OpenCVFisheye(*(np.array(v, np.float32) for v in PARAMETERS["OPENCV_FISHEYE"]))
    exact = project(_camera("OPENCV_FISHEYE"), points.astype(np.float64))
    assert project(camera, points).dtype == np.float32
    np.testing.assert_allclose(project(camera, points), exact, rtol=0, atol=1e-2)  # 1e3 px times 1e-7, some operations
    ray = points / np.linalg.norm(points, axis=-1, keepdims=True)
    # 1e-4 px of rounding over 500 px of focal length, where the distortion is flattest
    np.testing.assert_allclose(unproject(camera, project(camera, points)), ray, rtol=0, atol=1e-5)


def test_bal_has_its_principal_point_at_the_origin():
    np.testing.assert_array_equal(project(BAL(500.0, -0.1, 0.01), np.array([0.0, 0.0, 2.0])), [0.0, 0.0])
