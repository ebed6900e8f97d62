"""Sizes in bytes: what a text means, how they are written, and what memory there is."""

import contextlib
import ctypes
import re
from pathlib import Path

import psutil

_AMOUNT = re.compile(r"(\d+(?:\.\d*)?(?:e\d+)?)\s*([kmgt]i?)?b?", re.IGNORECASE)
_CONTAINER_LIMITS = ("/sys/fs/cgroup/memory.max", "/sys/fs/cgroup/memory/memory.limit_in_bytes")  # version 2, 1


def machine_memory() -> float:
    """Return the bytes of memory that the machine has, or the container that this runs in."""
    total = float(psutil.virtual_memory().total)
    for path in map(Path, _CONTAINER_LIMITS):
        text = path.read_text().strip() if path.is_file() else ""
        total = min(total, float(text)) if text.isdigit() else total  # `max`: no limit
    return total


def bytes_of(amount: float | str, whole: float) -> float:
    """Return the bytes that `0.8` (a share of the whole), `4e9`, `4GB`, `800 MB` or `2GiB` mean; nan for other texts.

    >>> bytes_of("0.5", 16e9), bytes_of("4GB", 16e9), bytes_of("1KiB", 16e9)
    (8000000000.0, 4000000000.0, 1024.0)
    """
    found = _AMOUNT.fullmatch(str(amount).strip())
    if found is None:
        return float("nan")
    number, unit = float(found[1]), (found[2] or "").lower()
    if not unit:
        return number * whole if number <= 1 else number
    base = 1024 if unit.endswith("i") else 1000
    return number * base ** ("kmgt".index(unit[0]) + 1)


def size_text(count: float) -> str:
    """Return bytes in words.

    >>> size_text(150e6)
    '150.0 MB'
    """
    unit, name = next(((u, n) for u, n in ((1e12, "TB"), (1e9, "GB"), (1e6, "MB")) if count >= u), (1e3, "kB"))
    return f"{count / unit:.1f} {name}"


def free_memory() -> float:
    """Return the bytes of memory that are free for this process: the machine's, or what its container leaves it."""
    return min(float(psutil.virtual_memory().available), machine_memory() - used_memory())


def used_memory() -> float:
    """Return the bytes of memory that this process holds, after it has given back what it holds for nothing."""
    with contextlib.suppress(OSError, AttributeError, TypeError):  # glibc alone has it, and keeps what was freed
        ctypes.CDLL(None).malloc_trim(0)
    return float(psutil.Process().memory_info().rss)
