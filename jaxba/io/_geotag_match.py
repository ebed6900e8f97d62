"""Which entry of a list belongs to which photo; what is only in one of the two is named."""

import re
import unicodedata
from collections.abc import Callable, Sequence
from pathlib import PurePosixPath

from jaxba._errors import JaxbaError
from jaxba.io._geotags import Geotag, Geotags
from jaxba.io._list_cells import has_image_suffix, some

_MOST_NAMES = 50


def match_geotags(
    geotags: Geotags, photos: Sequence[str], name: str = "geo.txt"
) -> tuple[dict[str, Geotag], list[str]]:
    """Return the entry of each photo that the list holds, and notes.

    - `photos`: names of photos, paths below their folder. `name`: of the list, for messages.

    See `photo_finder` for what an entry may be called. Raises `JaxbaError` where an
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
    unknown = [name + like_photo(name, photos) for name in unknown]
    if not found:
        raise JaxbaError(
            f"{name} lists none of the photos: it names {some(unknown, 3)}, the folder holds {some(photos, 3)}; "
            "write the names as in the folder, or leave the list away."
        )
    notes = [f"{name} replaces the tags' positions of {len(found)} of {len(photos)} photos."]
    missing = [photo for photo in photos if photo not in found]
    if missing:
        notes.append(f"{name} does not list {some(missing, _MOST_NAMES)}: the tags stand.")
    if unknown:
        notes.append(f"{name} lists what is no usable photo: {some(unknown, _MOST_NAMES)}.")
    return found, [*notes, *geotags.notes]


def photo_finder(photos: Sequence[str]) -> Callable[[str, str], str | None]:
    """Return a function from a name in a list, and where it stands, to the photo that it means; None for none.

    A name is looked for as it is; then in one Unicode form, with single blanks; then in any case; then without its
    folders; and, where it has no ending of an image, as a photo's name without one. The first of these that some photo
    has decides. The function raises `JaxbaError` where that are several.

    >>> photo_finder(["flight 1/DJI_0007 (2).JPG"])("dji_0007  (2)", "geo.txt line 2")
    'flight 1/DJI_0007 (2).JPG'
    """
    keys: dict[tuple[int, str], list[str]] = {}
    for photo in photos:
        stem = PurePosixPath(_keys(photo)[-1]).stem
        for key in enumerate((*_keys(photo), stem)):
            keys.setdefault(key, []).append(photo)

    def find(name: str, where: str) -> str | None:
        asked = _keys(name.replace("\\", "/"))
        levels = asked if has_image_suffix(name) else (*asked, asked[-1])
        matches = next((keys[key] for key in enumerate(levels) if key in keys), [])
        if len(matches) > 1:
            raise JaxbaError(f"{where}: {name} may be {' or '.join(matches[:3])}; write the folder too.")
        return matches[0] if matches else None

    return find


def photo_names(photos: Sequence[str]) -> Callable[[str], bool]:
    """Return whether a name is that of one or more photos, as `photo_finder` looks for them."""
    find = photo_finder(photos)

    def is_photo(name: str) -> bool:
        try:
            return find(name, "") is not None
        except JaxbaError:
            return True

    return is_photo


def like_photo(name: str, photos: Sequence[str]) -> str:
    """Return what to say of a photo whose name has the same letters and digits as one that is not found; empty: none.

    >>> like_photo("DJI_0007(2).JPG", ["DJI_0007 (2).JPG"])
    ' (DJI_0007 (2).JPG, but for blanks or marks? Write it so)'
    """
    like = next((photo for photo in photos if _letters(photo) == _letters(name)), None)
    return "" if like is None or not _letters(name) else f" ({like}, but for blanks or marks? Write it so)"


def _keys(name: str) -> tuple[str, str, str, str]:
    plain = " ".join(unicodedata.normalize("NFC", name).split())
    plain = plain[1:-1] if len(plain) > 2 and plain[0] == plain[-1] and plain[0] in "\"'" else plain
    folded = unicodedata.normalize("NFC", plain.casefold())
    return name, plain, folded, PurePosixPath(folded).name


def _letters(name: str) -> str:
    """Return the letters and digits of the last part of a name, without case and accents."""
    base = re.split(r"[/\\]", unicodedata.normalize("NFKD", name).casefold())[-1]
    return "".join(letter for letter in base if letter.isalnum())
