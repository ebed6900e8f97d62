"""A photo from its file: tags read, checked and put in the terms of `jaxba.scene.Photo`; no pixel is decoded."""

import datetime
from dataclasses import replace

from jaxba._errors import JaxbaError
from jaxba.scene import Photo, PhotoFile
from jaxba.vision._attitude_tags import find_attitudes
from jaxba.vision._cameras import camera_name, find_lens
from jaxba.vision._exif import BASE, Tags, number, read_tags, text
from jaxba.vision._focal import find_focal
from jaxba.vision._position import find_position

IMAGE_SUFFIXES = (".jpg", ".jpeg", ".jpe", ".mpo", ".tif", ".tiff", ".png", ".webp", ".bmp")
RAW_SUFFIXES = (
    ".dng", ".cr2", ".cr3", ".nef", ".nrw", ".arw", ".sr2", ".orf", ".rw2", ".raf", ".pef", ".srw", ".3fr", ".iiq",
    ".rwl", ".gpr", ".heic", ".heif", ".avif",
)  # fmt: skip
"""Photos that must be developed or converted first."""


def read_photo(file: PhotoFile, *, focal_px: float | None = None, max_focal_deviation: float = 0.15) -> Photo:
    """Return what a file's header and tags tell of a photo.

    - `focal_px`: the user's focal length, in place of the tags'.
    - `max_focal_deviation`: of the tags' focal length from the sensor's specification, as a share.

    Raises `JaxbaError` for a file that is no image, and for a focal length that contradicts the sensor.
    """
    tags = read_tags(file.path)
    notes = list(tags.problems)
    make = tags.text(BASE.Make) or text(tags.xmp.get("tiff:Make"))
    model = tags.text(BASE.Model) or text(tags.xmp.get("tiff:Model"))
    if not model:  # a phone's lens names its phone: `iPhone 4S back camera 4.28mm f/2.4`
        make, model = make or tags.text(BASE.LensMake), tags.text(BASE.LensModel).partition(" back ")[0]
    try:
        focal = find_focal(tags, make, model, given_px=focal_px, max_deviation=max_focal_deviation)
    except JaxbaError as error:
        raise JaxbaError(f"{file.path}: {error}") from None
    if tags.xmp_number("drone-dji:DewarpFlag") == 1:
        notes.append("the drone has taken out the lens's distortion (DewarpFlag 1).")
    notes.extend(focal.notes)
    _note_size(tags, notes)
    position = find_position(tags, notes)
    attitude, flight_attitude = find_attitudes(tags, notes)
    orientation = tags.number(BASE.Orientation)
    if orientation is not None and orientation not in range(1, 9):
        notes.append(f"Orientation {orientation:g} is none of 1 to 8 and counts as 1.")
        orientation = None
    photo = Photo(
        name=file.name,
        path=file.path,
        sha256=file.sha256,
        width_px=tags.width_px,
        height_px=tags.height_px,
        camera="",
        orientation=int(orientation or 1),
        make=make,
        model=model,
        time=_time(tags, notes),
        focal_px=focal.focal_px,
        focal_source=focal.source,
        position=position,
        attitude=attitude,
        flight_attitude=flight_attitude,
        notes=tuple(notes),
        original_size_px=_original_size(tags),
        lens=find_lens(tags, make, model, focal.focal_mm),
    )
    return replace(photo, camera=camera_name(photo))


def _original_size(tags: Tags) -> tuple[int, int] | None:
    size = tags.original_size_px
    return None if size is None else (round(size[0]), round(size[1]))


def _note_size(tags: Tags, notes: list[str]) -> None:
    original = tags.original_size_px
    if original and sorted(original) != sorted((tags.width_px, tags.height_px)):
        notes.append(
            f"EXIF says {original[0]:.0f} x {original[1]:.0f} pixels, the file holds {tags.width_px} x "
            f"{tags.height_px}: it was resized or cropped, and the focal length follows the file."
        )


def _time(tags: Tags, notes: list[str]) -> str | None:
    """Return the time of exposure as ISO 8601, local unless the camera states its offset."""
    for tag in (BASE.DateTimeOriginal, BASE.DateTimeDigitized, BASE.DateTime):
        words = tags.text(tag)
        if not words.strip(" 0:"):
            continue
        try:
            moment = datetime.datetime.strptime(words[:19], "%Y:%m:%d %H:%M:%S")
        except ValueError:
            notes.append(f"{tag.name} {words!r} is no date and time and counts as absent.")
            continue
        fraction = number(f"0.{tags.text(BASE.SubsecTimeOriginal)}") if tag == BASE.DateTimeOriginal else None
        moment += datetime.timedelta(seconds=fraction or 0.0)
        offset = tags.text(BASE.OffsetTimeOriginal)
        is_offset = len(offset) == 6 and offset[0] in "+-"
        return moment.isoformat() + (offset if is_offset else "")
    return None
