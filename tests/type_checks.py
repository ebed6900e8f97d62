"""`checked`: beartype as jaxtyping calls it, without what it would do twice.

jaxtyping hands beartype two functions that have a signature and no body, and calls them beside the one that is checked:
one before it, with its parameters, and one after it, with its parameters and its result. The second need not look at
the parameters again: the sizes that their shapes name are still known. For an inner function the signatures are the
same at each call of the outer one, and so is the code that beartype writes and compiles for them, which takes a
millisecond: a tenth of what tests of tiles took.
"""

import functools
import typing
from collections.abc import Callable
from typing import Any, Literal

import beartype
import jaxtyping


def checked(function: Callable[..., Any]) -> Callable[..., Any]:
    """Return the function with arguments or result checked: the one of before, if all that beartype sees is alike."""
    if function.__annotations__.get("return", Any) is not Any:
        function.__annotations__ = {
            name: annotation if name == "return" else Any for name, annotation in function.__annotations__.items()
        }
    defaults = (*(function.__defaults__ or ()), *(function.__kwdefaults__ or {}).values())
    if any(type(default) not in (bool, int, float, str) for default in defaults):
        return beartype.beartype(function)
    return _checked(_Signature(function, tuple(map(type, defaults))))


class _Signature:
    """A function of which a checked one depends on the place, the parameters, their annotations and defaults alone."""

    def __init__(self, function: Callable[..., Any], defaults: tuple[type, ...]) -> None:
        code = function.__code__
        counts = code.co_posonlyargcount, code.co_argcount, code.co_kwonlyargcount, code.co_flags
        annotations = tuple((name, _alike(annotation)) for name, annotation in function.__annotations__.items())
        self.function = function
        self.key = function.__module__, function.__qualname__, counts, code.co_varnames, annotations, defaults

    def __hash__(self) -> int:
        return hash(self.key)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Signature) and self.key == other.key


def _alike(annotation: Any) -> Any:
    """Return what is equal for annotations that mean the same; each `Float[Array, "n"]` is a class of its own."""
    if isinstance(annotation, type) and issubclass(annotation, jaxtyping.AbstractArray):
        return annotation.dtype, _alike(annotation.array_type), annotation.dim_str
    if isinstance(annotation, list):  # the arguments of a Callable
        return tuple(map(_alike, annotation))
    arguments = typing.get_args(annotation)
    if not arguments or typing.get_origin(annotation) is Literal:
        return annotation
    return typing.get_origin(annotation), tuple(map(_alike, arguments))


@functools.lru_cache(maxsize=20_000)
def _checked(signature: _Signature) -> Callable[..., Any]:
    return beartype.beartype(signature.function)
