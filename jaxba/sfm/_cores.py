"""Work in threads on all cores: numpy, scipy and compiled code hold no lock while they compute."""

import os
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from typing import Any, TypeVar

_T = TypeVar("_T")


def on_all_cores(work: Callable[..., _T], *arguments: Iterable[Any]) -> list[_T]:
    """Return what `map` would; what has not begun is not, once one call raises or Ctrl-C is pressed.

    >>> on_all_cores(pow, [2, 3], [3, 2])
    [8, 9]
    """
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        try:
            return list(pool.map(work, *arguments))
        except BaseException:
            pool.shutdown(cancel_futures=True)
            raise
