"""A call that was given to a worker of a dask cluster, and what has become of it.

dask binds a call to a worker's address, and keeps what it returns in that worker until it is asked for. Where the
worker goes before, dask waits for one of the same address, which a worker that is started anew has not, also where it
is told that others will do. So nobody waits for dask here: what a call returns is fetched as soon as it is there, by
the client's own thread, and who gave the call looks whether its worker has gone.
"""

import asyncio
import contextlib
from collections.abc import Callable
from concurrent.futures import BrokenExecutor, Future
from typing import Any

import distributed


class RemoteCall:
    """A call, and the future of its result in this process.

    - `address`: the worker's. `fetched`: ends when the result is here, or nothing more is to be expected.
    """

    def __init__(self, client: distributed.Client, address: str, call: Callable[..., Any], *arguments: Any) -> None:
        """Give the call; raise `BrokenExecutor` where the client's scheduler has gone."""
        self.address = address
        loop: Any = client.loop
        try:
            self._there = client.submit(call, *arguments, workers=[address], pure=False, retries=0)
            self.fetched: Future[Any] = asyncio.run_coroutine_threadsafe(_fetch(self._there), loop.asyncio_loop)
        except (OSError, RuntimeError) as error:
            raise BrokenExecutor(str(error)) from error

    def is_lost(self) -> bool:
        """Return whether an ended call has neither returned nor raised."""
        if self.fetched.cancelled():
            return True
        error = self.fetched.exception()
        return error is not None and (self._there.status != "error" or isinstance(error, distributed.KilledWorker))

    def take_back(self) -> None:
        """Take the call back, whatever its worker has made of it."""
        self.fetched.cancel()
        with contextlib.suppress(Exception):  # a client that has lost its scheduler cannot
            self._there.cancel()


async def _fetch(there: distributed.Future) -> Any:
    return await there
