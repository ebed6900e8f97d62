"""Which entry of a list belongs to which photo; what is only in one of the two is named."""

from collections.abc import Sequence
from pathlib import PurePosixPath

from jaxba._errors import JaxbaError
from jaxba.io._geotags import Geotag, Geotags

_MOST_NAMES = 50


def match_geotags(
    geotags: Geotags, photos: Sequence[str], name: str = "geo.txt"
) -> tuple[dict[str, Geotag], list[str]]:
    """Return the entry of each photo that the list holds, and notes.

    - `photos`: names of photos, paths below their folder. `name`: of the list, for messages.

    An entry is a photo's name, or that without regard to case, or the last part of it. Raises `JaxbaError` where an
    entry may be several photos, two entries are one photo, and where the list and the photos have nothing in common.

    >>> from jaxba.io import parse_geotags
    >>> found, notes = match_geotags(parse_geotags("EPSG:4326\\nA.JPG 1 2"), ["flight1/a.jpg", "flight1/b.jpg"])
    >>> found["flight1/a.jpg"].position.y, notes[1]
    (2.0, 'geo.txt does not list flight1/b.jpg: the tags stand.')
    """
    keys: dict[tuple[int, str], list[str]] = {}
    for photo in photos:
        for key in enumerate(_keys(photo)):
            keys.setdefault(key, []).append(photo)
    found: dict[str, Geotag] = {}
    unknown = []
    for entry in geotags.entries:
        matches = next((keys[key] for key in enumerate(_keys(entry.name.replace("\\", "/"))) if key in keys), [])
        if len(matches) > 1:
            several = " or ".join(matches[:3])
            raise JaxbaError(f"{name} line {entry.line}: {entry.name} may be {several}; write the folder too.")
        if not matches:
            unknown.append(entry.name)
        elif matches[0] in found:
            before = found[matches[0]].line
            raise JaxbaError(f"{name} lines {before} and {entry.line}: both are {matches[0]}; keep one of them.")
        else:
            found[matches[0]] = entry
    if not found:
        raise JaxbaError(
            f"{name} lists none of the photos: it names {_some(unknown, 3)}, the folder holds {_some(photos, 3)}; "
            "write the names as in the folder, or leave the list away."
        )
    notes = [f"{name} replaces the tags' positions of {len(found)} of {len(photos)} photos."]
    missing = [photo for photo in photos if photo not in found]
    if missing:
        notes.append(f"{name} does not list {_some(missing)}: the tags stand.")
    if unknown:
        notes.append(f"{name} lists what is no usable photo: {_some(unknown)}.")
    return found, [*notes, *geotags.notes]


def _keys(name: str) -> tuple[str, str, str]:
    return name, name.lower(), PurePosixPath(name).name.lower()


def _some(names: Sequence[str], most: int = _MOST_NAMES) -> str:
    return ", ".join(names[:most]) + (f" and {len(names) - most} more" if len(names) > most else "")
