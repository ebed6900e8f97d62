"""Images that look alike: those that see the same ground, found by their descriptors alone."""

import numpy as np
import pytest
from test_nearest import features_of, sift_like

from jaxba.scene import Features
from jaxba.vision import alike_pairs

NUM, SHARED, EACH = 60, 0.7, 400


def strip(detector: str, seed: int = 0) -> dict[int, Features]:
    """Return images along a strip of ground, each seeing a window of its descriptors anew, with as many of its own."""
    rng = np.random.default_rng(seed)
    step = round(EACH * (1 - SHARED))
    ground = sift_like(rng, step * NUM + EACH) if detector == "sift" else bits(rng, step * NUM + EACH)
    found = {}
    for image in range(NUM):
        seen = ground[image * step : image * step + EACH][rng.permutation(EACH)]
        if detector == "sift":
            seen = np.clip(seen + rng.normal(0, 8, seen.shape), 0, 255).astype(np.uint8)
            own = sift_like(rng, EACH)
        else:
            seen, own = seen ^ (bits(rng, EACH) & bits(rng, EACH) & bits(rng, EACH)), bits(rng, EACH)
        found[image] = features_of(np.concatenate([seen, own])[rng.permutation(2 * EACH)])
    return found


def bits(rng: np.random.Generator, count: int) -> np.ndarray:
    return rng.integers(0, 256, (count, 32), dtype=np.uint8)


@pytest.mark.parametrize("detector", ["sift", "orb"])
def test_images_of_the_same_ground_are_alike(detector: str) -> None:
    # breaks where vectors are told by what all images have in common, or bits are taken for numbers
    features = strip(detector)
    found = alike_pairs(features, np.arange(NUM), 4)
    near = np.array([[i, i + k] for k in (1, 2) for i in range(NUM - k)])
    assert np.all(found[:, 0] < found[:, 1]) and len(np.unique(found, axis=0)) == len(found)
    recall = np.mean([(found == pair).all(axis=1).any() for pair in near])
    assert recall > 0.9, recall  # by chance 0.13
    np.testing.assert_array_equal(found, alike_pairs(features, np.arange(NUM), 4))


def test_matches_tell_the_same_ground_from_the_same_texture() -> None:
    # breaks where vectors alone choose: images of one texture, a field's, are more alike than two of one place
    rng = np.random.default_rng(0)
    textures = sift_like(rng, 150), sift_like(rng, 150)
    features = {}
    for pair in range(6):  # images 2 k and 2 k + 1 see one place, in different textures
        ground = sift_like(rng, 80)
        for side, texture in enumerate(textures):
            seen = np.clip(np.concatenate([ground, texture, texture]) + rng.normal(0, 4, (380, 128)), 0, 255)
            features[2 * pair + side] = features_of(seen.astype(np.uint8)[rng.permutation(380)])
    found = alike_pairs(features, np.arange(12), 3)
    assert {(k, k + 1) for k in range(0, 12, 2)} <= set(map(tuple, found.tolist()))


def test_partners_are_looked_for_of_the_images_asked_for_alone() -> None:
    features = strip("sift")
    empty = features_of(np.zeros((0, 128), np.uint8))
    features[7] = empty
    found = alike_pairs(features, np.array([7, 20, 30]), 3)
    assert 3 <= len(found) <= 6 and np.isin(found, [20, 30]).any(axis=1).all() and not np.isin(found, 7).any()
    assert {19, 21} <= set(found.ravel())
    every = alike_pairs({k: features[k] for k in (1, 2, 3)}, np.array([1, 2, 3]), 20)
    assert every.tolist() == [[1, 2], [1, 3], [2, 3]]
    assert alike_pairs({1: features[1]}, np.array([1]), 20).shape == (0, 2)
    assert alike_pairs({1: empty, 2: empty}, np.array([1]), 20).shape == (0, 2)
