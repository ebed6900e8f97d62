"""Counts and lists of names in words, as lines and messages of the pipeline have them."""

from collections.abc import Sequence


def many(count: int, noun: str) -> str:
    """Return the count with its noun.

    >>> many(1, "photo"), many(1200, "photo")
    ('1 photo', '1,200 photos')
    """
    return f"{count:,} {noun}{'' if count == 1 else 's'}"


def some(names: Sequence[str], most: int = 5) -> str:
    """Return the names, or the first few and how many more there are.

    >>> some(["a", "b", "c"], most=2)
    'a, b and 1 more'
    """
    return ", ".join(names[:most]) + (f" and {len(names) - most} more" if len(names) > most else "")


def some_photos(names: Sequence[str], most: int = 3) -> str:
    """Return the names of photos, or how many they are and the first few.

    >>> some_photos(["a", "b"]), some_photos(["a", "b", "c", "d"])
    ('a, b', '4 photos (a, b, c, ...)')
    """
    shown = ", ".join(names[:most])
    return shown if len(names) <= most else f"{len(names)} photos ({shown}, ...)"
