"""Where items are worked on: worker processes of this machine, or a dask cluster. Nothing else asks which.

An engine gives items to workers and says how each ended. Here stands what is the same for all: an item that no worker
has the memory for is named, and one whose worker died, or had not memory enough, is tried once more when the others are
done, with no other beside it: what the machine lacked is there then, and who was only in the way of another is no
victim.

What a stage that does all photos at once gives away of its work, it gives to the executors of a crew.
"""

import contextlib
from collections.abc import Callable, Generator, Iterator, Sequence
from concurrent.futures import Executor
from pathlib import Path
from typing import Any, NamedTuple, Protocol

from jaxba.engine._items import Ended, Item, in_gb, reason_of, too_large
from jaxba.engine._pool import LocalWorkers
from jaxba.engine._workers import Resources


class Engine(Protocol):
    """Workers.

    - `memory_bytes`: that the largest item may need. `count`: items that are worked on at a time.
    - `more_memory`: in words, what gives items more of it.
    """

    more_memory: str

    @property
    def memory_bytes(self) -> float: ...
    @property
    def count(self) -> int: ...
    def worked(
        self, call: Callable[..., Any], items: Sequence[Item], *, alone: bool = False
    ) -> Iterator[tuple[Item, Ended]]:
        """Yield how each item ended, as they do; one at a time where they are to be `alone`."""
        ...


class Crew(NamedTuple):
    """Executors, one a worker's thread, and the bytes that each may keep of what it works on."""

    executors: Sequence[Executor]
    memory_bytes: float


@contextlib.contextmanager
def crew(resources: Resources, reads: Sequence[Path]) -> Iterator[Crew | None]:
    """Yield the crew of a cluster; None where this machine does the work, in threads of this process.

    - `reads`: paths that a worker must see.

    Raises `JaxbaError` as `work` does.
    """
    if not resources.is_cluster:
        yield None
        return
    from jaxba.engine import _crew

    with _crew.crew(resources, reads) as (executors, memory_bytes):
        yield Crew(executors, memory_bytes)


def work(
    call: Callable[..., Any], items: Sequence[Item], resources: Resources
) -> Generator[tuple[Item, Any, str | None], None, None]:
    """Yield each item with its result, or with the reason why it has none, as they come to an end.

    `call` must be a module's function. A `JaxbaError` in it is raised here: it stops the run.
    """
    with _engine(items, resources) as engine:
        fitting = []
        for item in items:
            if item.need_bytes > engine.memory_bytes:
                yield item, None, too_large(item, engine.memory_bytes, engine.more_memory)
            else:
                fitting.append(item)
        again: list[tuple[Item, Ended]] = []
        for item, ended in engine.worked(call, fitting):
            if ended.how == "died" or (ended.how == "memory" and engine.count > 1):
                again.append((item, ended))
            else:
                yield item, ended.result, reason_of(ended, engine.more_memory)
        for item, ended in engine.worked(call, [item for item, _ in again], alone=True):
            yield (
                item,
                ended.result,
                reason_of(ended, engine.more_memory, " twice, the second time with no other beside it"),
            )


def fewer_workers(items: Sequence[Item], resources: Resources) -> str | None:
    """Return in words that the memory allows fewer workers than are asked for; None where it does not limit them."""
    if resources.is_cluster:
        return None
    crew = LocalWorkers(items, resources)
    wanted = min(resources.num_wanted(), crew.num_fitting)
    if crew.count >= wanted:
        return None
    return (
        f"{crew.count} of {wanted} workers: a photo needs up to {in_gb(crew.largest_bytes)} of memory, "
        f"{in_gb(resources.memory_bytes)} are allowed for all; --max-memory raises it."
    )


@contextlib.contextmanager
def _engine(items: Sequence[Item], resources: Resources) -> Iterator[Engine]:
    if not resources.is_cluster:
        yield LocalWorkers(items, resources)
        return
    from jaxba.engine._cluster import cluster  # an extra, and slow to import

    with cluster((path for item in items for path in item.reads), resources) as engine:
        yield engine
