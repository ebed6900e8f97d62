"""Work on many photos in processes: one that dies costs the photo that it worked on, and nothing else.

Each worker uses one thread of OpenCV and of BLAS, and may not grow over its share of the memory; how many there are
follows from the machine's cores and from what the largest photo needs.
"""

import os
import signal
import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from multiprocessing import get_context
from typing import Any

import psutil
from pebble import ProcessExpired, ProcessPool

from jaxba._errors import JaxbaError

_BASE_GB, _GB_PER_MEGAPIXEL = 0.35, 0.25  # SIFT holds 1.25 GB at 5 megapixels and 4.6 GB at 20
_ONE_THREAD = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "VECLIB_MAXIMUM_THREADS")


@dataclass(frozen=True, kw_only=True)
class Resources:
    """What the workers may use.

    - `workers`: processes; None: one a core. `max_memory`: up to 1 a share of the machine's memory, above it bytes.
    """

    workers: int | None = None
    max_memory: float = 0.8

    def __post_init__(self) -> None:
        if self.workers is not None and self.workers < 1:
            raise JaxbaError(f"workers {self.workers}: give 1 or more.")
        if not (0.1 <= self.max_memory <= 0.95 or self.max_memory >= 1e8):
            raise JaxbaError(f"max_memory {self.max_memory:g}: give a share from 0.1 to 0.95, or bytes (1e8 or more).")

    @property
    def memory_bytes(self) -> float:
        return self.max_memory * psutil.virtual_memory().total if self.max_memory < 1 else self.max_memory

    def num_workers(self, need_bytes: float) -> int:
        """Return how many processes fit that need this much each; at least one."""
        wanted = self.workers or len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
        return max(1, min(wanted or 1, int(self.memory_bytes / need_bytes)))


def memory_for(megapixels: float) -> float:
    """Return the bytes that a worker needs for photos of this size."""
    return (_BASE_GB + _GB_PER_MEGAPIXEL * megapixels) * 1e9


@dataclass(frozen=True, kw_only=True)
class Item:
    """One photo's work: `call(*arguments)` in a worker. `name`: the photo's. `need_bytes`: the memory it takes."""

    name: str
    arguments: tuple[Any, ...]
    need_bytes: float


def work(
    call: Callable[..., Any], items: Sequence[Item], resources: Resources
) -> Iterator[tuple[Item, Any, str | None]]:
    """Yield each item with its result, or with the reason why it has none, as they come to an end.

    `call` must be a module's function. A `JaxbaError` in it is raised here: it stops the run.
    """
    limit = resources.memory_bytes
    fitting = [item for item in items if item.need_bytes <= limit]
    for item in items:
        if item.need_bytes > limit:
            need, allowed = item.need_bytes / 1e9, limit / 1e9
            yield item, None, f"needs about {need:.1f} GB of memory, {allowed:.1f} GB are allowed; raise --max-memory"
    if not fitting:
        return
    largest = max(item.need_bytes for item in fitting)
    count = min(resources.num_workers(largest), len(fitting))
    pool = ProcessPool(
        max_workers=count,
        context=get_context("spawn"),
        initializer=_prepare_worker,
        initargs=(int(max(limit / count, largest)),),
    )
    with _one_thread_each():  # a worker may start at any time
        try:
            futures = [pool.schedule(call, args=item.arguments) for item in fitting]
            for item, future in zip(fitting, futures, strict=True):
                yield item, *_outcome(future)
            pool.close()
        except BaseException:
            pool.stop()
            raise
        finally:
            pool.join()


def _outcome(future: Any) -> tuple[Any, str | None]:
    try:
        return future.result(), None
    except JaxbaError:
        raise
    except ProcessExpired as error:
        code = error.exitcode
        how = f"exit code {code}" if code is None or code >= 0 else f"killed by {signal.Signals(-code).name}"
        return None, f"its worker process died ({how}): out of memory, or a broken file that crashes the decoder"
    except MemoryError:
        return None, "not enough memory; raise --max-memory or use fewer --workers"
    except Exception as error:  # whatever a decoder makes of a broken file, it costs that file alone
        return None, f"{type(error).__name__}: {error}"


class _one_thread_each:
    """The environment that makes a new process's BLAS use one thread."""

    def __enter__(self) -> None:
        self.before = {name: os.environ.get(name) for name in _ONE_THREAD}
        os.environ.update(dict.fromkeys(_ONE_THREAD, "1"))

    def __exit__(self, *_: object) -> None:
        for name, value in self.before.items():
            if value is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = value


def _prepare_worker(limit_bytes: int) -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is the parent's to handle
    if sys.platform == "linux":
        import resource

        # address space beyond what is in use: libraries map far more than they touch
        mapped = psutil.Process().memory_info().vms
        most = mapped + limit_bytes + int(1e9)
        resource.setrlimit(resource.RLIMIT_AS, (most, most))
    import cv2

    cv2.setNumThreads(1)
