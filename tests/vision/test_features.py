from dataclasses import fields

import cv2
import numpy as np
import pycolmap
import pytest
from scipy.spatial import KDTree

from jaxba import JaxbaError
from jaxba.scene import Features
from jaxba.vision import OrbOptions, Pixels, detect_features, grid_coverage


def pixels_of(gray: np.ndarray) -> Pixels:
    return Pixels(gray=gray, rgb=np.repeat(gray[:, :, None], 3, axis=2))


def texture(height: int = 300, width: int = 400, contrast: float = 1.0, mean: float = 128.0) -> np.ndarray:
    """Return smooth noise of several wavelengths."""
    rng = np.random.default_rng(1)
    waves = sum(s * cv2.GaussianBlur(rng.normal(size=(height, width)), (0, 0), s) for s in (1.0, 2.0, 4.0, 8.0))
    return np.clip(mean + contrast * 60 * waves, 0, 255).astype(np.uint8)  # pyright: ignore


@pytest.mark.parametrize("sigma_px", [1.5, 3.0, 5.0, 9.0])
def test_blob_is_found_where_it_was_rendered(sigma_px: float) -> None:
    rng = np.random.default_rng(0)
    y, x = np.mgrid[:240, :200] + 0.5  # centres of pixels
    errors = []
    for center in np.array([100.3, 120.7]) + rng.uniform(-4, 4, (12, 2)):
        blob = 40 + 180 * np.exp(-((x - center[0]) ** 2 + (y - center[1]) ** 2) / (2 * sigma_px**2))
        found = detect_features(pixels_of(np.rint(blob).astype(np.uint8))).xy_px
        errors.append(found[np.argmin(np.linalg.norm(found - center, axis=1))] - center)
    assert np.abs(errors).max() < 0.1
    assert np.abs(np.mean(errors, axis=0)).max() < 0.02


@pytest.mark.parametrize("detector", ["sift", "orb"])
def test_half_turn_of_the_image_turns_the_keypoints(detector: str) -> None:
    gray = texture(301, 405)  # a size that no scale divides
    upright = detect_features(pixels_of(gray), detector=detector)
    turned = detect_features(pixels_of(np.ascontiguousarray(gray[::-1, ::-1])), detector=detector)
    back = np.array([405, 301]) - turned.xy_px
    distance, nearest = map(np.asarray, KDTree(back).query(upright.xy_px))
    pairs = distance < 1.0
    assert pairs.mean() > 0.9
    # a wrong half pixel would show as twice its size, and grow with the scale
    size_px = upright.size_px[pairs]
    for half in (size_px <= np.quantile(size_px, 0.8), size_px > np.quantile(size_px, 0.8)):
        offset = (upright.xy_px[pairs] - back[nearest[pairs]])[half]
        assert np.abs(np.median(offset, axis=0)).max() < 0.02


def test_keypoints_lie_where_colmap_finds_them() -> None:
    gray = texture()
    ours = detect_features(pixels_of(gray)).xy_px
    colmap = pycolmap.FeatureExtractor.create(device=pycolmap.Device.cpu)
    theirs = np.array([(k.x, k.y) for k in colmap.extract_from_uint8_array(gray)[0]])  # the same convention of pixels
    distance, nearest = map(np.asarray, KDTree(theirs).query(ours))
    close = distance < 0.5
    assert close.mean() > 0.7
    assert np.abs(np.median(ours[close] - theirs[nearest[close]], axis=0)).max() < 0.02


@pytest.mark.parametrize(("detector", "length"), [("sift", 128), ("orb", 32)])
def test_frame_without_texture_has_zero_features_and_says_so(detector: str, length: int) -> None:
    for value in (0, 255):
        features = detect_features(pixels_of(np.full((200, 300), value, np.uint8)), detector=detector)
        assert features.num_keypoints == 0
        assert features.descriptors.shape == (0, length) and features.rgb.shape == (0, 3)
        assert features.coverage == 0 and features.mean_brightness == value
        assert "no texture" in features.notes[0]


def test_descriptors_are_opencvs_without_loss() -> None:
    gray = texture()
    features = detect_features(pixels_of(gray), contrast_threshold=0.04, contrast_floor=0.04)
    sift = cv2.SIFT.create(nfeatures=8000, enable_precise_upscale=True)
    keypoints, descriptors = sift.detectAndCompute(gray, None)  # pyright: ignore
    assert len(keypoints) == features.num_keypoints > 500
    theirs = np.array([(k.pt[0] + 0.5, k.pt[1] + 0.5, np.deg2rad(k.angle)) for k in keypoints])
    distance, row = map(np.asarray, KDTree(theirs).query(np.column_stack([features.xy_px, features.angle_rad])))
    assert distance.max() < 1e-6
    assert np.array_equal(descriptors[row], features.descriptors)
    assert features.descriptors.dtype == np.uint8 and features.descriptors.flags.c_contiguous


