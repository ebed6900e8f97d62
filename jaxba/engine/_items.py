"""An item of work, how it ended, and the words for it, wherever it was worked on."""

import signal
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from jaxba._errors import JaxbaError
from jaxba.scene import fault, lacks_memory

_TOO_LARGE, _NO_MEMORY, _DIED = "needs about", "not enough memory", "its worker process"  # reasons begin with them


@dataclass(frozen=True, kw_only=True)
class Item:
    """One photo's work: `call(*arguments)` in a worker.

    - `name`: the photo's. `need_bytes`: the memory it takes. `effort`: how long it takes, against other items: its
      megapixels, times the photos it is worked on with.
    - `reads`: paths that a worker must see.
    """

    name: str
    arguments: tuple[Any, ...]
    need_bytes: float
    effort: float = 1.0
    reads: tuple[Path, ...] = ()


@dataclass(frozen=True)
class Ended:
    """How a call ended: `result`, or `reason` why there is none. `error`: of the run itself, which stops it."""

    how: Literal["done", "failed", "error", "memory", "died", "late"]
    result: Any = None
    reason: str | None = None


def called(call: Callable[..., Any], arguments: tuple[Any, ...]) -> Ended:
    """Call in a worker. What it raises is put in words here, since not every exception survives the way back."""
    try:
        return Ended("done", call(*arguments))
    except JaxbaError as error:
        return Ended("error", None, str(error))
    except BaseException as error:  # whatever a decoder makes of a broken file, it costs that file alone
        if lacks_memory(error):
            return Ended("memory")
        return Ended("failed", None, f"was stopped {fault(error)}")


def late(seconds: float) -> Ended:
    """Return how an item ended that was given no more time."""
    return Ended("late", None, f"took longer than {seconds:g} s; raise --time-limit, or look at the file")


def died(exit_code: int | None) -> Ended:
    """Return how an item ended whose worker did so first."""
    if exit_code is not None and exit_code < 0:
        return Ended("died", None, f"was killed by {_signal(-exit_code)}")
    return Ended("died", None, f"ended with exit code {exit_code}")


def reason_of(ended: Ended, more_memory: str, how_often: str = "") -> str | None:
    """Return in words why there is no result; None where there is one."""
    if ended.how == "died":
        return f"{_DIED} {ended.reason}{how_often}: out of memory, or a broken file that crashes the decoder"
    if ended.how == "memory":
        return f"{_NO_MEMORY}; {more_memory}, or close other programs"
    return ended.reason


def too_large(item: Item, memory_bytes: float, more_memory: str) -> str:
    """Return in words that an item needs more memory than there is."""
    need, allowed = in_gb(item.need_bytes), in_gb(memory_bytes)
    return f"{_TOO_LARGE} {need} of memory, {allowed} are allowed; {more_memory}"


def lacked_memory(reason: str) -> bool:
    """Whether an item has no result for want of memory: the system kills, and C++ aborts, where there is none."""
    killed = reason.startswith(_DIED) and any(name in reason for name in ("SIGKILL", "SIGABRT"))
    return killed or reason.startswith((_TOO_LARGE, _NO_MEMORY))


def crashed(reason: str) -> bool:
    """Whether an item has no result since its worker died of something else than memory."""
    return reason.startswith(_DIED) and not lacked_memory(reason)


def in_gb(count: float) -> str:
    return f"{count / 1e9:.1f} GB"


def _signal(number: int) -> str:
    try:
        return signal.Signals(number).name
    except ValueError:
        return f"signal {number}"
