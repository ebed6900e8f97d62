"""Tiles in other processes: executors of `concurrent.futures`, each with a process or more that sees one folder.

What never changes of a tile is written to the folder once, and read by the process that works on it. A call takes the
tile's part of the unknowns along and brings its results back; what was made of the tile on the way up stays in the
process for the way down. One that has not got that, since the process that had it was lost, makes it again from the
same numbers: results are the same to the last byte wherever tiles are worked on, by processors of one kind.
"""

import dataclasses
import os
import pickle
import platform
import threading
from collections import deque
from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import BrokenExecutor, CancelledError, Executor, Future
from pathlib import Path
from typing import Any

import jax
import numpy as np
from threadpoolctl import threadpool_limits

from jaxba._errors import JaxbaError
from jaxba.ba._system import System
from jaxba.ba._unknowns import Unknowns
from jaxba.ba.tiles._cut import Tile
from jaxba.ba.tiles._dense import NotPositive
from jaxba.ba.tiles._fronts import Fronts, TileFronts
from jaxba.ba.tiles._shelf import Shelf, cannot_write
from jaxba.ba.tiles._tile_work import TileWork

_AHEAD = 2  # tiles given out an executor


class Elsewhere:
    """Executors, to which tiles are given in turn: each gets the same ones every time.

    - `folder`: that their processes see. `memory`: bytes that each of these keeps of tiles.
    """

    def __init__(self, label: str, executors: Sequence[Executor], folder: Path, memory: float) -> None:
        if not executors:
            raise JaxbaError(f"{label}: executors: give one or more.")
        self._label, self._executors, self._folder, self._memory = label, list(executors), folder, memory
        self._stamp = 0

    def put_block(self, work: TileWork) -> None:
        """Write what all tiles need."""
        fronts = work.fronts
        bare = dataclasses.replace(work.tree, tile_of_point=work.tree.tile_of_point[:0])
        self._write("block", (work.shape, bare, fronts.block, fronts.border, work.camera_index, work.free))

    def put_tile(self, number: int, tile: Tile, fronts: TileFronts, system: System) -> None:
        """Write a tile."""
        self._write(f"tile-{number}", (tile.bare(), fronts, jax.tree.map(np.asarray, system)))

    def _write(self, name: str, content: Any) -> None:
        try:
            data = pickle.dumps(content)
        except (pickle.PicklingError, AttributeError, TypeError) as error:
            raise JaxbaError(
                f"{self._label}: executors: a tile cannot be sent to another process ({error}). Define losses and "
                "priors of your own in a module that is installed there."
            ) from error
        try:
            (self._folder / f"{name}.pickle").write_bytes(data)
        except OSError as error:
            raise cannot_write(self._folder, len(data), error) from error

    def each(self, name: str, calls: Iterable[tuple[Any, ...]]) -> Iterator[Any]:
        """Yield what a method of `TileWork` gives for each call, in order; the first argument is the tile's number.

        Raises `JaxbaError` where all executors are broken, or a process does not do its work.
        """
        self._stamp += name == "step_up"
        waiting: deque[tuple[Future[Any], Executor, tuple[Any, ...]]] = deque()
        try:
            for call in calls:
                waiting.append(self._given(name, call))
                if len(waiting) > _AHEAD * len(self._executors):
                    yield self._result(name, *waiting.popleft())
            while waiting:
                yield self._result(name, *waiting.popleft())
        finally:
            for future, _, _ in waiting:
                future.cancel()

    def _given(self, name: str, call: tuple[Any, ...]) -> tuple[Future[Any], Executor, tuple[Any, ...]]:
        while self._executors:
            executor = self._executors[call[0] % len(self._executors)]
            try:
                future = executor.submit(_work_on, str(self._folder), self._memory, name, self._stamp, call)
            except BrokenExecutor:
                self._executors.remove(executor)
            else:
                return future, executor, call
        raise JaxbaError(f"{self._label}: executors: the processes of all of them were lost; give others.")

    def _result(self, name: str, future: Future[Any], executor: Executor, call: tuple[Any, ...]) -> Any:
        while True:
            try:
                return future.result()
            except (BrokenExecutor, CancelledError):
                if executor in self._executors:
                    self._executors.remove(executor)
                future, executor, call = self._given(name, call)
            except (JaxbaError, NotPositive):
                raise
            except Exception as error:
                raise JaxbaError(
                    f"{self._label}: tile {call[0]} in another process: {type(error).__name__}: {error}"
                ) from error


class _WorkHere(TileWork):
    """The work on tiles in a process that an executor has."""

    def __init__(self, folder: Path, memory: float) -> None:
        shape, tree, block, border, camera_index, free = pickle.loads((folder / "block.pickle").read_bytes())
        fronts = Fronts(tree, block, border)
        fronts.memory.limit = 0.2 * memory
        self._files, self._systems = folder, Shelf(0.2 * memory)
        self._stamps: dict[int, int] = {}
        self._tiles: dict[int, tuple[Tile, TileFronts]] = {}
        own = folder / f"{platform.node()}-{os.getpid()}"
        own.mkdir(exist_ok=True)
        factors, models = Shelf(0.3 * memory, own), Shelf(0.3 * memory)
        super().__init__(shape, tree, fronts, camera_index, free, factors, models)

    def tile(self, number: int) -> tuple[Tile, TileFronts]:
        """Return a tile and its fronts."""
        if number not in self._tiles:
            self.system(number)
        return self._tiles[number]

    def system(self, number: int) -> System:
        """Return the system of a tile, read again where it was not kept."""
        system = self._systems.get(number)
        if system is None:
            tile, fronts, system = pickle.loads((self._files / f"tile-{number}.pickle").read_bytes())
            self._tiles[number] = tile, fronts
            self._systems.put(number, system)
        return system

    def call(self, name: str, stamp: int, number: int, part: Unknowns, *arguments: Any) -> Any:
        """Call a method of `TileWork`; `stamp` is the number of the way up that it belongs to."""
        if name == "step_down" and self._stamps.get(number) != stamp:
            damping, bend = arguments[-2:]
            self.step_up(number, part, damping, bend)
        if name != "costs_of_tile":
            self._stamps[number] = stamp
        return getattr(self, name)(number, part, *arguments)


_opened: dict[tuple[str, float], _WorkHere] = {}
_opening = threading.Lock()


def _work_on(folder: str, memory: float, name: str, stamp: int, call: tuple[Any, ...]) -> Any:
    with _opening:
        if (folder, memory) not in _opened:
            _opened.clear()  # of solves that have ended
            threadpool_limits(1, user_api="blas")
            _opened[folder, memory] = _WorkHere(Path(folder), memory)
        work = _opened[folder, memory]
    with jax.enable_x64(True):
        return work.call(name, stamp, *call)
