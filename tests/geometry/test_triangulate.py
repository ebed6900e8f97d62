"""Triangulation against pycolmap, scipy, simulated truth and central differences."""

import jax
import jax.numpy as jnp
import numpy as np
import pycolmap
import pytest
import scipy.optimize
from jax import Array
from quick_jit import quick_jit
from scipy.spatial.transform import Rotation

from jaxba import geometry
from jaxba._errors import JaxbaError
from jaxba.geometry import OpenCV, Pose, Triangulation

two_view = quick_jit(geometry.triangulate_two_view)
multi_view = quick_jit(geometry.triangulate)
refine = quick_jit(geometry.refine_point, static_argnames="num_steps")
project = quick_jit(lambda camera, point: camera.project(point))
is_valid = quick_jit(lambda found: found.is_valid)

CAMERA = OpenCV(900.0, 880.0, 640.0, 360.0, -0.1, 0.02, 1e-3, -5e-4)


def _scene(views: int, *, tracks: int = 8, noise: float = 0.0, seed: int = 0) -> tuple[Pose, np.ndarray, np.ndarray]:
    """Poses (tracks, views) about 10 m in front of points, unit rays with `noise`, and the true points."""
    rng = np.random.default_rng(seed)
    rotation = Rotation.from_rotvec(rng.uniform(-0.3, 0.3, (tracks * views, 3)))
    center = rng.uniform(-3, 3, (tracks * views, 3)) * [1, 1, 0.5]
    point = np.stack([*rng.uniform(-2, 2, (2, tracks)), rng.uniform(8, 12, tracks)], axis=1)
    quaternion = rotation.as_quat(scalar_first=True).reshape(tracks, views, 4)
    poses = Pose(quaternion, -rotation.apply(center).reshape(tracks, views, 3))
    ray = rotation.apply(point.repeat(views, axis=0) - center).reshape(tracks, views, 3)
    ray = ray / np.linalg.norm(ray, axis=-1, keepdims=True) + noise * rng.normal(size=ray.shape)
    return poses, ray / np.linalg.norm(ray, axis=-1, keepdims=True), point


def _at(tree, *index):
    return jax.tree.map(lambda a: a[index], tree)


def _centers(poses: Pose) -> np.ndarray:
    matrices = _matrices(poses)
    return -np.einsum("...ji,...j->...i", matrices[..., :3], matrices[..., 3])


def _in_cameras(poses: Pose, point: np.ndarray) -> np.ndarray:
    """Points (tracks, 3) in each of their cameras' frames."""
    matrices = _matrices(poses)
    return np.einsum("tvij,tj->tvi", matrices[..., :3], point) + matrices[..., 3]


def _matrices(poses: Pose) -> np.ndarray:
    rotation = Rotation.from_quat(poses.quaternion, scalar_first=True).as_matrix()
    return np.concatenate([rotation, np.asarray(poses.translation)[..., None]], axis=-1)


@pytest.mark.parametrize("views", [2, 3, 9])
def test_exact_rays_give_the_true_point_the_angle_and_the_distance(views):
    poses, rays, point = _scene(views)
    center = _centers(poses)
    for found in [multi_view(poses, rays)] + ([two_view(poses, rays)] if views == 2 else []):
        np.testing.assert_allclose(found.point, point, rtol=0, atol=1e-11)  # 10 m over a squared angle of 0.01
        assert np.all(is_valid(found))
        for track in range(len(point)):
            pairs = [(a, b) for a in center[track] for b in center[track]]
            angle = max(pycolmap.calculate_triangulation_angle(a, b, point[track]) for a, b in pairs)
            np.testing.assert_allclose(found.angle_rad[track], angle, atol=1e-7)  # COLMAP's cosine: sqrt of a rounding
        nearest = np.linalg.norm(center - point[:, None], axis=-1).min(axis=1)
        np.testing.assert_allclose(found.distance_m, nearest, rtol=1e-12)


