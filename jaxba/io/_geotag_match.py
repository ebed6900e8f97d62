"""Which entry of a list belongs to which photo; what is only in one of the two is named."""

from collections.abc import Callable, Sequence
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
    find = photo_finder(photos)
    found: dict[str, Geotag] = {}
    unknown = []
    for entry in geotags.entries:
        photo = find(entry.name, f"{name} line {entry.line}")
        if photo is None:
            unknown.append(entry.name)
        elif photo in found:
            before = found[photo].line
            raise JaxbaError(f"{name} lines {before} and {entry.line}: both are {photo}; keep one of them.")
        else:
            found[photo] = entry
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


def photo_finder(photos: Sequence[str]) -> Callable[[str, str], str | None]:
    """Return a function from a name in a list, and where it stands, to the photo that it means; None for none.

    The function raises `JaxbaError` where the name may be several photos.
    """
    keys: dict[tuple[int, str], list[str]] = {}
    for photo in photos:
        for key in enumerate(_keys(photo)):
            keys.setdefault(key, []).append(photo)

    def find(name: str, where: str) -> str | None:
        matches = next((keys[key] for key in enumerate(_keys(name.replace("\\", "/"))) if key in keys), [])
        if len(matches) > 1:
            raise JaxbaError(f"{where}: {name} may be {' or '.join(matches[:3])}; write the folder too.")
        return matches[0] if matches else None

    return find


def _keys(name: str) -> tuple[str, str, str]:
    return name, name.lower(), PurePosixPath(name).name.lower()


def _some(names: Sequence[str], most: int = _MOST_NAMES) -> str:
    return ", ".join(names[:most]) + (f" and {len(names) - most} more" if len(names) > most else "")
