"""Averaged rotations equal the truth up to one common rotation, whatever some of the edges say."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jaxba.sfm._rotations import _from_tree, average_rotations


def edges(
    num_images: int, rng: np.random.Generator, *, noise_rad: float, wrong: float, reach: int = 5
) -> tuple[Rotation, np.ndarray, np.ndarray, np.ndarray]:
    """Random rotations, each joined with the next `reach`; a share `wrong` of the edges is 12 to 90 degrees off."""
    true = Rotation.random(num_images, rng=rng)
    pairs = np.array([(i, j) for i in range(num_images) for j in range(i + 1, min(i + 1 + reach, num_images))])
    relative = true[pairs[:, 1]] * true[pairs[:, 0]].inv()
    is_wrong = np.zeros(len(pairs), bool)
    is_wrong[rng.permutation(len(pairs))[: round(wrong * len(pairs))]] = True
    axis = rng.normal(size=(len(pairs), 3))
    axis *= np.deg2rad(rng.uniform(12, 90, size=(len(pairs), 1))) / np.linalg.norm(axis, axis=1, keepdims=True)
    turn = np.where(is_wrong[:, None], axis, noise_rad * rng.normal(size=(len(pairs), 3)))
    return true, pairs, (Rotation.from_rotvec(turn) * relative).as_quat(scalar_first=True), is_wrong


def angles(found: np.ndarray, true: Rotation) -> np.ndarray:
    turn = Rotation.from_quat(found, scalar_first=True).inv() * true
    return (turn * turn.mean().inv()).magnitude()


def test_exact_relative_rotations_give_exact_rotations() -> None:
    true, pairs, quaternion, _ = edges(20, np.random.default_rng(0), noise_rad=0.0, wrong=0.0)
    found, used, error = average_rotations(20, pairs, quaternion, np.ones(len(pairs)), max_error_rad=0.1)
    assert used.all()
    assert error.max() < 1e-7 and angles(found, true).max() < 1e-7  # rounding of arccos near 1


def test_start_values_are_chained_along_edges_in_both_directions() -> None:
    """The averaging after them would mend a start that is wrong in one of the two, where edges are good."""
    true, pairs, quaternion, _ = edges(20, np.random.default_rng(0), noise_rad=0.0, wrong=0.0)
    relative, weight = Rotation.from_quat(quaternion, scalar_first=True), 1.0 / (1 + np.abs(pairs.mean(axis=1) - 10))
    found = _from_tree(20, pairs, relative, weight, np.ones(20, bool)).as_quat(scalar_first=True)
    assert angles(found, true).max() < 1e-7  # rounding of arccos near 1


@pytest.mark.parametrize("seed", range(5))
def test_a_fifth_of_wrong_edges_is_found_and_does_no_harm(seed: int) -> None:
    rng = np.random.default_rng(seed)
    true, pairs, quaternion, is_wrong = edges(60, rng, noise_rad=0.005, wrong=0.2)
    found, used, error = average_rotations(60, pairs, quaternion, np.ones(len(pairs)), max_error_rad=0.1)
    np.testing.assert_array_equal(used, ~is_wrong)
    assert error[is_wrong].min() > 0.1
    # a chain of 60 images with 5 edges each drifts by about noise x sqrt(60 / 5), and not by any wrong edge's 0.2
    assert angles(found, true).max() < 0.04


def test_images_that_only_wrong_edges_join_are_left_out() -> None:
    rng = np.random.default_rng(1)
    _, pairs, quaternion, _ = edges(12, rng, noise_rad=0.001, wrong=0.0, reach=3)
    pairs = np.concatenate([pairs, [[2, 12], [3, 12], [4, 12]]])
    quaternion = np.concatenate([quaternion, Rotation.random(3, rng=rng).as_quat(scalar_first=True)])
    found, used, _ = average_rotations(13, pairs, quaternion, np.full(len(pairs), 50.0), max_error_rad=0.1)
    assert np.isfinite(found[:12]).all()
    # one of three edges alone contradicts nothing that remains, so the image may hang on one of them
    assert used[-3:].sum() <= 1 and used[:-3].all()


def test_only_the_largest_group_is_averaged() -> None:
    rng = np.random.default_rng(2)
    _, first, first_q, _ = edges(8, rng, noise_rad=0.0, wrong=0.0)
    _, second, second_q, _ = edges(4, rng, noise_rad=0.0, wrong=0.0)
    pairs, quaternion = np.concatenate([first, second + 8]), np.concatenate([first_q, second_q])
    found, used, error = average_rotations(12, pairs, quaternion, np.ones(len(pairs)), max_error_rad=0.1)
    assert np.isfinite(found[:8]).all() and np.isnan(found[8:]).all()
    np.testing.assert_array_equal(used, np.arange(len(pairs)) < len(first))
    assert np.isnan(error[len(first) :]).all()
