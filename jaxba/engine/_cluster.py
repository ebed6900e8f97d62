"""The engine of a dask cluster: workers that someone else has started, on machines that see the project's folder.

A worker is given as many items as it has threads, the next one when one has ended: so it is known when each began. One
that takes too long is ended with its worker's process, which the worker's nanny starts anew; a worker that is lost
costs no other item than those it had. Before a worker is given anything it is asked for its versions and for what it
sees of the project: another OpenCV would record other features under the same key.

What is encrypted, and by which certificates, dask's own settings say (`distributed.comm.tls`).
"""

import contextlib
import functools
import hashlib
import json
import logging
import platform
import threading
import time
from collections import Counter, deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import BrokenExecutor
from pathlib import Path
from typing import Any, NamedTuple

from jaxba import __version__
from jaxba._errors import JaxbaError
from jaxba.engine._items import Ended, Item, called, late
from jaxba.engine._remote_call import RemoteCall
from jaxba.engine._versions import installed
from jaxba.engine._workers import Resources

try:
    import distributed
except ImportError as error:
    raise JaxbaError(f"a dask cluster needs the extra: pip install 'jaxba[cluster]' ({error}).") from error

_ANSWER_S = 10.0  # for a scheduler to answer
_PATIENCE_S = 60.0  # for workers to be there
_LOOK_S = 0.5
_TRIPS = 5
_HEAD = 65536  # bytes of a file that tell it from others


class _Begun(NamedTuple):
    """An item that a worker works on: its call, since when, and how long it may take."""

    item: Item
    call: RemoteCall
    begun_s: float
    seconds: float


@contextlib.contextmanager
def cluster(reads: Iterable[Path], resources: Resources) -> Iterator["Cluster"]:
    """Yield the engine; raise `JaxbaError` where the cluster is not there, or not fit.

    - `reads`: paths that a worker must see.
    """
    logger = logging.getLogger("distributed")
    level = logger.level
    logger.setLevel(logging.CRITICAL)  # what goes wrong is said here, once
    client = None
    try:
        client = _client(resources)
        yield Cluster(client, reads, resources)
    finally:
        if client is not None:
            client.close()
        logger.setLevel(level)


class Cluster:
    """The workers of a client's cluster.

    - `count`: threads of all workers. `memory_bytes`: that the largest worker allows its process.
    """

    more_memory = "raise the --memory-limit of dask worker"

    def __init__(self, client: distributed.Client, reads: Iterable[Path], resources: Resources) -> None:
        self.client, self._resources = client, resources
        self._reads = sorted(set(reads))
        self._alike: set[str] = set()
        self._stuck: set[str] = set()
        workers = self.workers()
        self.count = sum(worker["nthreads"] for worker in workers.values())
        self.memory_bytes = max(worker["memory_limit"] or float("inf") for worker in workers.values())

    def worked(
        self, call: Callable[..., Any], items: Sequence[Item], *, alone: bool = False
    ) -> Iterator[tuple[Item, Ended]]:
        """Yield how each item ended, as they do."""
        waiting, working = deque(items), list[_Begun]()
        wake = threading.Event()
        try:
            while waiting or working:
                wake.clear()
                workers = self.workers()
                for one in list(working):
                    if (ended := self._ended(one, workers)) is not None:
                        working.remove(one)
                        one.call.take_back()
                        yield one.item, ended
                for address in _free(workers, working, alone=alone)[: len(waiting)]:
                    item = waiting.popleft()
                    try:
                        made = RemoteCall(self.client, address, called, call, item.arguments)
                    except BrokenExecutor:
                        self.workers()  # says what has gone
                        raise
                    made.fetched.add_done_callback(lambda _: wake.set())
                    working.append(_Begun(item, made, time.monotonic(), self._resources.seconds_for(item.effort)))
                wake.wait(_LOOK_S)
        finally:
            for one in working:
                one.call.take_back()

    def _ended(self, one: _Begun, workers: dict[str, Any]) -> Ended | None:
        """Return how an item has ended, by itself or since nothing more is to be expected of it; None for the others.

        Raises `JaxbaError` where the call could not be made, or stops the run.
        """
        address = one.call.address
        if one.call.fetched.done() and not one.call.is_lost():
            if (error := one.call.fetched.exception()) is not None:
                raise JaxbaError(f"worker {address}: {type(error).__name__}: {error}")
            ended: Ended = one.call.fetched.result()
            if ended.how == "error":
                raise JaxbaError(f"{ended.reason} (on the worker {address})")
            return ended
        if one.call.fetched.done() or address not in workers:
            return Ended("died", None, f"{address} was lost")
        if time.monotonic() - one.begun_s <= one.seconds:
            return None
        try:
            self.client.restart_workers([address], timeout=_PATIENCE_S, raise_for_error=False)
        except ValueError:  # it has no nanny: its thread works on, and gets nothing any more
            self._stuck.add(address)
        return late(one.seconds)

    def workers(self) -> dict[str, Any]:
        """Return what the scheduler says of the workers that may be given items, by address; wait where there is none.

        Raises `JaxbaError` where none comes, or the scheduler has gone, or a worker is unlike this process.
        """
        begun_s = time.monotonic()
        while True:
            try:
                found = dict(self.client.scheduler_info(n_workers=-1)["workers"])
                if self.client.status == "closed":  # it has tried to come back to the scheduler
                    raise OSError
            except (OSError, TimeoutError, RuntimeError, KeyError) as error:  # what it says of itself is empty then
                raise JaxbaError(
                    f"{self._where}: the scheduler no longer answers. What is done is kept; start it again with its "
                    "workers, and the same command goes on."
                ) from error
            workers = {address: found[address] for address in sorted(found) if address not in self._stuck}
            if new := [address for address in workers if address not in self._alike]:
                self._alike |= self._require_alike(new)
            if workers := {address: workers[address] for address in workers if address in self._alike}:
                return workers
            if time.monotonic() - begun_s > _PATIENCE_S:
                raise JaxbaError(
                    f"{self._where}: the scheduler has no worker to give anything to. What is done is kept; start "
                    "workers (dask worker with the same address or scheduler file), and the same command goes on."
                )
            time.sleep(_LOOK_S)

    @property
    def _where(self) -> str:
        return _where(self._resources)

    def _require_alike(self, addresses: list[str]) -> set[str]:
        """Return the workers that have answered, and are as this process: of its versions, and see what it sees.

        Raises `JaxbaError` for one that is not.
        """
        here = _about([str(path.absolute()) for path in self._reads])
        found: Any = self.client.run(_about, list(here.seen), workers=addresses, on_error="return")
        for address, there in sorted(found.items()):
            if isinstance(there, OSError):  # it has just gone, and is asked again if it comes back
                continue
            if not isinstance(there, _About):
                raise JaxbaError(
                    f"worker {address}: jaxba cannot be used there ({type(there).__name__}: {there}). Install the same "
                    "environment on all machines."
                )
            if other := _difference(here.versions, there.versions):
                raise JaxbaError(f"worker {address} on {there.host}: {other}")
            for path, content in here.seen.items():
                if there.seen[path] != content:
                    raise JaxbaError(
                        f"worker {address} on {there.host} does not see {path} as this machine does. Photos and "
                        "project have to lie on storage that all machines mount under the same path."
                    )
        return {address for address, there in found.items() if isinstance(there, _About)}


