"""Dense kernels of fronts: Cholesky, Schur complement and inverse by blocks, on any number of threads.

Everything is in rows of C order, and of symmetric matrices the lower triangle alone is read. Nearly all arithmetic is
in products of blocks by numpy, which lets other threads run meanwhile, as scipy's BLAS and LAPACK do not. Each block is
computed by one thread and in one order: the same bytes whatever the number of threads. BLAS itself is meant to have one
thread: the waits of its own for each other made fronts forty times slower on a machine with other work.
"""

import itertools
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor

import numpy as np
from jaxtyping import Float
from scipy.linalg import get_blas_funcs

_trsm, _trsv = get_blas_funcs(("trsm", "trsv"), dtype=np.float64)

_BLOCK = 384
_WORTH_THREADS = 2e8  # flops

Matrix = Float[np.ndarray, "_ _"]


class NotPositive(Exception):
    """A matrix is not positive definite: of a front it says that the damping is too small."""


def factor(f11: Matrix, f21: Matrix, f22: Matrix, pool: ThreadPoolExecutor | None = None) -> None:
    """Replace F11 by L, F21 by X = F21 L^-T and F22 by F22 - X X^T, lower triangles alone.

    - `pool`: threads for large matrices; without one the work is done in the calling thread.

    Raises `NotPositive` where F11 is not positive definite.
    """
    own, rest = len(f11), len(f21)
    large = own * float(own + rest) ** 2 > _WORTH_THREADS
    for begin, end in _blocks(own):
        before, corner = f11[begin:end, :begin], f11[begin:end, begin:end]
        if begin:
            with np.errstate(invalid="ignore", over="ignore"):  # what stands above the diagonal may be anything
                corner -= before @ before.T
        try:
            corner[:] = np.linalg.cholesky(corner)
        except np.linalg.LinAlgError as error:
            raise NotPositive from error

        def column(rows: Matrix, *, begin: int = begin, end: int = end) -> None:
            if begin:
                rows[:, begin:end] -= rows[:, :begin] @ f11[begin:end, :begin].T
            rows[:, begin:end] = _trsm(1.0, f11[begin:end, begin:end].T, rows[:, begin:end].T, lower=0, trans_a=1).T

        below = [f11[a + end : b + end] for a, b in _blocks(own - end)] + [f21[a:b] for a, b in _blocks(rest)]
        _each(column, ((rows,) for rows in below), pool if large else None)
    _each(
        _subtract_product, ((f22, f21, f21, rows, columns) for rows, columns in _lower(rest)), pool if large else None
    )


def divide(rows: Matrix, root: Matrix, pool: ThreadPoolExecutor | None = None) -> None:
    """Replace rows by their product with L^-1."""
    large = float(len(rows)) * len(root) ** 2 > _WORTH_THREADS
    _each(_divide, ((rows[a:b], root, len(root)) for a, b in _blocks(len(rows))), pool if large else None)


def inverse(root: Matrix, across: Matrix, of_rest: Matrix, whole: Matrix, pool: ThreadPoolExecutor | None) -> None:
    """Write the inverse over a front into `whole`, from L, X and the inverse over the rest, which is whole as well.

    With P^T = X L^-1:  Z_ro = -Z_rr P^T  and  Z_oo = L^-T L^-1 - P Z_ro.
    """
    own, rest = len(root), len(across)
    pool = pool if own * float(own + rest) ** 2 > _WORTH_THREADS else None
    through, unit = across.copy(), np.eye(own)
    divide(through, root, pool)
    _each(_divide, ((unit[a:b], root, b) for a, b in _blocks(own)), pool)
    whole[own:, own:] = of_rest

    def to_rest(a: int, b: int) -> None:
        part = whole[own + a : own + b, :own]
        np.matmul(of_rest[a:b], through, out=part)
        np.negative(part, out=part)
        whole[:own, own + a : own + b] = part.T

    def of_own(rows: tuple[int, int], columns: tuple[int, int]) -> None:
        (a, b), (c, d) = rows, columns
        part = unit[a:, a:b].T @ unit[a:, c:d] - through[:, a:b].T @ whole[own:, c:d]
        whole[c:d, a:b] = part.T
        whole[a:b, c:d] = part

    _each(to_rest, _blocks(rest), pool)
    _each(of_own, _lower(own), pool)


def solve_transposed(root: Matrix, rhs: Float[np.ndarray, " rows"]) -> Float[np.ndarray, " rows"]:
    """Return L^-T b."""
    return _trsv(root.T, rhs, lower=0)


def _divide(rows: Matrix, root: Matrix, columns: int) -> None:
    """Replace rows, zero from `columns` on, by their product with L^-1."""
    for begin, end in reversed(_blocks(columns)):
        if end < columns:
            rows[:, begin:end] -= rows[:, end:columns] @ root[end:columns, begin:end]
        rows[:, begin:end] = _trsm(1.0, root[begin:end, begin:end].T, rows[:, begin:end].T, lower=0).T


def _subtract_product(of: Matrix, left: Matrix, right: Matrix, rows: tuple[int, int], columns: tuple[int, int]) -> None:
    (a, b), (c, d) = rows, columns
    product = left[a:b] @ right[c:d].T
    with np.errstate(invalid="ignore", over="ignore"):  # what stands above the diagonal may be anything
        of[a:b, c:d] -= product


def _blocks(size: int) -> list[tuple[int, int]]:
    return list(itertools.pairwise([*range(0, size, _BLOCK), size])) if size > 0 else []


def _lower(size: int) -> Iterable[tuple[tuple[int, int], tuple[int, int]]]:
    blocks = _blocks(size)
    return ((rows, columns) for i, rows in enumerate(blocks) for columns in blocks[: i + 1])


def _each(work: Callable[..., None], calls: Iterable[tuple], pool: ThreadPoolExecutor | None) -> None:
    if pool is None:
        for arguments in calls:
            work(*arguments)
    else:
        list(pool.map(lambda arguments: work(*arguments), list(calls)))
