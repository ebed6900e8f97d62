"""Fields of OpenSfM's JSON, checked: an error names file, entry, field and value."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from jaxba._errors import JaxbaError


def told(value: object) -> str:
    """Return a value as messages show it."""
    text = "missing" if value is None else repr(value)
    return text if len(text) <= 40 else f"{text[:40]}..."


def numbers(file: Path, of: str, entry: Mapping[str, Any], key: str, count: int) -> list[float]:
    """Return a list of so many finite numbers; `of`: the entry, for messages."""
    value = entry.get(key)
    if isinstance(value, list) and len(value) == count and all(is_number(number) for number in value):
        return [float(number) for number in value]
    raise JaxbaError(f"{file}: {of} has {key} {told(value)}, where {count} finite numbers are needed; export it again.")


def number(file: Path, of: str, entry: Mapping[str, Any], key: str, default: float | None = None) -> float:
    """Return a finite number."""
    value = entry.get(key, default)
    if not is_number(value):
        raise JaxbaError(f"{file}: {of} has {key} {told(value)}, where a finite number is needed; export it again.")
    return float(value)


def is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and abs(value) < 1e300 and value == value
