"""Candidate pairs from positions or order alone, where footprints are unknown or leave photos on their own."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float, Int

from jaxba.scene._graph import component_labels
from jaxba.scene._view_graph import ViewGraph


def nearest_pairs(xy_m: Float[np.ndarray, "n 2"], count: int) -> Int[np.ndarray, "pairs 2"]:
    """Return the pairs, rising, of each place with its `count` nearest others.

    >>> nearest_pairs(np.array([[0.0, 0], [1, 0], [3, 0]]), 1).tolist()
    [[0, 1], [1, 2]]
    """
    count = min(count, len(xy_m) - 1)
    if count < 1:
        return np.zeros((0, 2), np.int64)
    from scipy.spatial import KDTree

    found = np.asarray(KDTree(xy_m).query(xy_m, k=count + 1)[1])  # with itself, except among many at one place
    pairs = np.stack([np.repeat(np.arange(len(xy_m)), count + 1), found.reshape(-1)], axis=1)
    return rising_pairs(pairs[pairs[:, 0] != pairs[:, 1]])


def window_pairs(order: Int[np.ndarray, " n"], window: int) -> Int[np.ndarray, "pairs 2"]:
    """Return the pairs, rising, of what stands at most `window` apart in the order.

    >>> window_pairs(np.array([2, 0, 1]), 1).tolist()
    [[0, 1], [0, 2]]
    """
    parts = [np.stack([order[:-step], order[step:]], axis=1) for step in range(1, min(window, len(order) - 1) + 1)]
    return rising_pairs(np.concatenate([np.zeros((0, 2), np.int64), *parts]))


def joining_pairs(
    pairs: Int[np.ndarray, "pairs 2"], xy_m: Float[np.ndarray, "n 2"], count: int
) -> Int[np.ndarray, "joining 2"]:
    """Return pairs, rising, that join the groups into which `pairs` leave the places.

    One group after the other, the smallest first, gets its `count` closest pairs with the rest, until all are joined.
    """
    from scipy.spatial import KDTree

    added = np.zeros((0, 2), np.int64)
    while True:
        labels = component_labels(np.concatenate([pairs, added]), len(xy_m))
        sizes = np.bincount(labels)
        if len(sizes) < 2:
            return rising_pairs(added)
        inside = labels == np.argmin(sizes)
        group, rest = np.flatnonzero(inside), np.flatnonzero(~inside)
        distance, nearest = map(np.asarray, KDTree(xy_m[rest]).query(xy_m[group], k=min(count, len(rest))))
        ends = np.stack(np.broadcast_arrays(group[:, None], rest[nearest.reshape(len(group), -1)]), axis=-1)
        closest = np.argsort(distance.reshape(-1), kind="stable")[:count]
        added = np.concatenate([added, ends.reshape(-1, 2)[closest]])


def pairs_between(groups: Sequence[tuple[int, ...]], graph: ViewGraph) -> Int[np.ndarray, " pairs"]:
    """Return the rows of the candidate pairs that would join groups of images, those with the most matches first."""
    label = {image: number for number, group in enumerate(groups) for image in group}
    ends = np.array([(label.get(i, -1), label.get(j, -1)) for i, j in graph.pairs.tolist()], int).reshape(-1, 2)
    between = np.flatnonzero((ends[:, 0] != ends[:, 1]) & (ends >= 0).all(axis=1))
    return between[np.argsort(-graph.num_putative[between], kind="stable")]


def rising_pairs(pairs: Int[np.ndarray, "any 2"]) -> Int[np.ndarray, "pairs 2"]:
    """Return each pair once, its lower end first, in rising order."""
    return np.unique(np.sort(pairs, axis=1), axis=0).astype(np.int64).reshape(-1, 2)
