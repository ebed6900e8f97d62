"""Kinds of descriptors: by which detector, how they lie in bytes, and how two are compared.

| kind | of | bytes | as a vector | distance, p the product of two vectors |
| --- | --- | --- | --- | --- |
| histogram | SIFT | counts | square roots of the shares, of unit length | sqrt(2 - 2 p) |
| bits | ORB, AKAZE | eight bits each | n numbers 1 and -1 | (n - p) / 2, the Hamming distance, exactly |
| unit | ALIKED, XFeat | 128 + 127 x / max abs(x), rounded | the same x, of unit length | sqrt(2 - 2 p) |

The square roots are those of Arandjelovic and Zisserman (2012), "Three things everyone should know".
Rounding turns a unit vector of 128 components by 0.01 or less, where those of one point are 0.3 or more apart.
"""

from typing import Literal

import numpy as np
from jaxtyping import Float, UInt8

Detector = Literal["sift", "orb", "akaze", "aliked", "xfeat"]
DescriptorKind = Literal["histogram", "bits", "unit"]

KIND_OF: dict[Detector, DescriptorKind] = {
    "sift": "histogram", "orb": "bits", "akaze": "bits", "aliked": "unit", "xfeat": "unit",
}  # fmt: skip
DETECTORS = tuple(KIND_OF)
LEARNED = tuple(detector for detector, kind in KIND_OF.items() if kind == "unit")

_ZERO, _LARGEST = 128, 127


def descriptor_vectors(
    descriptors: UInt8[np.ndarray, "rows bytes"], kind: DescriptorKind
) -> Float[np.ndarray, "rows length"]:
    """Return descriptors as vectors, float32, whose products tell their distances.

    >>> descriptor_vectors(np.array([[9, 16, 0, 0]], np.uint8), "histogram").tolist()
    [[0.6000000238418579, 0.800000011920929, 0.0, 0.0]]
    >>> descriptor_vectors(np.array([[5]], np.uint8), "bits").tolist()
    [[-1.0, -1.0, -1.0, -1.0, -1.0, 1.0, -1.0, 1.0]]
    """
    if kind == "bits":
        return 2.0 * np.unpackbits(descriptors, axis=1).astype(np.float32) - 1.0
    if kind == "unit":
        values = descriptors.astype(np.float32) - _ZERO
        return values / np.maximum(np.linalg.norm(values, axis=1, keepdims=True), 1)
    total = np.maximum(descriptors.sum(axis=1, dtype=np.int64), 1).astype(np.float32)
    return np.sqrt(descriptors / total[:, None], dtype=np.float32)


def unit_bytes(vectors: Float[np.ndarray, "rows length"]) -> UInt8[np.ndarray, "rows length"]:
    """Return the bytes of descriptors of kind `unit`, whatever the length of each vector.

    >>> unit_bytes(np.array([[0.6, -0.8, 0.0]])).tolist()
    [[223, 1, 128]]
    """
    largest = np.max(np.abs(vectors), axis=1, keepdims=True, initial=0.0)
    return (_ZERO + np.rint(vectors * (_LARGEST / np.maximum(largest, 1e-12)))).astype(np.uint8)


def distances_of_products(
    products: Float[np.ndarray, " n"], length: int, kind: DescriptorKind
) -> Float[np.ndarray, " n"]:
    """Return the distances of descriptors, by the products of their vectors of this length."""
    if kind == "bits":
        return (length - products.astype(np.float64)) / 2
    return np.sqrt(np.maximum(2.0 - 2.0 * products.astype(np.float64), 0.0))


def descriptor_distances(
    first: UInt8[np.ndarray, "n bytes"], second: UInt8[np.ndarray, "n bytes"], kind: DescriptorKind
) -> Float[np.ndarray, " n"]:
    """Return the distance of each descriptor from the one in the same row, without making vectors of them."""
    if kind == "bits":
        return np.bitwise_count(first ^ second).sum(axis=1, dtype=np.float64)
    if kind == "unit":
        vectors = descriptor_vectors(first, kind), descriptor_vectors(second, kind)
        return distances_of_products(np.einsum("nl,nl->n", *vectors), first.shape[1], kind)
    product = np.sqrt(first.astype(np.float32) * second).sum(axis=1, dtype=np.float64)
    total = first.sum(axis=1, dtype=np.float64) * second.sum(axis=1, dtype=np.float64)
    return np.sqrt(np.maximum(2 - 2 * product / np.sqrt(np.maximum(total, 1.0)), 0.0))
