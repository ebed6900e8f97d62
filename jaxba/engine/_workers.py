"""Settings of the worker processes: what they may use, how long a photo may take, how many photos may fail."""

import os
from dataclasses import dataclass

from jaxba._errors import JaxbaError
from jaxba._sizes import bytes_of, machine_memory
from jaxba.engine._parameters import Parameters, parameter

_BASE_GB, _GB_PER_MEGAPIXEL = 0.35, 0.25  # SIFT holds 1.25 GB at 5 megapixels and 4.6 GB at 20
_BASE_S, _S_PER_EFFORT = 60.0, 10.0  # SIFT takes 0.7 s a megapixel, two photos of 8000 features 0.5 s, on an idle core
_LEAST_MEMORY, _LEAST_STORE = 1e8, 1e6


@dataclass(frozen=True, kw_only=True)
class Resources(Parameters):
    """What the workers may use."""

    workers: int | None = parameter(
        None, low=1, high=1024, help="processes for features and matches; none: one a core; fewer where memory ends"
    )
    max_memory: float | str = parameter(
        0.8,
        help="memory for all of them, and for solving in tiles: a share of the machine's, 0.1 to 0.95, or an amount "
        "such as 4GB or 800MB",
    )
    time_limit: float | None = parameter(
        None, low=1, high=86400, help="s that a photo may take in a stage; none: 60 and 10 a megapixel or pair"
    )
    max_failed: float = parameter(
        0.5, low=0, high=1e9, help="the run stops when more photos fail in a stage: a share below 1, or a number"
    )
    max_store: float | str = parameter(
        0.9, help="what features may take on the disk: a share of what is free, 0.1 to 1, or an amount such as 500GB"
    )

    scheduler: str | None = parameter(
        None, help="a dask cluster in place of this machine's processes: its scheduler's address, tcp://host:8786"
    )
    scheduler_file: str | None = parameter(None, help="the same, by the file that the scheduler wrote for its workers")

    def __post_init__(self) -> None:
        Parameters.__post_init__(self)
        if self.scheduler is not None and self.scheduler_file is not None:
            raise JaxbaError("workers.scheduler and workers.scheduler_file: give one of the two.")
        _check_amount("max_memory", self.max_memory, most_share=0.95, least_bytes=_LEAST_MEMORY)
        _check_amount("max_store", self.max_store, most_share=1.0, least_bytes=_LEAST_STORE)
        if self.max_failed > 1 and not float(self.max_failed).is_integer():
            raise JaxbaError(f"workers.max_failed={self.max_failed:g}: give a share below 1, or a whole number.")

    @property
    def is_cluster(self) -> bool:
        """Whether a dask cluster does the work."""
        return self.scheduler is not None or self.scheduler_file is not None

    @property
    def memory_bytes(self) -> float:
        """What all workers together may take."""
        return bytes_of(self.max_memory, machine_memory())

    def num_wanted(self) -> int:
        """Return how many workers are asked for: that many, or one a core."""
        if self.workers is not None:
            return self.workers
        return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1

    def num_workers(self, need_bytes: float) -> int:
        """Return how many processes fit that need this much each; at least one."""
        return max(1, min(self.num_wanted(), int(self.memory_bytes / need_bytes)))

    def seconds_for(self, effort: float) -> float:
        """Return how long an item may take; `effort`: its megapixels, times the photos it is worked on with."""
        return _BASE_S + _S_PER_EFFORT * effort if self.time_limit is None else float(self.time_limit)

    def num_may_fail(self, total: int) -> int:
        """Return how many of so many photos may fail."""
        return int(self.max_failed * total if self.max_failed < 1 else self.max_failed)


def memory_for(megapixels: float) -> float:
    """Return the bytes that a worker needs for photos of this size."""
    return (_BASE_GB + _GB_PER_MEGAPIXEL * megapixels) * 1e9


def megapixels_of(need_bytes: float) -> float:
    """Return the size of the photo that is said to need so much memory."""
    return max(need_bytes / 1e9 - _BASE_GB, 0.0) / _GB_PER_MEGAPIXEL


def _check_amount(name: str, amount: float | str, *, most_share: float, least_bytes: float) -> None:
    share = bytes_of(amount, 1.0)
    if not (0.1 <= share <= most_share or share >= least_bytes):
        least = f"{least_bytes / 1e6:g}MB"
        raise JaxbaError(
            f"workers.{name}={amount}: give a share from 0.1 to {most_share:g}, or an amount from {least} such as 4GB."
        )
