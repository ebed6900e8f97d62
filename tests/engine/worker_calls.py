"""Functions that tests run in worker processes, which import them by name."""

import gc
import os
import signal
import time
from pathlib import Path

import numpy as np
from pebble.pool.channel import WorkerChannel

from jaxba import JaxbaError


class Awkward(Exception):
    """An exception that does not survive the way to another process."""

    def __init__(self, *, what: str) -> None:
        super().__init__(what)


def double(number: int) -> int:
    if number == 13:
        os.kill(os.getpid(), signal.SIGKILL)
    if number == 14:
        os._exit(3)
    if number == 15:
        raise ValueError("odd")
    if number == 16:
        raise JaxbaError("disk full")
    if number == 17:
        np.ones(int(3e9), np.uint8)
    if number == 18:
        raise Awkward(what="odd")
    if number == 19:
        raise SystemExit(4)
    if number == 20:
        os.kill(os.getpid(), signal.SIGSEGV)
    if number == 21:
        time.sleep(600)
    return 2 * number


def killed_once(marks: Path, number: int) -> int:
    """Double a number; die the first time that it is tried."""
    mark = marks / str(number)
    if not mark.exists():
        mark.touch()
        os.kill(os.getpid(), signal.SIGKILL)
    return 2 * number


def killed_with_the_lock(marks: Path, number: int) -> int:
    """Double a number; number 3 dies, the first time that it is tried, as it holds the lock that all workers need."""
    mark = marks / "killed"
    if number == 3 and not mark.exists():
        mark.touch()
        (channel,) = [thing for thing in gc.get_objects() if isinstance(thing, WorkerChannel)]
        channel.mutex.acquire()
        os.kill(os.getpid(), signal.SIGKILL)
    return 2 * number


def double_slowly(number: int) -> int:
    """Double a number in 0.2 s."""
    time.sleep(0.2)
    return 2 * number


def hold(size: int) -> int:
    """Take memory for a moment."""
    held = np.empty(size, np.uint8)
    time.sleep(0.2)
    return len(held)


def threads(_: int) -> dict[str, object]:
    import cv2
    from threadpoolctl import threadpool_info

    _ = np.ones((2, 2)) @ np.ones((2, 2))
    time.sleep(0.1)
    return {"cv2": cv2.getNumThreads(), "blas": [pool["num_threads"] for pool in threadpool_info()], "pid": os.getpid()}