def test_two_noisy_rays_give_the_published_point_and_no_more_error_than_colmaps_midpoint():
    poses, rays, point = _scene(2, noise=1e-3, tracks=60)
    found = np.asarray(two_view(poses, rays).point)
    colmap = []
    for track in range(len(rays)):
        first, second = (pycolmap.Rigid3d(matrix) for matrix in _matrices(_at(poses, track)))
        second_from_first = second * first.inverse()
        in_first = pycolmap.triangulate_mid_point(second_from_first, rays[track, 0], rays[track, 1])
        colmap.append(first.inverse() * in_first)
        # Lee and Civera's equations, in their frames: the second camera's
        f0, f1, t = second_from_first.rotation * rays[track, 0], rays[track, 1], second_from_first.translation
        p, q, r = (np.linalg.norm(v) for v in (np.cross(f0, f1), np.cross(f0, t), np.cross(f1, t)))
        expected = second.inverse() * (q / (q + r) * (t + r / p * (f0 + f1)))
        np.testing.assert_allclose(found[track], expected, rtol=0, atol=1e-10)  # angles down to 0.05: 10 m / 0.05^2
    error, error_colmap = (np.median(np.linalg.norm(p - point, axis=1)) for p in (found, np.array(colmap)))
    assert error <= 1.02 * error_colmap  # the same noise, nearly the same estimate


def test_several_noisy_rays_are_close_to_colmaps_and_to_the_truth():
    poses, rays, point = _scene(8, noise=1e-3, tracks=40)
    found = np.asarray(multi_view(poses, rays).point)
    colmap = [
        pycolmap.triangulate_multi_view_point(list(_matrices(_at(poses, track))), rays[track])
        for track in range(len(rays))
    ]
    error, error_colmap = (np.sqrt(np.mean(np.sum((p - point) ** 2, axis=1))) for p in (found, np.array(colmap)))
    assert error < 1.05 * error_colmap  # two linear estimates of like quality, on 40 tracks
    assert error < 0.05  # 1e-3 rad at 10 m, base over depth of about a third: 3 cm in depth


def test_the_point_minimises_the_weighted_squared_distances_to_the_rays():
    poses, rays, _ = _scene(5, noise=1e-2)
    weight = np.random.default_rng(2).uniform(0.3, 3, rays.shape[:2])
    found = np.asarray(multi_view(poses, rays, weight=weight).point)
    for track in range(len(rays)):
        matrices = _matrices(_at(poses, track))
        ray = np.einsum("vji,vj->vi", matrices[:, :, :3], rays[track])
        center = -np.einsum("vji,vj->vi", matrices[:, :, :3], matrices[:, :, 3])
        across = weight[track, :, None, None] * (np.eye(3) - ray[:, :, None] * ray[:, None])
        right = np.einsum("vij,vj->vi", across, center)
        expected = np.linalg.lstsq(across.reshape(-1, 3), right.ravel(), rcond=None)[0]
        np.testing.assert_allclose(found[track], expected, rtol=0, atol=1e-12)


def test_refined_points_minimise_the_weighted_reprojection_error():
    poses, _, point = _scene(4, tracks=4)
    rng = np.random.default_rng(1)
    exact = np.asarray(project(CAMERA, _in_cameras(poses, point)))
    xy_px = exact + rng.normal(size=exact.shape)
    weight = rng.uniform(0.5, 2, xy_px.shape[:2])
    rays = quick_jit(lambda camera, xy_px: camera.unproject(xy_px))(CAMERA, xy_px)
    start = multi_view(poses, rays, weight=weight).point
    refined = np.asarray(refine(start, poses, CAMERA, xy_px, weight=weight, num_steps=5))

    @quick_jit
    def residual(x: Array, view: Pose, xy_px: Array, weight: Array) -> Array:
        return ((CAMERA.project(view.transform(x)) - xy_px) * weight[:, None]).ravel()

    for track in range(len(point)):
        given = _at(poses, track), xy_px[track], weight[track]
        oracle = scipy.optimize.least_squares(residual, point[track], xtol=1e-15, ftol=1e-15, args=given)
        # scipy's own numerical derivative stops it at about 1e-8
        np.testing.assert_allclose(refined[track], oracle.x, rtol=0, atol=1e-6)
        assert np.sum(np.asarray(residual(refined[track], *given)) ** 2) <= 2 * oracle.cost * (1 + 1e-12)


