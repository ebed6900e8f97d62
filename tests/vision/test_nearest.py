import cv2
import numpy as np
import pytest
from scipy.spatial.distance import cdist

from jaxba.scene import Features, descriptor_vectors
from jaxba.vision import match_descriptors, prepare_descriptors
from jaxba.vision._nearest import ratio_matches, two_nearest


def sift_like(rng: np.random.Generator, count: int) -> np.ndarray:
    return np.clip(rng.gamma(0.5, 40, (count, 128)), 0, 255).astype(np.uint8)


def histograms(descriptors: np.ndarray) -> np.ndarray:
    return descriptor_vectors(descriptors, "histogram")


def features_of(descriptors: np.ndarray, xy_px: np.ndarray | None = None) -> Features:
    count = len(descriptors)
    xy_px = np.arange(2.0 * count).reshape(count, 2) if xy_px is None else xy_px
    return Features(
        detector="sift" if descriptors.shape[1] == 128 else "orb",
        xy_px=xy_px,
        size_px=np.ones(count),
        angle_rad=np.zeros(count),
        descriptors=descriptors,
        rgb=np.zeros((count, 3), np.uint8),
        mean_brightness=100.0,
        coverage=1.0,
    )


@pytest.mark.parametrize("count", [2, 255, 256, 1000])
def test_two_nearest_are_those_of_opencvs_brute_force(count: int) -> None:
    rng = np.random.default_rng(count)
    first, second = histograms(sift_like(rng, 700)), histograms(sift_like(rng, count))
    found = two_nearest(first, second, "histogram")
    expected = cv2.BFMatcher(cv2.NORM_L2).knnMatch(first, second, k=2)
    assert np.array_equal(found.index, [m[0].trainIdx for m in expected])
    np.testing.assert_allclose(found.nearest, [m[0].distance for m in expected], atol=1e-5)
    np.testing.assert_allclose(found.second, [m[1].distance for m in expected], atol=1e-5)
    mutual = cv2.BFMatcher(cv2.NORM_L2, crossCheck=True).match(first, second)
    assert np.array_equal(np.flatnonzero(found.is_mutual), sorted(m.queryIdx for m in mutual))


def test_distances_are_those_of_hellinger() -> None:
    rng = np.random.default_rng(0)
    a, b = sift_like(rng, 50), sift_like(rng, 60)
    p, q = a / a.sum(axis=1, keepdims=True), b / b.sum(axis=1, keepdims=True)
    hellinger = np.sqrt(2 - 2 * np.sqrt(p[:, None] * q[None]).sum(axis=2))
    found = two_nearest(histograms(a), histograms(b), "histogram")
    np.testing.assert_allclose(found.nearest, hellinger.min(axis=1), atol=1e-5)
    np.testing.assert_allclose(found.second, np.sort(hellinger, axis=1)[:, 1], atol=1e-5)


def test_histograms_have_unit_length_and_bear_an_empty_one() -> None:
    values = np.concatenate([sift_like(np.random.default_rng(0), 20), np.zeros((1, 128), np.uint8)])
    unit = histograms(values)
    assert unit.dtype == np.float32 and unit.flags.c_contiguous
    np.testing.assert_allclose(np.linalg.norm(unit[:20], axis=1), 1, atol=1e-6)
    assert not unit[20].any()


def test_equal_descriptors_give_one_mutual_match_and_no_distinct_one() -> None:
    same = histograms(np.repeat(sift_like(np.random.default_rng(0), 1), 5, axis=0))
    found = two_nearest(same, same, "histogram")
    assert found.index.tolist() == [0] * 5
    assert found.is_mutual.tolist() == [True, False, False, False, False]
    assert len(ratio_matches(found, 0.85)[0]) == 0


def test_hamming_is_that_of_counted_bits() -> None:
    rng = np.random.default_rng(0)
    a, b = (rng.integers(0, 256, (count, 32), dtype=np.uint8) for count in (80, 90))
    distance = 256 * cdist(np.unpackbits(a, axis=1), np.unpackbits(b, axis=1), "hamming")
    found = two_nearest(descriptor_vectors(a, "bits"), descriptor_vectors(b, "bits"), "bits")
    np.testing.assert_array_equal(found.nearest, distance.min(axis=1).round())
    np.testing.assert_array_equal(found.second, np.sort(distance, axis=1)[:, 1].round())
    assert np.array_equal(distance[np.arange(80), found.index].round(), found.nearest)
    shared = found.nearest == distance.min(axis=0)[found.index].round()
    earlier = [k for k in range(80) if any(shared[j] and found.index[j] == found.index[k] for j in range(k))]
    assert np.array_equal(np.flatnonzero(found.is_mutual), np.setdiff1d(np.flatnonzero(shared), earlier))


def test_bits_are_matched_as_by_opencv() -> None:
    rng = np.random.default_rng(1)
    a = rng.integers(0, 256, (300, 32), dtype=np.uint8)
    b = a[rng.permutation(300)] ^ (rng.random((300, 32)) < 0.3).astype(np.uint8)
    theirs = cv2.BFMatcher(cv2.NORM_HAMMING).knnMatch(a, b, k=2)
    found = two_nearest(descriptor_vectors(a, "bits"), descriptor_vectors(b, "bits"), "bits")
    assert found.index.tolist() == [near.trainIdx for near, _ in theirs]
    assert found.nearest.tolist() == [near.distance for near, _ in theirs]
    assert found.second.tolist() == [other.distance for _, other in theirs]


@pytest.mark.parametrize("bits", [False, True])
def test_noisy_copies_are_matched_and_strangers_are_not(bits: bool) -> None:
    rng = np.random.default_rng(0)
    order = rng.permutation(300)
    if bits:
        first = rng.integers(0, 256, (400, 32), dtype=np.uint8)
        second = first[order] ^ np.where(rng.random((300, 32)) < 0.1, 4, 0).astype(np.uint8)
    else:
        first = sift_like(rng, 400)
        second = np.clip(first[order] + rng.normal(0, 5, (300, 128)), 0, 255).astype(np.uint8)
    matches, distinctiveness = match_descriptors(
        prepare_descriptors(features_of(first)), prepare_descriptors(features_of(second)), 0.75
    )
    assert np.array_equal(order[matches[:, 1]], matches[:, 0]) and len(matches) == 300
    assert np.all(np.diff(matches[:, 0]) > 0) and np.all(distinctiveness > 0.25)


def test_keypoint_of_two_orientations_is_in_one_match() -> None:
    rng = np.random.default_rng(0)
    descriptors = sift_like(rng, 40)
    xy_px = np.repeat(rng.uniform(0, 500, (20, 2)), 2, axis=0)  # each position twice
    turned = descriptors.reshape(20, 2, 128)[:, ::-1].reshape(40, 128)  # the other orientation first
    matches, _ = match_descriptors(
        prepare_descriptors(features_of(descriptors, xy_px)), prepare_descriptors(features_of(turned, xy_px)), 0.75
    )
    assert matches.tolist() == [[2 * k, 2 * k] for k in range(20)]


@pytest.mark.parametrize("count", [0, 1])
def test_image_of_less_than_two_features_has_no_match(count: int) -> None:
    rng = np.random.default_rng(0)
    few, many = (prepare_descriptors(features_of(sift_like(rng, n))) for n in (count, 50))
    for pair in ((few, many), (many, few)):
        matches, distinctiveness = match_descriptors(*pair, 0.75)
        assert matches.shape == (0, 2) and distinctiveness.shape == (0,)
