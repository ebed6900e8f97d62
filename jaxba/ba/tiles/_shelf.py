"""Shelf: arrays kept in memory up to a limit, and beyond it in files."""

import threading
from collections.abc import Hashable
from pathlib import Path
from typing import Any

import jax
import numpy as np


class Shelf:
    """Trees of arrays by key. What does not fit in `limit` bytes goes to files in `folder`.

    Not more than one thread may use a key at a time.
    """

    def __init__(self, limit: float = np.inf, folder: Path | None = None) -> None:
        self._limit, self._folder = limit, folder
        self._kept: dict[Hashable, Any] = {}
        self._filed: dict[Hashable, tuple[Any, list[Path]]] = {}
        self._used = 0
        self._lock = threading.Lock()

    def put(self, key: Hashable, tree: Any, *, only_if_room: bool = False) -> None:
        """Keep a tree of numpy arrays; with `only_if_room` not at all where it does not fit in memory."""
        size = sum(leaf.nbytes for leaf in jax.tree.leaves(tree))
        with self._lock:
            self._drop(key)
            fits = self._used + size <= self._limit
            if fits:
                self._kept[key] = tree
                self._used += size
        if not fits and not only_if_room:
            self._file(key, tree)

    def get(self, key: Hashable) -> Any:
        """Return a tree, or None."""
        if key in self._kept:
            return self._kept[key]
        if key not in self._filed:
            return None
        structure, paths = self._filed[key]
        return jax.tree.unflatten(structure, [np.load(path) for path in paths])

    def release(self, key: Hashable) -> Any:
        """Return a tree that lies in memory and keep it no longer; None for one that does not."""
        with self._lock:
            found = self._kept.get(key)
            self._drop(key)
        return found

    def _drop(self, key: Hashable) -> None:
        if key in self._kept:
            self._used -= sum(leaf.nbytes for leaf in jax.tree.leaves(self._kept.pop(key)))

    def _file(self, key: Hashable, tree: Any) -> None:
        assert self._folder is not None
        leaves, structure = jax.tree.flatten(tree)
        name = "-".join(str(part) for part in (key if isinstance(key, tuple) else (key,)))
        paths = [self._folder / f"{name}-{i}.npy" for i in range(len(leaves))]
        for path, leaf in zip(paths, leaves, strict=True):
            np.save(path, leaf)
        self._filed[key] = structure, paths
