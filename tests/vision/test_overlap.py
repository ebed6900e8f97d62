"""What may be left out of a search is what the other image does not show."""

import numpy as np
import pytest

from jaxba.scene import descriptor_vectors
from jaxba.vision import common_ground
from jaxba.vision._nearest import Descriptors, match_descriptors

SIZE = (1600, 1200)


def descriptors(values: np.ndarray) -> Descriptors:
    return Descriptors(
        values=descriptor_vectors(values, "histogram"), kind="histogram", first_index=np.arange(len(values))
    )


def two_images(
    shift_px: tuple[float, float],
    turn_rad: float = 0.0,
    relief_px: float = 0.0,
    count: int = 6000,
    doubles: int = 1,
) -> list[tuple[np.ndarray, np.ndarray, Descriptors]]:
    """Return two images of one ground, the second moved and turned: which points they show, pixels and descriptors.

    - `doubles`: how many points look alike.
    """
    rng = np.random.default_rng(3)
    ground = rng.uniform(-2000, 3600, (2 * count, 2))
    look = (150 * rng.random((2 * count // doubles, 128)) ** 8).repeat(
        doubles, axis=0
    )  # few large entries, as SIFT has
    cosine, sine = np.cos(turn_rad), np.sin(turn_rad)
    moved = (ground - 800) @ np.array([[cosine, sine], [-sine, cosine]]) + 800 + shift_px
    moved += relief_px * rng.uniform(-1, 1, (len(ground), 1)) * np.array([1.0, 0.0])
    images = []
    for pixels in (ground, moved):
        rows = rng.permutation(np.flatnonzero(np.all((pixels > 0) & (pixels < SIZE), axis=1)))
        noisy = np.clip(look[rows] + rng.integers(-3, 4, (len(rows), 128)), 0, 255).astype(np.uint8)
        images.append((rows, pixels[rows], descriptors(noisy)))
    return images


def ground_of(
    first: Descriptors, second: Descriptors, first_px: np.ndarray, second_px: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    coarse, _ = match_descriptors(first.first(1500), second.first(1500), 0.75)
    return common_ground(coarse, first_px, second_px, SIZE, SIZE)


@pytest.mark.parametrize(
    ("shift", "turn", "relief", "most"),
    [((800, 0), 0.0, 0.0, 0.65), ((300, 500), 3.0, 30.0, 0.75), ((-900, 600), 0.5, 30.0, 0.6), ((0, 0), 0.0, 0.0, 1.0)],
)
def test_every_true_pair_stays_and_the_rest_goes(shift, turn, relief, most) -> None:
    (first_rows, first_px, first), (second_rows, second_px, second) = two_images(shift, turn, relief)
    first_ground, second_ground = ground_of(first, second, first_px, second_px)
    shared = np.intersect1d(first_rows, second_rows)
    assert len(shared) > 100
    assert set(shared) <= set(first_rows[first_ground]) and set(shared) <= set(second_rows[second_ground])
    assert len(first_ground) <= most * len(first_rows)


def test_the_search_finds_the_same_matches_without_the_rest() -> None:
    (_, first_px, first), (_, second_px, second) = two_images((700, 200), 0.1, 20.0)
    rows, columns = ground_of(first, second, first_px, second_px)
    whole, _ = match_descriptors(first, second, 0.75)
    part, _ = match_descriptors(first.take(rows), second.take(columns), 0.75)
    whole, part = set(map(tuple, whole.tolist())), set(map(tuple, part.tolist()))
    assert len(whole) > 300 and len(whole - part) < 0.002 * len(whole)


def test_nothing_is_left_out_of_images_of_different_ground() -> None:
    (_, first_px, first), (_, second_px, second) = two_images((5000, 0))
    rows, columns = ground_of(first, second, first_px, second_px)
    assert len(rows) == len(first_px) and len(columns) == len(second_px)


@pytest.mark.parametrize("count", [0, 1, 30])
def test_few_features_are_all_compared(count: int) -> None:
    (_, first_px, first), (_, second_px, second) = two_images((100, 0))
    rows, columns = ground_of(first.first(count), second, first_px[:count], second_px)
    assert len(rows) == count and len(columns) == len(second_px)
