"""Text and JSON for the terminal: nothing here knows what the numbers mean."""

import json
import math
import shutil
import textwrap
from collections.abc import Iterable, Mapping, Sequence

import numpy as np

_LABEL_WIDTH = 12
_MOST_COLUMNS, _LONGEST = 120, 900


def to_json(facts: Mapping[str, object]) -> str:
    """Return one line of JSON; numpy becomes plain numbers and lists, NaN and infinity become null."""
    return json.dumps(_plain(facts), allow_nan=False)


def _plain(value: object) -> object:
    if isinstance(value, Mapping):
        return {str(key): _plain(entry) for key, entry in value.items()}
    if isinstance(value, np.ndarray | np.generic):
        return _plain(value.tolist())
    if isinstance(value, list | tuple):
        return [_plain(entry) for entry in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value


def table(rows: Iterable[tuple[str, str | Sequence[str]]]) -> str:
    """Return a label and its text a line; several texts stand under each other, a label without any is left out."""
    lines = []
    for label, texts in rows:
        for text in [texts] if isinstance(texts, str) else texts:
            lines.append(f"{label:<{_LABEL_WIDTH}}{text}")
            label = ""
    return "\n".join(lines)


def many(count: int, noun: str) -> str:
    """Return the count with its noun: `1 image`, `12 images`."""
    return f"{count} {noun}{'' if count == 1 else 's'}"


def first_of(names: Sequence[str], most: int = 5) -> str:
    """Return the names, or the first few and how many more there are."""
    more = f", ... ({len(names) - most} more)" if len(names) > most else ""
    return ", ".join(names[:most]) + more


def gauge_text(free: Sequence[str]) -> str:
    """Return which directions of the whole block are free."""
    if not free:
        return "determined"
    return f"{many(len(free), 'direction')} free: {', '.join(free)}"


def wrapped(label: str, text: str, indent: int) -> str:
    """Return a text beside its label, each of its lines wrapped to the terminal; a very long line is cut."""
    width = max(min(shutil.get_terminal_size((_MOST_COLUMNS, 24)).columns, _MOST_COLUMNS), indent + 30)
    lines = []
    for line in text.split("\n"):
        if len(line) > _LONGEST:
            line = textwrap.shorten(line, _LONGEST, placeholder=" ... (the rest is in summary.json)")
        lines += textwrap.wrap(
            line,
            width,
            initial_indent=f"{label:<{indent}}",
            subsequent_indent=" " * indent,
            break_long_words=False,
            break_on_hyphens=False,
        )
        label = ""
    return "\n".join(lines)


def labelled(label: str, texts: Sequence[str]) -> list[tuple[str, str]]:
    """Return a row for each text, the first with the label.

    >>> labelled("findings", ["one", "two"])
    [('findings', 'one'), ('', 'two')]
    """
    return [("" if k else label, text) for k, text in enumerate(texts)]
