"""Reasons and the photos that they concern, as lines: each reason once."""

import re
from collections.abc import Sequence

from jaxba.engine._words import some_photos
from jaxba.scene import LeftOut

_MOST_LINES = 10
_NUMBER = re.compile(r"(?<![\w.])[-+]?\d+(?:\.\d+)?(?!\w)")


def grouped(entries: Sequence[LeftOut]) -> list[str]:
    """Return each reason once, with the photos that it concerns; the first few reasons where there are many."""
    names: dict[str, list[str]] = {}
    for entry in entries:
        names.setdefault(entry.reason, []).append(entry.name)
    lines = [f"{some_photos(found)}: {reason}" for reason, found in names.items()]
    if len(lines) <= _MOST_LINES:
        return lines
    rest = sum(len(found) for found in list(names.values())[_MOST_LINES:])
    return [*lines[:_MOST_LINES], f"and {rest} more such files, each with its reason in summary.json."]


def with_ranges(entries: Sequence[LeftOut]) -> list[LeftOut]:
    """Return the same, with reasons that differ in their numbers alone made one: `1028 to 1459 keypoints`."""
    kinds: dict[str, list[LeftOut]] = {}
    for entry in entries:
        kinds.setdefault(_NUMBER.sub("#", entry.reason), []).append(entry)
    result = []
    for kind, alike in kinds.items():
        columns = zip(*(_NUMBER.findall(entry.reason) for entry in alike), strict=True)
        ends = [(min(column, key=float), max(column, key=float)) for column in columns]
        texts = iter([low if low == high else f"{low} to {high}" for low, high in ends])
        reason = re.sub("#", lambda _, texts=texts: next(texts), kind)
        result += [LeftOut(name=entry.name, reason=reason) for entry in alike]
    return result
