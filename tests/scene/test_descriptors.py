import numpy as np
import pytest

from jaxba.scene import (
    LEARNED,
    DescriptorKind,
    descriptor_distances,
    descriptor_vectors,
    distances_of_products,
    unit_bytes,
)


def unit_vectors(count: int, length: int = 128) -> np.ndarray:
    vectors = np.random.default_rng(count).normal(size=(count, length)) ** 3  # some large components, many small ones
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


@pytest.mark.parametrize("length", [64, 128])
def test_bytes_turn_a_unit_vector_by_less_than_the_distance_of_matches_shows(length: int) -> None:
    vectors = unit_vectors(500, length)
    back = descriptor_vectors(unit_bytes(vectors), "unit")
    assert back.dtype == np.float32
    np.testing.assert_allclose(np.linalg.norm(back, axis=1), 1, atol=1e-6)
    assert np.linalg.norm(back - vectors, axis=1).max() < 0.03  # matches are 0.3 and more apart
    assert np.array_equal(unit_bytes(back.astype(float)), unit_bytes(vectors))


def test_bytes_of_a_vector_do_not_depend_on_its_length_and_bear_an_empty_one() -> None:
    vectors = unit_vectors(20)
    assert np.array_equal(unit_bytes(7.5 * vectors), unit_bytes(vectors))
    assert not descriptor_vectors(unit_bytes(np.zeros((1, 128))), "unit").any()
    assert unit_bytes(np.zeros((0, 64))).shape == (0, 64)


@pytest.mark.parametrize("kind", ["histogram", "bits", "unit"])
def test_distances_by_bytes_are_those_of_the_vectors(kind: DescriptorKind) -> None:
    rng = np.random.default_rng(0)
    first, second = rng.integers(0, 256, (2, 300, 32), dtype=np.uint8)
    vectors = descriptor_vectors(first, kind), descriptor_vectors(second, kind)
    products = np.einsum("nl,nl->n", *vectors)
    expected = distances_of_products(products, vectors[0].shape[1], kind)
    np.testing.assert_allclose(descriptor_distances(first, second, kind), expected, atol=2e-3)
    if kind != "bits":
        np.testing.assert_allclose(expected, np.linalg.norm(vectors[0] - vectors[1], axis=1), atol=2e-3)


def test_learned_detectors_are_those_whose_descriptors_are_unit_vectors() -> None:
    assert LEARNED == ("aliked", "xfeat")
