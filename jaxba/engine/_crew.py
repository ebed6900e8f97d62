"""Executors of a dask cluster, one a worker's thread, for calls of which a worker is to get the same ones every time.

A call whose worker goes is given to another one.
"""

import contextlib
import functools
import math
import platform
import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import CancelledError, Executor, Future, wait
from pathlib import Path
from typing import Any

from jaxba._errors import JaxbaError
from jaxba.engine._cluster import Cluster, cluster, threads_of
from jaxba.engine._compile_cache import use_compilation_cache
from jaxba.engine._remote_call import RemoteCall
from jaxba.engine._workers import Resources

_KEPT_SHARE, _UNLIMITED = 0.5, 4e9  # of a worker's memory; bytes, where none is said
_LOOK_S = 0.5
_MOST_LOST = 3  # workers of one call


@contextlib.contextmanager
def crew(resources: Resources, reads: Iterable[Path]) -> Iterator[tuple[list[Executor], float]]:
    """Yield an executor a thread of each worker, and the bytes that each may keep of what it works on.

    - `reads`: paths that a worker must see.

    Results raise `JaxbaError` where the scheduler has gone, no worker comes, or a call's workers end time and again.
    """
    with cluster(reads, resources) as engine:
        workers = engine.workers()
        least = min(worker["memory_limit"] or _UNLIMITED for worker in workers.values())
        places = _Places(engine, threads_of(workers))
        try:
            yield [_OfThread(places, number) for number in range(len(places.addresses))], _KEPT_SHARE * least
        except JaxbaError:
            engine.workers()  # says so where it is the scheduler, or the last worker, that has gone
            raise


class _Places:
    """The worker's thread that is each executor's own, by address; None where its worker has gone."""

    def __init__(self, engine: Cluster, addresses: list[str]) -> None:
        self.engine = engine
        self.addresses: list[str | None] = [*addresses]

    def find(self, number: int) -> str:
        """Return the worker for an executor: its own, else one that is nobody's yet, else another one's for now."""
        own = self.addresses[number]
        if own is not None:
            return own
        threads = threads_of(self.engine.workers())
        free = list((Counter(threads) - Counter(filter(None, self.addresses))).elements())
        if free:
            self.addresses[number] = free[0]
            return free[0]
        return threads[number % len(threads)]

    def has_gone(self, address: str) -> bool:
        """Return whether a worker has gone, and take it from the executors whose own it was."""
        if address in self.engine.workers():
            return False
        self.addresses = [None if own == address else own for own in self.addresses]
        return True


class _OfThread(Executor):
    """Gives calls to one thread of a worker, and to another one where that worker has gone."""

    def __init__(self, places: _Places, number: int) -> None:
        self._places, self._number = places, number

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        """Return the future of a call; raise `BrokenExecutor` where dask takes none."""
        return _Result(self._places, self._number, functools.partial(fn, *args, **kwargs))


class _Result(Future[Any]):
    """The future of a call, to be asked by `result`: that watches the call's worker."""

    def __init__(self, places: _Places, number: int, call: Callable[[], Any]) -> None:
        super().__init__()
        self._places, self._number, self._call, self._lost = places, number, call, 0
        self._given = self._give()

    def _give(self) -> RemoteCall:
        return RemoteCall(self._places.engine.client, self._places.find(self._number), _called_there, self._call)

    def result(self, timeout: float | None = None) -> Any:
        """Wait for what the call returns, or raises, and see that it comes."""
        until = math.inf if timeout is None else time.monotonic() + timeout
        while not self.cancelled():
            if wait([self._given.fetched], _LOOK_S).done:
                if not self._given.is_lost():
                    return self._given.fetched.result()
                self._places.has_gone(self._given.address)  # raises where it is the scheduler
            elif not self._places.has_gone(self._given.address):
                if time.monotonic() > until:
                    raise TimeoutError
                continue
            self._given.take_back()
            self._lost += 1
            if self._lost == _MOST_LOST:
                raise JaxbaError(
                    f"dask's worker processes end on the same piece of work ({self._lost} in a row, the last one "
                    f"{self._given.address}). Raise the --memory-limit of dask worker, or run fewer workers on a "
                    "machine. What is done is kept, and the same command goes on."
                )
            self._given = self._give()
        raise CancelledError

    def cancel(self) -> bool:
        """Take the call back, whatever its worker has made of it."""
        self._given.take_back()
        return super().cancel()


def _called_there(call: Callable[[], Any]) -> Any:
    """Call in a worker."""
    use_compilation_cache()
    try:
        return call()
    except JaxbaError as error:
        raise JaxbaError(f"{error} (on a worker of {platform.node()})") from error
