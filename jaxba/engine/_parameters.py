"""Parameters of stages: a frozen dataclass a stage, each field with its default, range and one line of meaning.

    class Params(Parameters):
        ratio: float = parameter(0.75, low=0.6, high=0.85, help="nearest over second nearest descriptor distance")

A value outside its range or of another type is an error that states the range; it is never clipped.
"""

import dataclasses
import types
from typing import Any, get_args, get_origin, get_type_hints

from jaxba._errors import JaxbaError


def parameter(
    default: Any,
    *,
    help: str,
    low: float | int | None = None,
    high: float | int | None = None,
    choices: tuple[str, ...] = (),
    several: bool = False,
) -> Any:
    """Return a dataclass field with this default, range (both ends allowed) or choices, and meaning.

    `several`: a text may name several of the choices, with commas between them.
    """
    metadata = {"help": help, "low": low, "high": high, "choices": choices, "several": several}
    return dataclasses.field(default=default, metadata=metadata)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Parameters:
    """Base of every stage's `Params`; checks types and ranges when it is made."""

    def __post_init__(self) -> None:
        for field in dataclasses.fields(self):
            _check(type(self), field, getattr(self, field.name))

    def check_installed(self) -> None:
        """Raise `JaxbaError` where a value asks for what is not installed here; called when a run begins."""


def allowed(field: dataclasses.Field) -> str:
    """Return what a parameter may be, in words: `0.6 to 0.85`, `auto, sift, orb`, ``."""
    low, high, choices = (field.metadata.get(key) for key in ("low", "high", "choices"))
    if choices:
        return ", ".join(choices) + (", or several of them with commas between" if field.metadata["several"] else "")
    if low is not None and high is not None:
        return f"{low:g} to {high:g}"
    if low is not None:
        return f"{low:g} or more"
    return "" if high is None else f"{high:g} or less"


def taken(cls: type[Parameters], name: str, value: Any) -> Any:
    """Return a value from a file as the parameter `name` has it: a text is parsed, 2 is taken for 2.0."""
    if isinstance(value, str):
        return parse(cls, name, value)
    kinds, optional = _kinds(get_type_hints(cls)[name])
    if type(value) is int and int not in kinds and float in kinds:
        return float(value)
    if type(value) not in kinds:
        raise JaxbaError(f"{stage_name(cls)}.{name}={value}: give {_kind_text(kinds, optional)}.")
    return value


def parse(cls: type[Parameters], name: str, text: str) -> Any:
    """Return the value of the parameter `name` that a text such as `0.7`, `true` or `none` means."""
    kinds, optional = _kinds(get_type_hints(cls)[name])
    if optional and text.lower() == "none":
        return None
    lowered = text.lower()
    if bool in kinds and lowered in ("true", "false"):
        return lowered == "true"
    for kind in (int, float):
        if kind in kinds:
            try:
                return kind(text)
            except ValueError:
                continue
    if str in kinds:
        return text
    raise JaxbaError(f"{stage_name(cls)}.{name}={text}: give {_kind_text(kinds, optional)}.")


def stage_name(cls: type[Parameters]) -> str:
    """Return the name of the stage or section whose parameters these are: its own, or that of its module."""
    return getattr(cls, "section", "") or cls.__module__.rpartition(".")[2].lstrip("_")


def _check(cls: type[Parameters], field: dataclasses.Field, value: Any) -> None:
    label = f"{stage_name(cls)}.{field.name}={value}"
    kinds, optional = _kinds(get_type_hints(cls)[field.name])
    if value is None and optional:
        return
    fits = any(type(value) is kind for kind in kinds) or (float in kinds and type(value) is int)
    if not fits:
        raise JaxbaError(f"{label}: give {_kind_text(kinds, optional)}.")
    low, high, choices = (field.metadata.get(key) for key in ("low", "high", "choices"))
    outside = (low is not None and not value >= low) or (high is not None and not value <= high)
    named = [entry.strip() for entry in str(value).split(",")] if field.metadata["several"] else [value]
    if outside or (choices and not set(named) <= set(choices)):
        raise JaxbaError(f"{label} is out of range; allowed: {allowed(field)} ({field.metadata['help']}).")


def _kinds(hint: Any) -> tuple[tuple[type, ...], bool]:
    """Return the types that a parameter may have, and whether it may be None."""
    union = get_args(hint) if isinstance(hint, types.UnionType) else (hint,)
    kinds = tuple(get_origin(kind) or kind for kind in union if kind is not type(None))
    return kinds, type(None) in union


def _kind_text(kinds: tuple[type, ...], optional: bool) -> str:
    names = {int: "a whole number", float: "a number", str: "a text", bool: "true or false"}
    return " or ".join([names.get(kind, kind.__name__) for kind in kinds] + (["none"] if optional else []))
