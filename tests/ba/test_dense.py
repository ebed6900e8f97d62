"""Dense kernels of fronts against numpy, with many blocks and threads, garbage above the diagonals."""

from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

from jaxba.ba.tiles import _dense


def _front(own: int, rest: int) -> tuple[np.ndarray, list[np.ndarray]]:
    """Return a positive definite matrix, and its parts as a front holds them."""
    root = np.random.default_rng(own).normal(size=(own + rest,) * 2)
    whole = root @ root.T + np.eye(own + rest)
    held = np.where(np.tri(own + rest, dtype=bool), whole, np.inf)
    return whole, [held[:own, :own].copy(), held[own:, :own].copy(), held[own:, own:].copy()]


@pytest.mark.parametrize(("own", "rest"), [(20, 33), (33, 20), (7, 1), (1, 40), (21, 7)])
@pytest.mark.parametrize("threads", [0, 3])
def test_factor_and_inverse_are_numpys(own: int, rest: int, threads: int, monkeypatch: pytest.MonkeyPatch) -> None:
    # breaks where a block is left out, taken twice, or before those that it depends on
    monkeypatch.setattr(_dense, "_BLOCK", 7)
    monkeypatch.setattr(_dense, "_WORTH_THREADS", 0.0)
    whole, (f11, f21, f22) = _front(own, rest)
    with ThreadPoolExecutor(max(threads, 1)) as pool:
        _dense.factor(f11, f21, f22, pool if threads else None)
        root = np.linalg.cholesky(whole[:own, :own])
        np.testing.assert_allclose(np.tril(f11), root, rtol=1e-9, atol=1e-12)
        np.testing.assert_allclose(f21, np.linalg.solve(root, whole[:own, own:]).T, rtol=1e-9, atol=1e-9)
        schur = whole[own:, own:] - f21 @ f21.T
        np.testing.assert_allclose(np.tril(f22), np.tril(schur), rtol=1e-9, atol=1e-9)
        found = np.full_like(whole, np.nan)
        _dense.inverse(f11, f21, np.linalg.inv(schur), found, pool if threads else None)
        expected = np.linalg.inv(whole)
        np.testing.assert_allclose(found, expected, rtol=0, atol=1e-8 * np.abs(expected).max())
        rhs = np.arange(own, dtype=float)
        np.testing.assert_allclose(_dense.solve_transposed(f11, rhs), np.linalg.solve(root.T, rhs), rtol=1e-7)


def test_what_is_not_positive_definite_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(_dense, "_BLOCK", 7)
    _, (f11, f21, f22) = _front(20, 5)
    f11[15, 15] = -1.0
    with pytest.raises(_dense.NotPositive):
        _dense.factor(f11, f21, f22)
