"""Shelf: arrays kept in memory up to a limit, and beyond it in files."""

import shutil
import threading
from collections.abc import Hashable
from pathlib import Path
from typing import Any

import jax
import numpy as np

from jaxba._errors import JaxbaError
from jaxba._sizes import size_text


class Shelf:
    """Trees of arrays by key. What does not fit in `limit` bytes goes to files in `folder`, or is not kept without one.

    Not more than one thread may use a key at a time.
    """

    def __init__(self, limit: float = np.inf, folder: Path | None = None) -> None:
        self._limit, self._folder = limit, folder
        self._kept: dict[Hashable, Any] = {}
        self._filed: dict[Hashable, tuple[Any, list[Path]]] = {}
        self._used = 0
        self._lock = threading.Lock()

    def put(self, key: Hashable, tree: Any) -> bool:
        """Keep a tree of numpy arrays, and return whether it stays in memory; without a folder others are forgotten.

        Raises `JaxbaError` where the disk is full.
        """
        size = sum(leaf.nbytes for leaf in jax.tree.leaves(tree))
        with self._lock:
            self._drop(key)
            fits = self._used + size <= self._limit
            if fits:
                self._kept[key] = tree
                self._used += size
        if not fits and self._folder is not None:
            self._file(key, tree, self._folder)
        return fits

    def get(self, key: Hashable) -> Any:
        """Return a tree, or None.

        Raises `JaxbaError` where its files are gone.
        """
        if key in self._kept:
            return self._kept[key]
        if key not in self._filed:
            return None
        structure, paths = self._filed[key]
        try:
            return jax.tree.unflatten(structure, [np.load(path) for path in paths])
        except (OSError, ValueError, EOFError) as error:
            raise JaxbaError(
                f"{paths[0].parent}: a file of a tile that was written there is gone or damaged ({error}); something "
                "else removes files there. Give a folder of your own (folder)."
            ) from error

    def release(self, key: Hashable) -> Any:
        """Return a tree that lies in memory and keep it no longer; None for one that does not."""
        with self._lock:
            found = self._kept.get(key)
            self._drop(key)
        return found

    def _drop(self, key: Hashable) -> None:
        if key in self._kept:
            self._used -= sum(leaf.nbytes for leaf in jax.tree.leaves(self._kept.pop(key)))

    def _file(self, key: Hashable, tree: Any, folder: Path) -> None:
        leaves, structure = jax.tree.flatten(tree)
        name = "-".join(str(part) for part in (key if isinstance(key, tuple) else (key,)))
        paths = [folder / f"{name}-{i}.npy" for i in range(len(leaves))]
        try:
            for path, leaf in zip(paths, leaves, strict=True):
                np.save(path, leaf)
        except OSError as error:
            raise cannot_write(folder, sum(leaf.nbytes for leaf in leaves), error) from error
        self._filed[key] = structure, paths


def cannot_write(folder: Path, size: int, error: OSError) -> JaxbaError:
    """Return the error that says that so many bytes of a tile could not be written."""
    free = float(shutil.disk_usage(folder).free)
    return JaxbaError(
        f"{folder}: {size_text(float(size))} of a tile could not be written ({error.strerror}); {size_text(free)} are "
        "free there. Make room, give a folder on another disk, or more memory (max_memory)."
    )