def test_padding_changes_neither_value_nor_derivative():
    poses, rays, _ = _scene(3, noise=1e-3)
    count = len(rays)
    padded = Pose(
        np.concatenate([poses.quaternion, np.broadcast_to([1.0, 0, 0, 0], (count, 2, 4))], axis=1),
        np.concatenate([poses.translation, np.zeros((count, 2, 3))], axis=1),
    )
    padded_rays = np.concatenate([rays, np.broadcast_to([1.0, 0, 0], (count, 2, 3))], axis=1)
    weight = np.array([1.0, 1, 1, 0, 0]) * np.ones((count, 1))
    plain, result = multi_view(poses, rays), multi_view(padded, padded_rays, weight=weight)
    for a, b in zip(jax.tree.leaves(plain), jax.tree.leaves(result), strict=True):
        np.testing.assert_allclose(a, b, rtol=0, atol=1e-13)

    def total(poses, rays, weight):
        found = geometry.triangulate(poses, rays, weight=weight)
        return jnp.sum(found.point) + jnp.sum(found.angle_rad) + jnp.sum(found.distance_m)

    gradient = quick_jit(jax.grad(total, 1))
    expected = gradient(poses, rays, np.ones((count, 3)))
    result = np.asarray(gradient(padded, padded_rays, weight))
    np.testing.assert_allclose(result[:, :3], expected, rtol=0, atol=1e-11)
    np.testing.assert_array_equal(result[:, 3:], np.zeros((count, 2, 3)))
    # pixels of padding are looked at neither by the refinement
    xy_px = np.asarray(project(CAMERA, rays)) + 0.5
    padded_px = np.concatenate([xy_px, np.full((count, 2, 2), 1e6)], axis=1)
    refined = refine(plain.point, poses, CAMERA, xy_px)
    np.testing.assert_allclose(refine(plain.point, padded, CAMERA, padded_px, weight=weight), refined, atol=1e-12)


def _degenerate() -> dict[str, tuple[Pose, np.ndarray, np.ndarray]]:
    upright = np.broadcast_to([1.0, 0, 0, 0], (2, 4))
    apart, together = np.array([[0.0, 0, 0], [-1, 0, 0]]), np.array([[3.0, 2, 1], [3, 2, 1]])
    ahead = np.array([0.0, 0, 1])
    tilted = np.array([0.6, 0, 0.8])
    sideways = np.array([1.0, 0, 0])
    nearly = np.array([1e-9, 0, 1])
    return {
        "parallel rays": (Pose(upright, apart), np.stack([ahead, ahead]), np.ones(2)),
        "nearly parallel rays": (Pose(upright, apart), np.stack([ahead, nearly]), np.ones(2)),
        "opposite rays along the base": (Pose(upright, apart), np.stack([sideways, -sideways]), np.ones(2)),
        "one centre": (Pose(upright, together), np.stack([ahead, tilted]), np.ones(2)),
        "one ray": (Pose(upright, apart), np.stack([ahead, tilted]), np.array([1.0, 0])),
        "no ray": (Pose(upright, apart), np.stack([ahead, tilted]), np.zeros(2)),
    }


@quick_jit
def _with_derivatives(poses: Pose, rays: np.ndarray, weight: np.ndarray) -> tuple:
    """Return what each method finds in a case, in forward and in reverse mode, with the derivatives."""

    def of_weighted(rays: Array, translation: Array) -> tuple[Array, Triangulation]:
        found = geometry.triangulate(Pose(poses.quaternion, translation), rays, weight=weight)
        return jnp.stack([*found.point, found.angle_rad, found.distance_m]), found

    def of_two(rays: Array, translation: Array) -> tuple[Array, Triangulation]:
        found = geometry.triangulate_two_view(Pose(poses.quaternion, translation), rays)
        return jnp.stack([*found.point, found.angle_rad, found.distance_m]), found

    return tuple(
        tuple(mode(method, argnums=(0, 1), has_aux=True)(rays, poses.translation) for mode in (jax.jacfwd, jax.jacrev))
        for method in (of_weighted, of_two)
    )


