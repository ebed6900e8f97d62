"""Stage metadata: what each photo's tags and header tell; what cannot be used is left out and named.

Photos are the files with an image's suffix that are no masks; RAW files are left out, and other files are counted. Of
files with equal contents the first by name stays. A geo.txt or CSV replaces position, accuracy and, where it has
angles, attitude of the photos that it lists; its heights are turned into metres by the unit of its CRS. The height
above take-off stays that of the tags, and what else they say of the place is kept beside, for the list to be held
against. No pixel is decoded here.
"""

import dataclasses
from collections import Counter
from dataclasses import dataclass
from pathlib import PurePosixPath
from typing import Any

import numpy as np

from jaxba._errors import JaxbaError
from jaxba.engine._parameters import Parameters, parameter
from jaxba.engine._project import FOUND_LISTS
from jaxba.engine._words import many, some_photos
from jaxba.io import Geotag, match_geotags, parse_geotags, photo_names, without_fillers
from jaxba.pipeline._masks import is_mask, with_masks
from jaxba.report import Told, grouped, with_ranges
from jaxba.scene import Attitude, LeftOut, Photo, PhotoFile
from jaxba.vision import IMAGE_SUFFIXES, RAW_SUFFIXES, attitude_from_nadir_body, read_photo, shared_cameras

_SHOWN, _SHOWN_CAMERAS = 3, 5
_MOST_NOTES = 20


@dataclass(frozen=True, kw_only=True)
class Inputs:
    """- `files`: the photo folder's files, by name. `geotags`: text of a geo.txt or CSV that replaces the tags.

    - `is_geotags_found`: nobody named that list, which lies among the photos. `own_lists`: files that are lists in use.
    """

    files: tuple[PhotoFile, ...]
    geotags: str | None = None
    geotags_name: str = "geo.txt"
    is_geotags_found: bool = False
    own_lists: tuple[str, ...] = ()


@dataclass(frozen=True, kw_only=True)
class Params(Parameters):
    """What the user may set."""

    focal: float | None = parameter(None, low=100, high=100_000, help="focal length in pixels, in place of the tags'")
    max_focal_deviation: float = parameter(0.15, low=0.05, high=0.5, help="from the sensor's specification, as a share")


@dataclass(frozen=True, kw_only=True)
class Outputs:
    """- `photos`: usable frames by name. `left_out`: files that are none, with the reason."""

    photos: tuple[Photo, ...]
    left_out: tuple[LeftOut, ...]
    notes: tuple[str, ...] = ()


def run(inputs: Inputs, params: Params) -> Outputs:
    """Read the tags of every photo.

    Raises:
        JaxbaError: no file is a photo, none can be used, or the list that replaces the tags cannot be read.
    """
    files = sorted(inputs.files, key=lambda file: file.name)
    is_photo = photo_names([file.name for file in files])
    geotags = None if inputs.geotags is None else parse_geotags(inputs.geotags, inputs.geotags_name, is_photo)
    images = [file for file in files if _suffix(file) in IMAGE_SUFFIXES]
    masks = [file for file in images if is_mask(file.name)]
    if len(masks) < len(images):  # else the photos themselves have such names
        images = [file for file in images if file not in masks]
    else:
        masks = []
    if not images:
        raise JaxbaError(f"there is no photo: the folder holds {_counted(files)}; give one with JPEG or TIFF photos.")
    left_out = [LeftOut(name=f.name, reason=_RAW_CURE) for f in files if _suffix(f) in RAW_SUFFIXES]
    photos: list[Photo] = []
    first: dict[str, str] = {}
    for file in images:
        if file.sha256 in first:
            reason = f"is the same file as {first[file.sha256]}; delete one of them."
            left_out.append(LeftOut(name=file.name, reason=reason))
            continue
        first[file.sha256] = file.name
        try:
            photo = read_photo(file, focal_px=params.focal, max_focal_deviation=params.max_focal_deviation)
        except JaxbaError as error:
            reason = str(error).removeprefix(str(file.path)).lstrip(": ")
            left_out.append(LeftOut(name=file.name, reason=reason))
            continue
        photos.append(photo)
    if not photos:
        reasons = " ".join(f"{left.name}: {left.reason}" for left in left_out[:_SHOWN])
        raise JaxbaError(f"none of the {len(images)} photos can be used. {reasons}")
    photos, spellings = shared_cameras(photos)
    photos, masked = with_masks(photos, masks)
    notes = [*_file_notes(inputs), *masked, *spellings, *_camera_notes(photos, params.focal), *_photo_notes(photos)]
    photos, heightless = _without_false_heights(photos)
    notes += heightless
    if geotags is not None:
        entries, found = match_geotags(geotags, [photo.name for photo in photos], inputs.geotags_name)
        entries, told = _with_heights_in_metres(entries, inputs.geotags_name)
        photos = [
            _tagged(photo, entries.get(photo.name), geotags.is_nadir_zero, inputs.geotags_name) for photo in photos
        ]
        notes += [*found, *told]
    left_out.sort(key=lambda left: left.name)
    return Outputs(photos=tuple(photos), left_out=tuple(left_out), notes=tuple(notes))


def lines(outputs: Outputs, told: Told) -> list[str]:
    """Return what was made, in words."""
    cameras = len({photo.camera for photo in outputs.photos})
    left = f", {many(len(told.left_out), 'file')} left out" if told.left_out else ""
    first = f"{many(len(outputs.photos), 'photo')}, {many(cameras, 'camera')}{left}"
    return [first, *outputs.notes, *grouped(told.left_out)]