def positions(features: Features) -> int:
    return len(np.unique(features.xy_px, axis=0))


def test_the_largest_keypoints_are_kept_with_all_their_orientations() -> None:
    pixels = pixels_of(texture(450, 600))
    many = detect_features(pixels, contrast_threshold=0.03, contrast_floor=0.03)
    few = detect_features(pixels, contrast_threshold=0.03, contrast_floor=0.03, nfeatures=2000)
    assert positions(many) > 2500 and positions(few) == 2000
    assert np.all(np.diff(many.size_px) <= 0)
    assert np.array_equal(many.xy_px[: few.num_keypoints], few.xy_px)
    rest = many.xy_px[few.num_keypoints :]
    assert not (set(map(tuple, rest)) & set(map(tuple, few.xy_px)))


def test_more_edges_pass_a_larger_edge_threshold() -> None:
    ridges = np.hypot(*np.gradient(cv2.GaussianBlur(texture().astype(float), (0, 0), 3)))
    pixels = pixels_of(np.clip(40 * ridges, 0, 255).astype(np.uint8))
    counts = [positions(detect_features(pixels, edge_threshold=edge)) for edge in (5.0, 10.0, 15.0, 20.0)]
    assert counts == sorted(set(counts))


def test_detection_is_deterministic() -> None:
    for detector in ("sift", "orb"):
        one, two = (detect_features(pixels_of(texture()), detector=detector) for _ in range(2))
        for field in fields(Features):
            assert np.array_equal(getattr(one, field.name), getattr(two, field.name))


def test_smooth_ground_keeps_weaker_features_and_says_so() -> None:
    smooth = pixels_of(texture(450, 600, contrast=0.35, mean=140))
    strict = positions(detect_features(smooth, nfeatures=4000, contrast_floor=0.04))
    features = detect_features(smooth, nfeatures=4000)
    assert strict < positions(features) == 4000
    assert f"only {strict} keypoints reach the contrast threshold 0.04; 4000 were kept" in features.notes[0]


@pytest.mark.parametrize("wta_k", [3, 4])
def test_distance_of_orb_choices_among_three_or_four_is_opencvs(wta_k: int) -> None:
    gray = texture()
    found = detect_features(pixels_of(gray), detector="orb", nfeatures=200, orb=OrbOptions(wta_k=wta_k))
    theirs = cv2.ORB.create(nfeatures=200, WTA_K=wta_k).detectAndCompute(gray, None)[1]  # pyright: ignore
    ours = found.descriptors
    assert ours.shape == (len(theirs), 64)

    def distances(descriptors: np.ndarray, norm: int) -> np.ndarray:
        return np.array([[cv2.norm(a[None], b[None], norm) for b in descriptors] for a in descriptors])

    # OpenCV's order of keypoints is another
    expected = np.sort(2 * distances(theirs, cv2.NORM_HAMMING2), axis=1)
    actual = np.sort(distances(ours, cv2.NORM_HAMMING), axis=1)
    assert np.array_equal(actual[np.lexsort(actual.T)], expected[np.lexsort(expected.T)])


@pytest.mark.parametrize(
    "changed",
    [
        OrbOptions(scale_factor=1.4), OrbOptions(nlevels=4), OrbOptions(edge_px=50), OrbOptions(patch_px=21),
        OrbOptions(score="fast"), OrbOptions(fast_threshold=40),
    ],
)  # fmt: skip
def test_every_option_of_orb_changes_what_is_found(changed: OrbOptions) -> None:
    base, other = (detect_features(pixels_of(texture()), detector="orb", orb=orb) for orb in (OrbOptions(), changed))
    assert not np.array_equal(base.descriptors, other.descriptors)


def test_colours_are_those_under_the_keypoints() -> None:
    gray = texture()
    rgb = np.dstack([gray, 255 - gray, np.full_like(gray, 7)])
    features = detect_features(Pixels(gray=gray, rgb=rgb))
    column, row = features.xy_px.astype(int).T
    assert np.array_equal(features.rgb[:, 0], gray[row, column])
    assert np.array_equal(features.rgb[:, 1], 255 - gray[row, column])


def test_coverage_counts_the_cells_of_an_8_by_8_grid() -> None:
    half = detect_features(pixels_of(np.hstack([texture(), np.full((300, 400), 128, np.uint8)])))
    assert 0.45 < half.coverage < 0.6
    assert grid_coverage(np.zeros((0, 2)), 100, 100) == 0
    assert grid_coverage(np.array([[100.0, 100.0], [0.0, 0.0]]), 100, 100) == 2 / 64


@pytest.mark.skipif(hasattr(cv2, "AKAZE_create"), reason="this OpenCV has AKAZE")
def test_akaze_that_opencv_lacks_is_an_error_with_a_way_out() -> None:
    with pytest.raises(JaxbaError, match=r"detector=akaze: OpenCV .* take sift or orb"):
        detect_features(pixels_of(texture()), detector="akaze")
