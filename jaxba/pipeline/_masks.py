"""Masks among the photos: which file is the mask of which photo, by the conventions of programs that users come from.

| file | photo | who writes it so |
| --- | --- | --- |
| `IMG_1_mask.png`, of any image suffix | `IMG_1.JPG` in the same folder | OpenDroneMap |
| `IMG_1.mask.png`, `IMG_1.JPG.mask.png` | `IMG_1.JPG` in the same folder | OpenMVS, RealityCapture |
| `masks/IMG_1.JPG.png` | `IMG_1.JPG` | COLMAP, OpenSfM |
| `masks/IMG_1.png`, `masks/IMG_1_mask.png` | `IMG_1.JPG` | Metashape, and by hand |
| `IMG_1-mask.png`, `mask_IMG_1.png` | `IMG_1.JPG` in the same folder | by hand |

A folder `masks` (or `mask`, `_masks`, `flight1_masks`) may stand anywhere below the photos, and mirrors the folders of
the photos beside it. Names are compared without regard to case. Where a mask is black (0), no features are taken.
"""

import re
from collections.abc import Sequence
from dataclasses import replace
from pathlib import PurePosixPath

from jaxba._errors import JaxbaError
from jaxba.engine._words import some
from jaxba.scene import Photo, PhotoFile
from jaxba.vision import image_size

_FOLDER = re.compile(r"(.*[_\-. ])?masks?")
_WORD = re.compile(r"[_\-. ]masks?$|^masks?[_\-.]|^masks?$")
_SAME_FORMAT = 0.01  # width over height, of a mask that was drawn in photos of another scale


def is_mask(name: str) -> bool:
    """Whether a file is a mask by its name.

    >>> is_mask("a/IMG_1_mask.png"), is_mask("masks/a/IMG_1.JPG.png"), is_mask("unmasked.jpg")
    (True, True, False)
    """
    path = PurePosixPath(name.lower())
    return _WORD.search(path.stem) is not None or any(_FOLDER.fullmatch(part) for part in path.parts[:-1])


def with_masks(photos: Sequence[Photo], masks: Sequence[PhotoFile]) -> tuple[list[Photo], list[str]]:
    """Return the photos with the masks that are theirs, and notes.

    Raises `JaxbaError` for a photo with two masks, and for masks that cannot be read or have another format than the
    photo.
    """
    keys: dict[str, list[str]] = {}
    for photo in photos:
        path = PurePosixPath(photo.name.lower())
        for key in (path.as_posix(), path.with_suffix("").as_posix(), path.name, path.stem):
            if photo.name not in keys.setdefault(key, []):
                keys[key].append(photo.name)
    found: dict[str, PhotoFile] = {}
    strangers = []
    for mask in masks:
        owner = _owner(mask.name, keys)
        if owner is None:
            strangers.append(mask.name)
        elif owner in found:
            raise JaxbaError(f"{owner} has two masks, {found[owner].name} and {mask.name}; keep one of them.")
        else:
            found[owner] = mask
    of = {photo.name: photo for photo in photos}
    wrong = [text for name, mask in found.items() if (text := _why_not(of[name], mask))]
    if wrong:
        raise JaxbaError(f"{len(wrong)} of {len(found)} masks do not fit their photos: {some(wrong, 3)}.")
    notes = []
    if found:
        first, mask = next(iter(found.items()))
        has, more = ("has", "") if len(found) == 1 else ("have", ", ...")
        notes.append(
            f"{len(found)} of {len(photos)} photos {has} a mask ({first}: {mask.name}{more}): no features are taken "
            "where it is black."
        )
    if strangers:
        notes.append(f"Masks of no photo are passed over, {len(strangers)}: {some(strangers)}.")
    return [replace(photo, mask=found.get(photo.name)) for photo in photos], notes


def _owner(name: str, keys: dict[str, list[str]]) -> str | None:
    """Return the photo whose mask a file is; None for no photo, or one of several."""
    path = PurePosixPath(name.lower())
    stem = _WORD.sub("", path.stem)
    folder = PurePosixPath(*(part for part in path.parts[:-1] if not _FOLDER.fullmatch(part)))
    for key in ((folder / stem).as_posix(), stem):
        if len(keys.get(key, ())) == 1:
            return keys[key][0]
    return None


def _why_not(photo: Photo, mask: PhotoFile) -> str:
    """Return why a mask does not fit its photo; nothing where it does."""
    width, height = image_size(mask.path)
    if abs(width * photo.height_px / (height * photo.width_px) - 1) <= _SAME_FORMAT:
        return ""
    text = f"{mask.name} has {width} x {height} pixels and {photo.name} {photo.width_px} x {photo.height_px}"
    if abs(height * photo.height_px / (width * photo.width_px) - 1) <= _SAME_FORMAT:
        turned = f" (the photo's EXIF orientation is {photo.orientation})" if photo.orientation > 1 else ""
        return (
            f"{text}: it is turned{turned}; masks count on the pixels as they are stored, so turn it back or remove it"
        )
    return f"{text}; draw it in the photo, or remove it"
