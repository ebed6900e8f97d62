"""Selections: which entries of a kind are meant, given as indices, a mask, a slice, or all of them.

Every function that takes some images, points or parameters reads them here, so that lists, numpy and jax arrays mean
the same everywhere.
"""

from collections.abc import Iterable, Sequence
from typing import Any

import jax
import numpy as np
from jax.core import Tracer
from jaxtyping import Bool

from jaxba._errors import JaxbaError

Selection = Any
"""True (all), False or None (none), an index, indices or a mask (list, set, range, numpy or jax array), or a slice."""


def selected(label: str, value: Selection, count: int, kind: str) -> Bool[np.ndarray, " count"]:
    """Return True for each entry that is meant.

    - `label`: what the value was given for, in messages. `kind`: of the entries, in the plural.

    Raises `JaxbaError` for an index out of range, a mask of another length, and for what is no selection. Indices count
    from 0; those below 0 are refused, since they are as often a mistake as they are meant to count from the end.

    >>> import numpy as np
    >>> selected("poses", [0, 2], 3, "images").tolist()
    [True, False, True]
    >>> selected("poses", np.array([False, True]), 2, "images").tolist()
    [False, True]
    """
    mask = np.zeros(count, bool)
    if value is None:
        return mask
    if isinstance(value, slice):
        mask[value] = True
        return mask
    value = _plain(value)
    if holds_tracer(value):
        raise JaxbaError(f"{label}: the {kind} are traced, as arguments of jit are; choose them outside of it.")
    array = _array(value)
    if array.dtype == bool:
        if array.shape not in ((), (count,)):
            raise JaxbaError(
                f"{label}: a mask of shape {array.shape} for {count} {kind}; give one True or False for each."
            )
        mask[:] = array
        return mask
    if array.ndim > 1 or (array.size and array.dtype.kind not in "iu"):
        raise JaxbaError(
            f"{label}: {_short(value)} of type {array.dtype} and shape {array.shape}; give indices of {kind} as whole "
            "numbers counted from 0, a mask, or True for all."
        )
    index = array.reshape(-1)
    bad = index[(index < 0) | (index >= count)]
    if len(bad):
        more = f" (and {len(bad) - 1} more)" if len(bad) > 1 else ""
        raise JaxbaError(
            f"{label}: index {bad[0]}{more}, but there are {count} {kind}, counted from 0 to {count - 1}; correct it."
        )
    mask[index.astype(np.int64)] = True
    return mask


def selected_names(label: str, value: Selection, names: Sequence[str], kind: str) -> Bool[np.ndarray, " names"]:
    """Return True for each name that is meant: a name, names, or what `selected` takes."""
    value = [value] if isinstance(value, str) else _plain(value)
    array = None if isinstance(value, slice) or holds_tracer(value) else _array(value)
    if array is None or array.dtype.kind != "U":
        return selected(label, value, len(names), kind)
    for name in array.reshape(-1).tolist():
        if name not in names:
            raise JaxbaError(f"{label}: {name!r} is none of the {kind}: {', '.join(names)}; choose from these.")
    return np.isin(names, array)


def holds_tracer(value: Any) -> bool:
    """Whether a choice, or an entry of it, is a tracer of jax's."""
    return any(isinstance(leaf, Tracer) for leaf in jax.tree.leaves(value))


def _plain(value: Any) -> Any:
    """Return sets, ranges, generators and arrays of objects (as pandas keeps names) as lists, all else as it is."""
    if isinstance(value, np.ndarray) and value.dtype == object:
        return value.tolist()
    is_array = isinstance(value, np.ndarray | np.generic | jax.Array | str | bytes)
    return list(value) if isinstance(value, Iterable) and not is_array else value


def _array(value: Any) -> np.ndarray:
    """Return an array; of objects where it is of several kinds or lengths."""
    entries = value if isinstance(value, list) else []
    try:
        array = np.asarray(value)
    except ValueError:
        return np.asarray(entries, object)
    of_kinds = {isinstance(entry, str) + 2 * isinstance(entry, bool | np.bool_) for entry in entries}
    return np.asarray(entries, object) if len(of_kinds) > 1 else array


def _short(value: Any) -> str:
    text = " ".join(repr(value).split())
    return text if len(text) <= 60 else f"{text[:57]}..."