class _About(NamedTuple):
    """What is compared of a worker: its versions, and its files' first bytes, None for what it does not see."""

    host: str
    versions: dict[str, str]
    seen: dict[str, str | None]


def _about(paths: list[str]) -> _About:
    return _About(platform.node(), _versions(), _seen(paths))


def _versions() -> dict[str, str]:
    return {**installed(), "Python": platform.python_version(), "jaxba": _source()}


def _difference(here: dict[str, str], there: dict[str, str]) -> str | None:
    """Return in words how the versions of a worker differ from those here; None where they do not."""
    for name in sorted(here.keys() | there.keys()):
        own, other = here.get(name, "none"), there.get(name, "none")
        if own != other:
            return (
                f"it has {name} {other}, and this process has {own}; results would differ by the worker. Install the "
                "same versions on all machines (requirements.lock)."
            )
    return None


@functools.cache
def _source() -> str:
    """Return jaxba's version, with a mark of its source: two checkouts of a version differ."""
    package = Path(__file__).parents[1]
    digest = hashlib.sha256()
    for path in sorted(package.rglob("*.py")):
        digest.update(path.relative_to(package).as_posix().encode() + b"\0" + path.read_bytes())
    return f"{__version__} (source {digest.hexdigest()[:8]})"


def _seen(paths: list[str]) -> dict[str, str | None]:
    found: dict[str, str | None] = {}
    for path in paths:
        try:
            with open(path, "rb") as file:
                found[path] = hashlib.sha256(file.read(_HEAD)).hexdigest()
        except OSError:
            found[path] = None
    return found


def threads_of(workers: dict[str, Any]) -> list[str]:
    """Return the address of each thread."""
    return [address for address, worker in workers.items() for _ in range(worker["nthreads"])]


def _free(workers: dict[str, Any], working: Iterable[_Begun], *, alone: bool) -> list[str]:
    """Return the address of each thread that nothing was given to; of one, where no other item is worked on."""
    busy = Counter(one.call.address for one in working)
    if alone:
        return [] if busy else list(workers)[:1]
    return list((Counter(threads_of(workers)) - busy).elements())


def _client(resources: Resources) -> distributed.Client:
    """Return a client of the scheduler that the settings name; raise `JaxbaError` where there is none."""
    where = _where(resources)
    if resources.scheduler_file is not None:
        try:
            address = json.loads(Path(resources.scheduler_file).read_text(encoding="utf-8"))["address"]
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise JaxbaError(
                f"{where}: no file of a dask scheduler ({error}). Start one with dask scheduler --scheduler-file "
                f"{resources.scheduler_file}, and its workers with the same option."
            ) from error
    else:
        address = resources.scheduler
    if str(address).startswith("tls:") and not distributed.Security().get_connection_args("client").get("ssl_context"):
        raise JaxbaError(
            f"{where}: dask's settings name no certificates for {address}. Set DASK_DISTRIBUTED__COMM__TLS__CA_FILE, "
            "..__TLS__CLIENT__CERT and ..__TLS__CLIENT__KEY."
        )
    try:
        return _connected(address)
    except (OSError, TimeoutError, ValueError, RuntimeError) as error:
        raise JaxbaError(
            f"{where}: no scheduler answers at {address} in {_ANSWER_S:g} s. Start one with dask scheduler, or "
            "correct the address (tcp://host:8786; tls:// where it is encrypted)."
        ) from error


def _connected(address: Any) -> distributed.Client:
    """Return a client; ask again where a worker came to the scheduler meanwhile, over which dask's client trips."""
    for _ in range(_TRIPS):
        with contextlib.suppress(AssertionError):
            return distributed.Client(address, timeout=_ANSWER_S, set_as_default=False, name="jaxba")
    raise OSError("its first answer is not one of dask's")


def _where(resources: Resources) -> str:
    if resources.scheduler_file is not None:
        return f"workers.scheduler_file={resources.scheduler_file}"
    return f"workers.scheduler={resources.scheduler}"
