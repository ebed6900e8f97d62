"""Sparse normal equations in blocks, and their solution."""

import numpy as np
from jaxtyping import Float, Int
from scipy import sparse
from scipy.sparse.linalg import splu


def solve_positive(matrix: sparse.csc_array, right: Float[np.ndarray, "n *columns"]) -> Float[np.ndarray, "n *columns"]:
    """Return the solution of a positive definite system.

    Pivots stay on the diagonal: with SuperLU's default threshold, rows of other units (metres beside radians) fill the
    factor in, 0.4 s instead of 0.05 s for 500 images.
    """
    factor = splu(matrix, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True})
    return factor.solve(right)


def sum_rows(
    rows: Float[np.ndarray, "rows columns"], group: Int[np.ndarray, " rows"], num_groups: int
) -> Float[np.ndarray, "groups columns"]:
    """Return the sums of rows of each group."""
    return np.stack([np.bincount(group, column, minlength=num_groups) for column in rows.T], axis=1)


def block_matrix(
    blocks: Float[np.ndarray, "blocks r c"],
    row: Int[np.ndarray, " blocks"],
    column: Int[np.ndarray, " blocks"],
    shape: tuple[int, int],
) -> sparse.bsr_array:
    """Return the sparse matrix of these blocks; `shape` counts blocks. Products of such matrices go block by block."""
    order = np.lexsort((column, row))
    start = np.concatenate([[0], np.cumsum(np.bincount(row, minlength=shape[0]))])
    r, c = blocks.shape[1:]
    return sparse.bsr_array((blocks[order], column[order], start), shape=(r * shape[0], c * shape[1]))


def block_diagonal(blocks: Float[np.ndarray, "blocks r r"]) -> sparse.bsr_array:
    """Return the sparse matrix with these blocks on its diagonal."""
    every = np.arange(len(blocks))
    return block_matrix(blocks, every, every, (len(blocks), len(blocks)))
