"""Likeness of images, from their descriptors: which others each one looks most like, whatever their positions.

An image is told by a vector of locally aggregated descriptors (VLAD; Jegou, Douze, Schmid and Perez 2010): each of its
best descriptors goes to the nearest of `_WORDS` words, found by k-means among those of all images; a word's part is the
sum of what its descriptors are off from it. Parts are scaled to unit length, so that a texture that repeats counts once
(Arandjelovic and Zisserman 2013, "All about VLAD"), and so is the whole; likeness is the product of two vectors.

The vectors choose `_SHORTLIST` times as many images as are asked for; of these the ones with the most matches among
their `_MATCHED` best descriptors are taken. `python -m benchmarks.retrieval` gives what either finds.

Cost: two matrix products an image, 0.02 s for 1500 descriptors, one for all pairs of images, and 1 ms for each pair of
a shortlist, whose number grows as that of images.
"""

from collections.abc import Mapping

import numpy as np
from jaxtyping import Float, Int
from scipy.cluster.vq import kmeans2

from jaxba.scene import DescriptorKind, Features, descriptor_vectors, rising_pairs
from jaxba.vision._nearest import ratio_matches, two_nearest

_WORDS, _ROUNDS = 64, 10
_BEST = 1500  # descriptors of an image
_SAMPLE = 60_000  # of all images, that the words are found among
_BLOCK = 512  # images compared with all others at a time
_SHORTLIST = 2
_MATCHED, _RATIO = 400, 0.8  # 200 descriptors find 1 or 2% fewer of the pairs with many matches


def alike_pairs(features: Mapping[int, Features], images: Int[np.ndarray, " n"], count: int) -> Int[np.ndarray, "p 2"]:
    """Return the pairs, rising, of each of some images with the `count` others that look most like it.

    - `features`: of all images, by index, of one kind; one without keypoints is in no pair.
    """
    every = np.array([index for index in sorted(features) if features[index].num_keypoints], int)
    images = images[np.isin(images, every)]
    count = min(count, len(every) - 1)
    if count < 1 or not len(images):
        return np.zeros((0, 2), np.int64)
    row = np.searchsorted(every, images)
    near = _most_alike(features, every, row, min(_SHORTLIST * count, len(every) - 1))
    shortlist = rising_pairs(np.stack([np.repeat(row, near.shape[1]), near.reshape(-1)], axis=1))
    matches = _num_matches(features, every[shortlist])
    size = len(every)
    low, high = np.minimum(row[:, None], near), np.maximum(row[:, None], near)
    of_near = matches[np.searchsorted(shortlist @ [size, 1], low * size + high)]
    best = np.take_along_axis(near, np.argsort(-of_near, axis=1, kind="stable")[:, :count], axis=1)
    return rising_pairs(every[np.stack([np.repeat(row, count), best.reshape(-1)], axis=1)])


def _most_alike(
    features: Mapping[int, Features], every: Int[np.ndarray, " all"], row: Int[np.ndarray, " n"], count: int
) -> Int[np.ndarray, "n count"]:
    """Return the images whose vectors are most like those of some, the most alike first, as places in `every`."""
    words = _words(features, every)
    vectors = np.stack([_vector(_best(features[int(index)], _BEST), words) for index in every])
    found = []
    for begin in range(0, len(row), _BLOCK):
        these = row[begin : begin + _BLOCK]
        likeness = vectors[these] @ vectors.T
        likeness[np.arange(len(these)), these] = -np.inf
        found.append(np.argsort(-likeness, axis=1, kind="stable")[:, :count])
    return np.concatenate(found)


def _num_matches(features: Mapping[int, Features], pairs: Int[np.ndarray, "pairs 2"]) -> Int[np.ndarray, " pairs"]:
    """Return how many of the best descriptors match in each pair, by ratio test and mutual check."""
    ready: dict[int, tuple[np.ndarray, DescriptorKind]] = {}
    for index in np.unique(pairs).tolist():
        ready[index] = features[index].descriptors[:_MATCHED].copy(), features[index].kind
    found = np.zeros(len(pairs), np.int64)
    for k, (i, j) in enumerate(pairs.tolist()):
        (first, kind), (second, _) = ready[i], ready[j]
        if len(second) < 2:  # no second nearest
            continue
        nearest = two_nearest(descriptor_vectors(first, kind), descriptor_vectors(second, kind), kind)
        found[k] = len(ratio_matches(nearest, _RATIO)[0])
    return found


def _best(features: Features, count: int) -> Float[np.ndarray, "rows length"]:
    return descriptor_vectors(np.asarray(features.descriptors[:count]), features.kind)


def _words(features: Mapping[int, Features], images: Int[np.ndarray, " n"]) -> Float[np.ndarray, "words length"]:
    """Return the words, the same for the same features."""
    rng = np.random.default_rng(0)
    each = max(_SAMPLE // len(images), 1)
    sample = []
    for index in images:
        values = _best(features[int(index)], _BEST)
        sample.append(values[rng.permutation(len(values))[:each]])
    values = np.concatenate(sample).astype(np.float64)
    return kmeans2(values, min(_WORDS, len(values)), iter=_ROUNDS, minit="points", rng=rng)[0].astype(np.float32)


def _vector(
    values: Float[np.ndarray, "rows length"], words: Float[np.ndarray, "words length"]
) -> Float[np.ndarray, " parts"]:
    nearest = np.argmax(values @ words.T - 0.5 * np.sum(words**2, axis=1), axis=1)
    parts = np.zeros_like(words)
    np.add.at(parts, nearest, values - words[nearest])
    parts /= np.maximum(np.linalg.norm(parts, axis=1, keepdims=True), 1e-12)
    return (parts / max(float(np.linalg.norm(parts)), 1e-12)).reshape(-1)
