"""Checkpoint: where a long solve stands after each step, in one file, so that a second call goes on from there.

In a folder each solve has a file of its own, which stays at its end: work that solves several times goes through the
same solves again without a step, up to the one that was broken off.
"""

import dataclasses
import hashlib
import os
import warnings
import zipfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxba._atomic import refuse_unwritable, write_atomically
from jaxba._errors import JaxbaError
from jaxba.ba._problem import Problem
from jaxba.ba._solution import HistoryStep
from jaxba.ba._solvers import State
from jaxba.ba._unknowns import Unknowns
from jaxba.geometry import AbstractLoss, Pose

_STEP_FIELDS = tuple(field.name for field in dataclasses.fields(HistoryStep))


@dataclasses.dataclass(frozen=True)
class Standing:
    """Unknowns, the solver's state and what was tried so far; seconds count from the first call."""

    unknowns: Unknowns
    state: State
    history: tuple[HistoryStep, ...]


class Checkpoint:
    """The file of a solve at `path`, or in a folder there.

    `problem` and `loss` say which solve it belongs to; in a folder `stops`, what ends it, does as well.
    """

    def __init__(
        self, path: str | os.PathLike[str], problem: Problem, loss: AbstractLoss, stops: tuple[float, ...]
    ) -> None:
        self._solve, self._is_kept = _fingerprint(problem, loss), os.path.isdir(path)
        name = hashlib.sha256(f"{self._solve}{stops}".encode()).hexdigest()[:16]
        self._path = Path(path, f"{name}.npz") if self._is_kept else Path(path)

    def load(self) -> Standing | None:
        """Return where the solve stood, or None where there is no file yet.

        Raises `JaxbaError` for a file that cannot be read, or could not be written, and for that of another problem or
        loss.
        """
        refuse_unwritable(self._path)
        if not self._path.exists():
            return None
        cure = "remove it to begin anew, or name another file"
        try:
            with np.load(self._path) as file:
                found = {name: file[name] for name in file.files}
            solve = found.pop("solve").item()
            unknowns = Unknowns(Pose(*(found[f"unknown_{k}"] for k in range(2))), *_numbered(found, "unknown", 2, 5))
            with jax.enable_x64(True):
                state = State(*map(jnp.asarray, _numbered(found, "state", 0, len(dataclasses.fields(State)))))
            history = tuple(_history_step(row) for row in found["history"])
        except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile) as error:
            raise JaxbaError(f"{self._path}: is no checkpoint that can be read ({error}); {cure}.") from error
        if solve != self._solve:
            raise JaxbaError(f"{self._path}: is the checkpoint of another problem or loss; {cure}.")
        return Standing(unknowns, state, history)

    def save(self, unknowns: Unknowns, state: State, history: Sequence[HistoryStep]) -> None:
        """Write where the solve stands, whole or not at all; a disk that is full ends no solve, but is told."""
        arrays: dict[str, Any] = {"solve": self._solve}
        arrays |= {f"unknown_{k}": np.asarray(leaf) for k, leaf in enumerate(jax.tree.leaves(unknowns))}
        arrays |= {f"state_{k}": np.asarray(leaf) for k, leaf in enumerate(jax.tree.leaves(state))}
        arrays["history"] = np.array([[getattr(step, name) for name in _STEP_FIELDS] for step in history], float)
        try:
            with write_atomically(self._path) as file:
                np.savez(file, **arrays)
        except JaxbaError as error:
            warnings.warn(f"{error} The solve goes on without a checkpoint of this step.", RuntimeWarning, stacklevel=2)

    def end(self) -> None:
        """Remove the file of a solve that has ended, unless it lies in a folder of such files."""
        if not self._is_kept:
            self._path.unlink(missing_ok=True)


def _numbered(found: dict[str, np.ndarray], name: str, begin: int, end: int) -> list[np.ndarray]:
    return [found[f"{name}_{k}"] for k in range(begin, end)]


def _history_step(row: np.ndarray) -> HistoryStep:
    kinds = {"int": int, "bool": bool, "float": float}
    types = {field.name: field.type if isinstance(field.type, str) else field.type.__name__
             for field in dataclasses.fields(HistoryStep)}  # fmt: skip
    return HistoryStep(**{name: kinds[types[name]](value) for name, value in zip(_STEP_FIELDS, row, strict=True)})


def _fingerprint(problem: Problem, loss: AbstractLoss) -> str:
    """Return digits that differ where the problem or its loss do."""
    leaves, structure = jax.tree.flatten((problem, loss))
    digest = hashlib.sha256(str(structure).encode())
    for leaf in map(np.asarray, leaves):
        digest.update(f"{leaf.dtype}{leaf.shape}".encode())
        digest.update(np.ascontiguousarray(leaf).data)
    return digest.hexdigest()
