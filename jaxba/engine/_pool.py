"""Work on many photos in processes: one that dies or hangs costs the photo that it worked on, and nothing else.

Each worker uses one thread of OpenCV and of BLAS, and may not grow over its share of the memory; how many there are
follows from the machine's cores and from what the largest photo needs. A photo whose worker died, or had not memory
enough, is tried once more when the others are done, by one worker alone: what the machine lacked is there then, and
who was only in the way of another is no victim. Workers end with the run, also when it is killed.
"""

import contextlib
import multiprocessing
import os
import signal
import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Generator, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, wait
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from multiprocessing import get_context
from pathlib import Path
from typing import Any, Literal

import psutil
from pebble import ProcessExpired, ProcessPool

from jaxba._errors import JaxbaError
from jaxba.engine._workers import Resources
from jaxba.scene import fault, lacks_memory

_ONE_THREAD = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "VECLIB_MAXIMUM_THREADS")
_AHEAD = 2  # items given out a worker, so that none waits for its next one
_MOST_BROKEN = 3  # pools in a row that break before an item ended
_LOOK_S = 0.5
_STUCK_S = 180.0  # beyond the time limit: a worker was killed as it held the lock on the others
_TOO_LARGE, _NO_MEMORY, _DIED = "needs about", "not enough memory", "its worker process"  # reasons begin with them
_DEATH_SIGNAL = 1  # PR_SET_PDEATHSIG of Linux


@dataclass(frozen=True, kw_only=True)
class Item:
    """One photo's work: `call(*arguments)` in a worker.

    - `name`: the photo's. `need_bytes`: the memory it takes. `effort`: how long it takes, against other items: its
      megapixels, times the photos it is worked on with.
    """

    name: str
    arguments: tuple[Any, ...]
    need_bytes: float
    effort: float = 1.0


@dataclass(frozen=True)
class _Ended:
    """How a call ended: `result`, or `reason` why there is none. `error`: of the run itself, which stops it."""

    how: Literal["done", "failed", "error", "memory", "died", "late"]
    result: Any = None
    reason: str | None = None


def work(
    call: Callable[..., Any], items: Sequence[Item], resources: Resources
) -> Generator[tuple[Item, Any, str | None], None, None]:
    """Yield each item with its result, or with the reason why it has none, as they come to an end.

    `call` must be a module's function. A `JaxbaError` in it is raised here: it stops the run.
    """
    for item in items:
        if item.need_bytes > resources.memory_bytes:
            need, allowed = _gb(item.need_bytes), _gb(resources.memory_bytes)
            yield item, None, f"{_TOO_LARGE} {need} of memory, {allowed} are allowed; raise --max-memory"
    fitting, count, _ = _crew(items, resources)
    again: list[tuple[Item, _Ended]] = []
    for item, ended in _worked(call, fitting, resources, count):
        if ended.how == "died" or (ended.how == "memory" and count > 1):
            again.append((item, ended))
        else:
            yield item, ended.result, _reason(ended)
    for item, ended in _worked(call, [item for item, _ in again], resources, 1):
        yield item, ended.result, _reason(ended, " twice, the second time with no other beside it")


def fewer_workers(items: Sequence[Item], resources: Resources) -> str | None:
    """Return in words that the memory allows fewer workers than are asked for; None where it does not limit them."""
    fitting, count, largest = _crew(items, resources)
    wanted = min(resources.num_wanted(), len(fitting))
    if count >= wanted:
        return None
    return (
        f"{count} of {wanted} workers: a photo needs up to {_gb(largest)} of memory, "
        f"{_gb(resources.memory_bytes)} are allowed for all; --max-memory raises it."
    )


def _crew(items: Sequence[Item], resources: Resources) -> tuple[list[Item], int, float]:
    """Return the items that fit into the memory, how many workers there are for them, and what the largest needs."""
    fitting = [item for item in items if item.need_bytes <= resources.memory_bytes]
    largest = max((item.need_bytes for item in fitting), default=0.0)
    return fitting, min(resources.num_workers(largest), len(fitting)) if fitting else 0, largest


def _worked(
    call: Callable[..., Any], items: Sequence[Item], resources: Resources, count: int
) -> Iterator[tuple[Item, _Ended]]:
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
                        future = pool.schedule(_called, args=(call, item.arguments), timeout=seconds)
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


def _ended(future: Future, seconds: float) -> _Ended:
    try:
        ended: _Ended = future.result()
    except TimeoutError:  # of the pool: what the call raises comes as a result
        return _Ended("late", None, f"took longer than {seconds:g} s; raise --time-limit, or look at the file")
    except ProcessExpired as error:
        code = error.exitcode
        by_signal = code is not None and code < 0
        return _Ended("died", None, f"was killed by {_signal(-code)}" if by_signal else f"ended with exit code {code}")
    if ended.how == "error":
        raise JaxbaError(ended.reason)
    return ended


def _reason(ended: _Ended, how_often: str = "") -> str | None:
    if ended.how == "died":
        return f"{_DIED} {ended.reason}{how_often}: out of memory, or a broken file that crashes the decoder"
    if ended.how == "memory":
        return f"{_NO_MEMORY}; raise --max-memory, or close other programs"
    return ended.reason


def lacked_memory(reason: str) -> bool:
    """Whether an item has no result for want of memory: the system kills, and C++ aborts, where there is none."""
    killed = reason.startswith(_DIED) and any(name in reason for name in ("SIGKILL", "SIGABRT"))
    return killed or reason.startswith((_TOO_LARGE, _NO_MEMORY))


def crashed(reason: str) -> bool:
    """Whether an item has no result since its worker died of something else than memory."""
    return reason.startswith(_DIED) and not lacked_memory(reason)


def _signal(number: int) -> str:
    try:
        return signal.Signals(number).name
    except ValueError:
        return f"signal {number}"


def _gb(count: float) -> str:
    return f"{count / 1e9:.1f} GB"


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


def _called(call: Callable[..., Any], arguments: tuple[Any, ...]) -> _Ended:
    """Call in a worker. What it raises is put in words here, since not every exception survives the way back."""
    try:
        return _Ended("done", call(*arguments))
    except JaxbaError as error:
        return _Ended("error", None, str(error))
    except BaseException as error:  # whatever a decoder makes of a broken file, it costs that file alone
        if lacks_memory(error):
            return _Ended("memory")
        return _Ended("failed", None, f"was stopped {fault(error)}")


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
