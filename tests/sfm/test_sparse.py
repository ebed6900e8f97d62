"""Sparse blocks equal dense ones."""

import numpy as np
from scipy import sparse

from jaxba.sfm._sparse import block_diagonal, block_matrix, solve_positive, sum_rows


def test_block_products_equal_dense_ones() -> None:
    rng = np.random.default_rng(0)
    row, column, blocks = np.array([1, 0, 1]), np.array([0, 2, 2]), rng.normal(size=(3, 2, 3))
    dense = np.zeros((4, 9))
    for r, c, block in zip(row, column, blocks, strict=True):
        dense[2 * r : 2 * r + 2, 3 * c : 3 * c + 3] = block
    found = block_matrix(blocks, row, column, (2, 3))
    np.testing.assert_allclose((found @ found.T).toarray(), dense @ dense.T, rtol=1e-14, atol=1e-15)
    square = rng.normal(size=(2, 2, 2))
    expected = np.zeros((4, 4))
    expected[:2, :2], expected[2:, 2:] = square
    np.testing.assert_array_equal(block_diagonal(square).toarray(), expected)
    np.testing.assert_array_equal(sum_rows(np.eye(3), np.array([0, 1, 1]), 3), [[1, 0, 0], [0, 1, 1], [0, 0, 0]])


def test_positive_systems_are_solved_for_one_side_or_several() -> None:
    rng = np.random.default_rng(1)
    root = rng.normal(size=(6, 6)) * np.logspace(0, 4, 6)  # units of 1 to 1e4
    matrix, right = root.T @ root + np.eye(6), rng.normal(size=(6, 2))
    found = solve_positive(sparse.csc_array(matrix), right)
    np.testing.assert_allclose(matrix @ found, right, rtol=0, atol=1e-9)
    np.testing.assert_allclose(solve_positive(sparse.csc_array(matrix), right[:, 0]), found[:, 0], rtol=1e-12)
