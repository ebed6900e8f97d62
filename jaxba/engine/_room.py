"""Room: what a stage that does all photos at once may use beside its inputs."""

import contextlib
from collections.abc import Callable, Sequence
from concurrent.futures import Executor
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class Room:
    """What a stage that does all photos at once may use; it changes no result.

    - `memory_bytes`: that the process may hold. `folder`: for what it has done so far, so that a run that was stopped
      goes on from there; it is there, and gone when the stage has ended.
    - `crew`: opens the executors that work beside this process, which see the folder, with the bytes that each may keep
      of what it works on; None where none do.
    """

    memory_bytes: float
    folder: Path
    crew: Callable[[], AbstractContextManager[tuple[Sequence[Executor], float] | None]] = contextlib.nullcontext
