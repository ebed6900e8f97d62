"""Numbers that options and losses take: refused by name, value and cure where they could only end in nonsense."""

from typing import Any

import numpy as np
from jax.core import Tracer

from jaxba._errors import JaxbaError


def require_number(label: str, value: Any, low: float, high: float, cure: str, *, whole: bool = False) -> None:
    """Raise `JaxbaError` unless a value is one number from `low` to `high`.

    - `label`: what it is, with its owner. `cure`: what to give instead. `whole`: whether it must be a whole number.

    A traced number passes, since nobody knows its value.

    >>> require_number("ftol", 1e-8, 0.0, 1.0, "give a small number")
    """
    if np.shape(value) != ():
        raise JaxbaError(f"{label} has shape {np.shape(value)}; it is one number: {cure}.")
    if isinstance(value, Tracer):
        return
    array = np.asarray(value)
    if array.dtype.kind not in "iuf":
        raise JaxbaError(f"{label} is {value!r}, which is no number; {cure}.")
    if not low <= array <= high or (whole and array != np.floor(array)):  # NaN is within nothing
        raise JaxbaError(f"{label} is {array:g}; {cure}.")
