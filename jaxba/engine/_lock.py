"""The lock on a project: one run at a time writes into it.

The operating system holds the lock for the process and lets it go when the process ends, however it ends: a killed run
locks nobody out. A file beside it says who holds it, for the message; not the lock's own file, which an attempt to take
the lock empties in some versions of filelock, and which Windows lets nobody read.
"""

import contextlib
import datetime
import os
import socket
from collections.abc import Iterator
from pathlib import Path

from filelock import FileLock, Timeout

from jaxba._atomic import cannot_write
from jaxba._errors import JaxbaError

_NAME, _HOLDER = ".lock", ".lock.holder"
_PATIENCE_S, _PAUSE_S = 0.1, 0.02  # `holder` may hold the lock for an instant


@contextlib.contextmanager
def locked(folder: Path) -> Iterator[None]:
    """Hold a project's lock; raise `JaxbaError` where another run holds it."""
    lock, said = FileLock(folder / _NAME), folder / _HOLDER
    moment = datetime.datetime.now().astimezone().isoformat(timespec="seconds")
    try:
        lock.acquire(timeout=_PATIENCE_S, poll_interval=_PAUSE_S)
        said.write_text(f"process {os.getpid()} on {socket.gethostname()} since {moment}\n", encoding="utf-8")
    except Timeout:
        raise JaxbaError(
            f"{folder}: another run works on it ({_said(said)}); wait until it has ended, or choose another --out."
        ) from None
    except OSError as error:
        lock.release()
        raise cannot_write(folder / _NAME, error) from error
    try:
        yield
    finally:
        with contextlib.suppress(OSError):
            said.unlink()
        lock.release()


def holder_file(folder: Path) -> Path:
    """Return the file in a locked project that no other project has alike."""
    return folder.absolute() / _HOLDER


def holder(folder: Path) -> str | None:
    """Return who works on a project, in words; None where nobody does."""
    if not (folder / _NAME).exists():
        return None
    try:
        with FileLock(folder / _NAME).acquire(blocking=False):
            return None
    except Timeout:
        return _said(folder / _HOLDER)
    except OSError:
        return None


def _said(path: Path) -> str:
    with contextlib.suppress(OSError):
        if text := path.read_text(encoding="utf-8").strip():
            return text
    return "it has just begun"
