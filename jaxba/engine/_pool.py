"""Work on many photos in processes: one that dies or hangs costs the photo that it worked on, and nothing else.

Each worker uses one thread of OpenCV and of BLAS, and may not grow over its share of the memory; how many there are
follows from the machine's cores and from what the largest photo needs. Workers end with the run, also when it is
killed.
"""

import contextlib
import multiprocessing
import os
import signal
import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, wait
from concurrent.futures.process import BrokenProcessPool
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import psutil
from pebble import ProcessExpired, ProcessPool

from jaxba._errors import JaxbaError
from jaxba.engine._items import Ended, Item, called, died, late
from jaxba.engine._workers import Resources

_ONE_THREAD = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "VECLIB_MAXIMUM_THREADS")
_AHEAD = 2  # items given out a worker, so that none waits for its next one
_MOST_BROKEN = 3  # pools in a row that break before an item ended
_LOOK_S = 0.5
_STUCK_S = 180.0  # beyond the time limit: a worker was killed as it held the lock on the others
_DEATH_SIGNAL = 1  # PR_SET_PDEATHSIG of Linux


class LocalWorkers:
    """The engine of this machine: worker processes, as many as its cores and its memory allow for these items."""

    more_memory = "raise --max-memory"

    def __init__(self, items: Sequence[Item], resources: Resources) -> None:
        self.resources, self.memory_bytes = resources, resources.memory_bytes
        needs = [item.need_bytes for item in items if item.need_bytes <= self.memory_bytes]
        self.num_fitting, self.largest_bytes = len(needs), max(needs, default=0.0)
        self.count = min(resources.num_workers(self.largest_bytes), len(needs)) if needs else 0

    def worked(
        self, call: Callable[..., Any], items: Sequence[Item], *, alone: bool = False
    ) -> Iterator[tuple[Item, Ended]]:
        """Yield how each item ended, as they do."""
        return _worked(call, items, self.resources, 1 if alone else self.count)


def _worked(
    call: Callable[..., Any], items: Sequence[Item], resources: Resources, count: int
) -> Iterator[tuple[Item, Ended]]:
    """Yield how each item ended, as they do.

    A pool breaks, or no longer moves, when a worker is killed between two items. Items that it had not ended are given
    to a new one.
    """
    waiting, broken = deque(items), 0
    limit = resources.memory_bytes / max(count, 1)
    while waiting:
        if broken == _MOST_BROKEN:
            raise JaxbaError(
                f"worker processes end before they begin ({broken} times in a row). In a script, call the pipeline "
                "under 'if __name__ == \"__main__\":', since workers import it; else raise --max-memory, "
                "or use fewer --workers, and see what else takes the machine's memory."
            )
        broken += 1
        given: dict[Future, Item] = {}
        ended_s = time.monotonic()
        with _pool(call, count, max(limit, max(item.need_bytes for item in waiting))) as pool:
            while (waiting or given) and pool.active:
                while waiting and len(given) < _AHEAD * count:
                    item = waiting.popleft()
                    seconds = resources.seconds_for(item.effort)
                    try:
                        future = pool.schedule(called, args=(call, item.arguments), timeout=seconds)
                    except RuntimeError:  # it has just broken
                        waiting.appendleft(item)
                        break
                    given[future] = item
                for future in wait(given, timeout=_LOOK_S, return_when=FIRST_COMPLETED).done:
                    if isinstance(future.exception(), BrokenProcessPool):
                        continue
                    item, broken, ended_s = given.pop(future), 0, time.monotonic()
                    yield item, _ended(future, resources.seconds_for(item.effort))
                longest = max((resources.seconds_for(item.effort) for item in given.values()), default=0.0)
                if time.monotonic() - ended_s > longest + _STUCK_S:
                    pool.stop()
        waiting.extendleft(reversed(given.values()))


def _ended(future: Future, seconds: float) -> Ended:
    try:
        ended: Ended = future.result()
    except TimeoutError:  # of the pool: what the call raises comes as a result
        return late(seconds)
    except ProcessExpired as error:
        return died(error.exitcode)
    if ended.how == "error":
        raise JaxbaError(ended.reason)
    return ended


@contextlib.contextmanager
def _pool(call: Callable[..., Any], count: int, limit_bytes: float) -> Iterator[ProcessPool]:
    """A pool of workers; when the block is left by an error they are stopped in the middle of their work."""
    with _one_thread_each():  # a worker may start at any time
        pool = ProcessPool(
            max_workers=count,
            context=get_context("spawn"),
            initializer=_prepare_worker,
            initargs=(int(limit_bytes), call),
        )
        try:
            pool.active  # noqa: B018  starts it
            yield pool
            pool.close()
        except BaseException:
            pool.stop()
            raise
        finally:
            pool.join()


@contextlib.contextmanager
def _one_thread_each() -> Iterator[None]:
    """The environment that makes a new process's BLAS use one thread."""
    before = {name: os.environ.get(name) for name in _ONE_THREAD}
    os.environ.update(dict.fromkeys(_ONE_THREAD, "1"))
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = value


def _prepare_worker(limit_bytes: int, call: Callable[..., Any]) -> None:
    """Limit a worker; it gets `call` so that what that imports is loaded before the worker locks the others out."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is the parent's to handle
    threading.Thread(target=_end_with_parent, daemon=True).start()
    if sys.platform == "linux":
        import ctypes
        import resource

        ctypes.CDLL(None).prctl(_DEATH_SIGNAL, signal.SIGKILL)  # also where the thread above cannot run
        with contextlib.suppress(OSError):  # where memory ends, a worker is to be killed and not the run
            Path("/proc/self/oom_score_adj").write_text("500")
        # address space beyond what is in use: libraries map far more than they touch
        mapped = psutil.Process().memory_info().vms
        most = mapped + limit_bytes + int(1e9)
        resource.setrlimit(resource.RLIMIT_AS, (most, most))
    import cv2

    cv2.setNumThreads(1)


def _end_with_parent() -> None:
    """Wait for the end of the process that started this one, and end too."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)