@pytest.mark.parametrize("case", _degenerate())
def test_degenerate_geometry_is_told_and_leaves_values_and_derivatives_finite(case):
    poses, rays, weight = _degenerate()[case]
    of_weighted, of_two = _with_derivatives(poses, rays, weight)
    for derivative, found in (*of_weighted, *(of_two if np.all(weight > 0) else ())):
        assert bool(found.is_degenerate)
        assert not bool(is_valid(found))
        for leaf in jax.tree.leaves((derivative, found)):
            assert np.all(np.isfinite(leaf))


def test_refinement_leaves_a_point_that_the_views_do_not_fix():
    poses, rays, _ = _degenerate()["one ray"]
    xy_px = project(CAMERA, rays)
    start = np.array([0.1, 0.2, 5.0])
    np.testing.assert_array_equal(refine(start, poses, CAMERA, xy_px, weight=np.array([1.0, 0])), start)


def test_a_point_behind_a_camera_is_not_valid():
    poses, rays, _ = _scene(2)
    for method in (two_view, multi_view):
        found = method(poses, -rays)
        assert np.all(np.asarray(found.distance_m) < 0)
        assert not np.any(is_valid(found)) and not np.any(found.is_degenerate)


@pytest.mark.parametrize("angle", [1e-2, 1e-4, 1e-5])
def test_depth_keeps_its_digits_at_small_angles(angle):
    poses = Pose(np.broadcast_to([1.0, 0, 0, 0], (2, 4)), np.array([[0.0, 0, 0], [-1, 0, 0]]))
    rays = np.array([[0.0, 0, 1], [-np.sin(angle), 0, np.cos(angle)]])
    depth = 1 / np.tan(angle)
    # two views see the angle itself, with a rounding of 1e-16; the normal equations its square
    np.testing.assert_allclose(np.asarray(two_view(poses, rays).point)[2], depth, rtol=4e-16 / angle)
    np.testing.assert_allclose(np.asarray(multi_view(poses, rays).point)[2], depth, rtol=4e-15 / angle**2)


def test_blocks_far_from_the_origin_keep_micrometres():
    poses, rays, point = _scene(4)
    origin = np.array([5.0e5, 4.6e6, 300.0])
    rotation = Rotation.from_quat(poses.quaternion, scalar_first=True).as_matrix()
    moved = Pose(poses.quaternion, poses.translation - np.einsum("tvij,j->tvi", rotation, origin))
    # float64 resolves a northing to 1e-9 m
    np.testing.assert_allclose(multi_view(moved, rays).point, point + origin, rtol=0, atol=5e-8)


@pytest.mark.parametrize(("method", "views"), [("triangulate", 3), ("triangulate_two_view", 2), ("refine_point", 2)])
def test_triangulation_has_derivatives_that_match_central_difference(method, views, assert_derivative):
    poses, rays, _ = _scene(views, noise=1e-3, tracks=3)

    def entries(p):
        rays, step = p[: 3 * views].reshape(views, 3), p[3 * views :].reshape(views, 6)
        pose = Pose(poses.quaternion[0], poses.translation[0]).retract(step)
        if method == "refine_point":  # five steps: converged, so that value and derivative are the minimum's
            xy_px = CAMERA.project(rays)
            start = geometry.triangulate(pose, rays).point
            return geometry.refine_point(start, pose, CAMERA, xy_px, num_steps=5)
        found = getattr(geometry, method)(pose, rays / jnp.linalg.norm(rays, axis=-1, keepdims=True))
        return jnp.stack([*found.point, found.angle_rad, found.distance_m])

    batch = np.concatenate([rays[0].ravel(), np.zeros(6 * views)])[None]
    # depths are quotients by small angles: high derivatives, so smaller steps and fewer digits
    assert_derivative(entries, batch, step=1e-4, tolerance=1e-7)


def test_shapes_that_cannot_be_triangulated_are_named():
    poses, rays, _ = _scene(3, tracks=2)
    with pytest.raises(JaxbaError, match="two views or more"):
        geometry.triangulate(poses, rays[:, :1])
    with pytest.raises(JaxbaError, match="use triangulate for more than two"):
        geometry.triangulate_two_view(poses, rays)