def facts(outputs: Outputs, told: Told) -> dict[str, Any]:
    """Return nothing of its own: what is left out stands in the summary for all stages."""
    return {}


_RAW_CURE = "is a RAW or HEIC file, which is not read; develop or convert it to JPEG or TIFF with its tags."


def _suffix(file: PhotoFile) -> str:
    return PurePosixPath(file.name).suffix.lower()


def _counted(files: list[PhotoFile]) -> str:
    """Return how many files there are of each kind: `3 files: 2 .txt, 1 .srt`."""
    counts = Counter(_suffix(file) or "without a suffix" for file in files)
    kinds = ", ".join(f"{count} {kind}" for kind, count in sorted(counts.items()))
    return f"{len(files)} file{'' if len(files) == 1 else 's'}" + (f": {kinds}" if files else "")


def _file_notes(inputs: Inputs) -> list[str]:
    known = (*IMAGE_SUFFIXES, *RAW_SUFFIXES)
    others = [file for file in inputs.files if _suffix(file) not in known and file.name not in inputs.own_lists]
    notes = [f"Files that are no photos are passed over, {_counted(others)}."] if others else []
    lists = [file.name for file in others if PurePosixPath(file.name).name.lower() in FOUND_LISTS.values()]
    if inputs.is_geotags_found:
        notes.append(f"{inputs.geotags_name} was found among the photos (--geotags names another list, or none).")
    if lists:
        notes.append(
            f"Lists below the folder, or beside one that was given, are not used: {', '.join(lists)}; give them with "
            "--geotags or --gcp."
        )
    return notes


def _camera_notes(photos: list[Photo], focal_px: float | None) -> list[str]:
    counts = Counter(photo.camera for photo in photos)
    if len(counts) == 1:
        return []
    ordered = sorted(counts.items(), key=lambda item: (-item[1], item[0]))
    cameras = "; ".join(f"{name}: {count}" for name, count in sorted(ordered[:_SHOWN_CAMERAS]))
    more = len(counts) - _SHOWN_CAMERAS
    cameras += f"; and {more} more" if more > 0 else ""
    notes = [f"{len(counts)} cameras, each with its own intrinsics. Photos of each: {cameras}."]
    if focal_px is not None:
        notes.append(f"The given focal length, {focal_px:g} px, is used for all of them.")
    return notes


def _photo_notes(photos: list[Photo]) -> list[str]:
    """Return what was odd about photos, each finding once with the photos that it concerns."""
    names: dict[str, list[str]] = {}
    for entry in with_ranges([LeftOut(name=photo.name, reason=note) for photo in photos for note in photo.notes]):
        names.setdefault(entry.reason, []).append(entry.name)
    notes = [f"{some_photos(found)}: {note}" for note, found in sorted(names.items(), key=lambda item: -len(item[1]))]
    if len(notes) > _MOST_NOTES:
        more = len(notes) - _MOST_NOTES
        return [
            *notes[:_MOST_NOTES],
            f"{more} more findings, each of as many photos or fewer, stand in the photos' notes.",
        ]
    return notes


def _without_false_heights(photos: list[Photo]) -> tuple[list[Photo], list[str]]:
    """Return photos without the heights in their tags that are none, such as -9999, or 0 among others; and notes."""
    rows = [k for k, photo in enumerate(photos) if photo.position is not None and photo.position.z_m is not None]
    positions = [position for photo in photos if (position := photo.position) is not None and position.z_m is not None]
    z, notes = without_fillers(
        [position.z_m for position in positions], [photos[k].name for k in rows], "Tags", kind="photo",
        so="; only their horizontal position is used", cure=" If 0 was measured, give the heights in a geo.txt.",
    )  # fmt: skip
    changed = list(photos)
    for k, position, z_m in zip(rows, positions, z, strict=True):
        if z_m is None:
            flat = dataclasses.replace(position, z_m=None, height_kind="unknown")
            changed[k] = dataclasses.replace(photos[k], position=flat)
    return changed, notes


def _with_heights_in_metres(entries: dict[str, Geotag], name: str) -> tuple[dict[str, Geotag], list[str]]:
    """Return entries whose heights are metres, and notes on the unit that they were in."""
    from jaxba import geo  # loads pyproj

    changed, notes = dict(entries), []
    for crs in sorted({entry.position.crs for entry in entries.values()}):
        rows = [k for k, entry in entries.items() if entry.position.crs == crs and entry.position.z_m is not None]
        z = np.array([entries[k].position.z_m for k in rows], float)
        height_m, _, found = geo.list_heights(crs, z, name)
        notes += found
        for k, value in zip(rows, height_m, strict=True):
            position = dataclasses.replace(entries[k].position, z_m=float(value))
            changed[k] = dataclasses.replace(entries[k], position=position)
    return changed, notes


def _tagged(photo: Photo, entry: Geotag | None, is_nadir_zero: bool, name: str) -> Photo:
    if entry is None:
        return photo
    relative_m = photo.position.relative_altitude_m if photo.position else None
    attitude, angles = photo.attitude, entry.yaw_pitch_roll_deg
    if angles is not None and is_nadir_zero:
        attitude = attitude_from_nadir_body(*angles)
    elif angles is not None:
        attitude = Attitude(yaw_deg=angles[0], pitch_deg=angles[1], roll_deg=angles[2])
    position = dataclasses.replace(entry.position, relative_altitude_m=relative_m, list_name=name)
    return dataclasses.replace(photo, position=position, tag_position=photo.position, attitude=attitude)
