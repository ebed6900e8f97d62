"""The lock on a project: one run at a time writes into it.

The operating system holds the lock for the process and lets it go when the process ends, however it ends: a killed run
locks nobody out. The file beside it says who holds it, for the message.
"""

import contextlib
import datetime
import os
import socket
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import IO

from jaxba._errors import JaxbaError
from jaxba.engine._store import cannot_write

_NAME = ".lock"
_TRIES, _PAUSE_S = 5, 0.02


@contextlib.contextmanager
def locked(folder: Path) -> Iterator[None]:
    """Hold a project's lock; raise `JaxbaError` where another run holds it."""
    path = folder / _NAME
    try:
        path.touch()
    except OSError as error:
        raise cannot_write(path, error) from error
    with open(path, "r+", encoding="utf-8") as file:
        if not _take_soon(file):
            raise JaxbaError(
                f"{folder}: another run works on it ({_said(path)}); wait until it has ended, or choose another --out."
            )
        moment = datetime.datetime.now().astimezone().isoformat(timespec="seconds")
        file.truncate(0)
        file.write(f"process {os.getpid()} on {socket.gethostname()} since {moment}\n")
        file.flush()
        yield


def holder(folder: Path) -> str | None:
    """Return who works on a project, in words; None where nobody does."""
    path = folder / _NAME
    try:
        with open(path, "r+", encoding="utf-8") as file:
            return None if _take(file) else _said(path)
    except OSError:
        return None


def _said(path: Path) -> str:
    try:
        return path.read_text(encoding="utf-8").strip() or "it has just begun"
    except OSError:  # Windows lets nobody read a locked file
        return "its process cannot be told"


def _take_soon(file: IO[str]) -> bool:
    """Lock a file that `holder` may hold for an instant."""
    for _ in range(_TRIES):
        if _take(file):
            return True
        time.sleep(_PAUSE_S)
    return False


def _take(file: IO[str]) -> bool:
    """Lock an open file until it is closed; return whether that was possible."""
    try:
        if sys.platform == "win32":
            import msvcrt

            file.seek(0)
            msvcrt.locking(file.fileno(), msvcrt.LK_NBLCK, 1)
        else:
            import fcntl

            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        return False
    return True
