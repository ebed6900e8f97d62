import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jaxba.vision import Pinhole, PosePrior, TwoView, verify
from jaxba.vision._two_view import sampson_px, transfer_px

CAMERA = Pinhole(width_px=1600, height_px=1200, focal_px=1300.0)


def image_pair(
    seed: int, *, relief_m: float = 0.0, climb_m: float = 0.0, outliers: float = 0.3, noise_px: float = 0.5
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return image points of two nadir photos, R and t of `x_j = R x_i + t`, and which matches are right."""
    rng = np.random.default_rng(seed)
    height = 80.0
    base = np.array([rng.uniform(10, 35), rng.uniform(-8, 8), climb_m + rng.uniform(-2, 2)])
    down = np.diag([1.0, -1.0, -1.0])
    attitudes = [(Rotation.from_rotvec(rng.normal(0, 0.06, 3)) * Rotation.from_matrix(down)).as_matrix() for _ in "ij"]
    centers = np.array([[0, 0, height], base + np.array([0, 0, height])])
    ground = np.column_stack([rng.uniform(-60, 90, (6000, 2)), rng.uniform(-relief_m / 2, relief_m / 2, 6000)])
    images = []
    for attitude, center in zip(attitudes, centers, strict=True):
        p = (ground - center) @ attitude.T
        images.append(p[:, :2] / p[:, 2:] * CAMERA.focal_px + CAMERA.center_px)
    size = [CAMERA.width_px, CAMERA.height_px]
    seen = np.flatnonzero(np.all([np.all((xy > 0) & (xy < size), axis=1) for xy in images], axis=0))[:400]
    first, second = (xy[seen] + rng.normal(0, noise_px, (len(seen), 2)) for xy in images)
    wrong = rng.random(len(seen)) < outliers
    second[wrong] = rng.uniform(0, size, (int(wrong.sum()), 2))
    rotation = attitudes[1] @ attitudes[0].T
    direction = attitudes[1] @ (centers[0] - centers[1])
    return first, second, rotation, direction / np.linalg.norm(direction), ~wrong


def degrees_between(first: np.ndarray, second: np.ndarray) -> float:
    if first.ndim == 1:
        return float(np.rad2deg(np.arccos(np.clip(first @ second, -1, 1))))
    return float(np.rad2deg(Rotation.from_matrix(first @ second.T).magnitude()))


def fundamental_of(found: TwoView) -> np.ndarray:
    inverse = np.linalg.inv(CAMERA.matrix())
    return inverse.T @ -np.cross(np.eye(3), found.direction) @ found.rotation @ inverse


def prior_of(rotation: np.ndarray, direction: np.ndarray | None, seed: int) -> PosePrior:
    rng = np.random.default_rng(seed)
    turned = Rotation.from_rotvec(rng.normal(0, np.deg2rad(2), 3)).as_matrix() @ rotation
    if direction is not None:
        direction = direction + rng.normal(0, 0.05, 3)
        direction = direction / np.linalg.norm(direction)
    return PosePrior(rotation=turned, rotation_std_rad=0.05, direction=direction, direction_std_rad=0.1)


@pytest.mark.parametrize("with_direction", [False, True])
def test_pose_of_flat_ground_is_right_in_30_of_30_cases_with_priors(with_direction: bool) -> None:
    for seed in range(30):
        first, second, rotation, direction, right = image_pair(seed)
        prior = prior_of(rotation, direction if with_direction else None, seed)
        found = verify(first, second, CAMERA, CAMERA, threshold_px=3.0, prior=prior)
        assert found.is_planar
        assert degrees_between(found.rotation, rotation) < 1
        assert degrees_between(found.direction, direction) < 3
        assert (found.is_inlier == right).mean() > 0.97


def test_plane_seen_while_climbing_has_two_poses_and_priors_choose_the_true_one() -> None:
    wrong_without, second_chosen = 0, 0
    for seed in range(30):
        first, second, rotation, direction, _ = image_pair(seed, climb_m=25.0)
        found = verify(first, second, CAMERA, CAMERA, threshold_px=3.0, prior=prior_of(rotation, direction, seed))
        assert degrees_between(found.rotation, rotation) < 1
        assert degrees_between(found.direction, direction) < 3
        without = verify(first, second, CAMERA, CAMERA, threshold_px=3.0)
        wrong_without += degrees_between(without.rotation, rotation) > 3
        # the other pose, decomposed by OpenCV, is the one that a prior near to it would get
        homography, _ = cv2.findHomography(first, second, cv2.RANSAC, 2.0)
        _, rotations, _, _ = cv2.decomposeHomographyMat(homography, CAMERA.matrix())
        other = max(rotations, key=lambda r: degrees_between(r, rotation))
        if degrees_between(other, rotation) > 5:
            prior = PosePrior(rotation=other, rotation_std_rad=0.01)
            deceived = verify(first, second, CAMERA, CAMERA, threshold_px=3.0, prior=prior)
            second_chosen += degrees_between(deceived.rotation, other) < 1
            right_ones = deceived.is_inlier & found.is_inlier
            distances = sampson_px(fundamental_of(deceived), first[right_ones], second[right_ones])
            assert np.median(distances) < 0.7  # the noise is 0.5 px: it fits as well as the true one
    assert wrong_without > 3 and second_chosen > 3


def test_attitudes_of_a_photo_stored_upside_down_are_not_believed() -> None:
    for seed in range(10):
        first, second, rotation, direction, _ = image_pair(seed, climb_m=25.0)
        prior = prior_of(np.diag([-1.0, -1.0, 1.0]) @ rotation, direction, seed)
        found = verify(first, second, CAMERA, CAMERA, threshold_px=3.0, prior=prior)
        without = verify(first, second, CAMERA, CAMERA, threshold_px=3.0)
        assert np.array_equal(found.rotation, without.rotation) and np.array_equal(found.direction, without.direction)


def test_pose_over_relief_is_right_without_priors() -> None:
    for seed in range(10):
        first, second, rotation, direction, right = image_pair(seed, relief_m=25)
        found = verify(first, second, CAMERA, CAMERA, threshold_px=3.0)
        assert not found.is_planar
        assert degrees_between(found.rotation, rotation) < 0.5
        assert degrees_between(found.direction, direction) < 2
        assert found.is_inlier[right].mean() > 0.97
        assert found.residual_px < 0.6


def test_angle_is_that_between_the_true_rays() -> None:
    first, second, rotation, _, right = image_pair(3, relief_m=25)
    found = verify(first, second, CAMERA, CAMERA, threshold_px=3.0)
    cosine = np.sum((CAMERA.rays(first[right]) @ rotation.T) * CAMERA.rays(second[right]), axis=1)
    assert found.angle_rad == pytest.approx(np.median(np.arccos(cosine)), rel=0.02)


def test_trees_on_flat_ground_stay_inliers() -> None:
    first, second, rotation, direction, _ = image_pair(5, outliers=0.0)
    trees = np.arange(20)
    tall = image_pair(5, outliers=0.0, relief_m=15.0)
    first[trees], second[trees] = tall[0][trees], tall[1][trees]
    found = verify(first, second, CAMERA, CAMERA, threshold_px=3.0, prior=prior_of(rotation, direction, 0))
    assert found.is_planar
    assert found.is_inlier[trees].mean() > 0.9


def test_matches_that_did_not_move_are_outliers() -> None:
    first, second, rotation, _, _ = image_pair(1, relief_m=25, outliers=0.0)
    mark = np.random.default_rng(0).uniform([0, 1100], [400, 1200], (150, 2))
    found = verify(np.concatenate([first, mark]), np.concatenate([second, mark]), CAMERA, CAMERA, threshold_px=3.0)
    assert not found.is_inlier[len(first) :].any()
    assert degrees_between(found.rotation, rotation) < 0.5
    only = verify(mark, mark, CAMERA, CAMERA, threshold_px=3.0)
    assert not only.is_inlier.any() and np.isnan(only.residual_px)


def test_unknown_focal_length_gives_inliers_and_no_pose() -> None:
    first, second, _, _, right = image_pair(2, relief_m=25)
    unknown = Pinhole(width_px=1600, height_px=1200, focal_px=None)
    found = verify(first, second, unknown, CAMERA, threshold_px=3.0)
    assert (found.is_inlier == right).mean() > 0.95
    assert np.isnan(found.rotation).all() and np.isnan(found.direction).all() and np.isnan(found.angle_rad)


def test_the_better_model_is_named_and_its_inliers_counted_even_where_they_are_too_few() -> None:
    unknown = Pinhole(width_px=1600, height_px=1200, focal_px=None)
    flat, hilly = image_pair(0), image_pair(0, relief_m=25)
    found = [verify(pair[0], pair[1], c, c, threshold_px=3.0) for pair in (flat, hilly) for c in (CAMERA, unknown)]
    assert [one.model for one in found] == ["homography", "homography", "essential", "fundamental"]
    assert all(one.num_explained == one.is_inlier.sum() for one in found)
    few = verify(hilly[0], hilly[1], CAMERA, CAMERA, threshold_px=3.0, min_inliers=350)
    assert few.model == "none" and 200 < few.num_explained < 350 and not few.is_inlier.any()


def test_each_model_has_a_threshold_of_its_own() -> None:
    hilly, flat = image_pair(3, relief_m=25, outliers=0.0), image_pair(3, outliers=0.0)
    counts = [
        verify(hilly[0], hilly[1], CAMERA, CAMERA, threshold_px=3.0, epipolar_threshold_px=line).num_explained
        for line in (None, 3.0, 0.5)
    ]
    assert counts[0] == counts[1] > 1.2 * counts[2]
    tight = verify(flat[0], flat[1], CAMERA, CAMERA, threshold_px=0.5, epipolar_threshold_px=3.0)
    assert tight.num_explained > 380  # those off the tight plane keep to the lines


def test_random_matches_are_no_inliers() -> None:
    rng = np.random.default_rng(0)
    for count in (0, 5, 12, 40):
        points = rng.uniform(0, 1200, (2, count, 2))
        found = verify(points[0], points[1], CAMERA, CAMERA, threshold_px=1.0, min_inliers=25)
        assert found.is_inlier.shape == (count,) and not found.is_inlier.any()


def test_points_on_a_line_do_no_harm() -> None:
    line = np.column_stack([np.linspace(10, 1500, 60), np.linspace(20, 900, 60)])
    found = verify(line, line + np.array([30.0, 5.0]), CAMERA, CAMERA, threshold_px=3.0)
    assert isinstance(found, TwoView) and found.is_inlier.shape == (60,)


def test_same_matches_give_the_same_result() -> None:
    first, second, rotation, _, _ = image_pair(4, outliers=0.6)
    for camera in (CAMERA, Pinhole(width_px=1600, height_px=1200, focal_px=None)):
        results = [
            verify(first, second, camera, camera, threshold_px=3.0, prior=prior_of(rotation, None, 0)) for _ in range(3)
        ]
        for other in results[1:]:
            assert np.array_equal(other.is_inlier, results[0].is_inlier)
            assert np.array_equal(other.rotation, results[0].rotation, equal_nan=True)
            assert np.array_equal(other.direction, results[0].direction, equal_nan=True)


def test_distances_are_opencvs() -> None:
    first, second, _, _, _ = image_pair(6, relief_m=25)
    fundamental = fundamental_of(verify(first, second, CAMERA, CAMERA, threshold_px=3.0))
    ones = np.ones((len(first), 1))
    expected = [
        np.sqrt(cv2.sampsonDistance(x[:, None], y[:, None], fundamental))
        for x, y in zip(np.hstack([first, ones]), np.hstack([second, ones]), strict=True)
    ]
    np.testing.assert_allclose(sampson_px(fundamental, first, second), expected, rtol=1e-6)
    homography = np.array([[1.1, 0.02, 30], [-0.03, 0.95, 12], [1e-5, -2e-5, 1]])
    forth = np.linalg.norm(cv2.perspectiveTransform(first[None], homography)[0] - second, axis=1)
    back = np.linalg.norm(cv2.perspectiveTransform(second[None], np.linalg.inv(homography))[0] - first, axis=1)
    np.testing.assert_allclose(transfer_px(homography, first, second), np.maximum(forth, back), rtol=1e-9)
