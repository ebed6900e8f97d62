"""Marks of control points on the photos' own pixel grid; what cannot be used is named.

Marks are often set in the original photos, and the photos shrunk afterwards. That shows by marks beyond the photos'
edges. They are scaled by a factor that something states: `control.mark_width_px`, or the size that EXIF keeps from
before; without one they are refused. Where no more than a tenth lies outside, these are mistakes and left out.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxba._errors import JaxbaError
from jaxba.io import Mark, SurveyedPoint, like_photo, photo_finder
from jaxba.scene import LeftOut, Photo

_OUTSIDE = 0.1  # of all marks: more of them outside are no single mistakes
_SAME_FORMAT = 0.02  # the format, width over height, of a photo that was only scaled
_ONE_PIXEL = 2.0  # px: as near to each other are marks of one target
_SHOWN = 3


@dataclass(frozen=True, kw_only=True, eq=False)
class PhotoMarks:
    """Marks in photos that are there, by point, on the photos' pixel grid; what was left out, and notes."""

    point: Int[np.ndarray, " marks"]
    image: Int[np.ndarray, " marks"]
    xy_px: Float[np.ndarray, "marks 2"]
    left_out: tuple[LeftOut, ...]
    notes: tuple[str, ...]


def marks_in_photos(
    points: Sequence[SurveyedPoint], photos: Sequence[Photo], mark_width_px: int | None, name: str
) -> PhotoMarks:
    """Return the marks of points in photos.

    - `mark_width_px`: of the photos that marks were set in. `name`: of the list, for messages.

    Raises `JaxbaError` where no photo of the list is there, a point is marked twice in a photo, and where marks lie
    outside their photos and nothing tells the scale.
    """
    names = [photo.name for photo in photos]
    find = photo_finder(names)
    index = {photo.name: k for k, photo in enumerate(photos)}
    point, image, marks = [], [], []
    unknown: dict[str, list[str]] = {}
    seen: dict[tuple[int, int], Mark] = {}
    for row, surveyed in enumerate(points):
        for mark in surveyed.marks:
            found = find(mark.image, mark.source)
            if found is None:
                unknown.setdefault(mark.image, []).append(surveyed.name)
                continue
            before = seen.setdefault((row, index[found]), mark)
            if before is not mark:
                raise JaxbaError(
                    f"{mark.source}: {surveyed.name} is marked in {found} twice, at {mark.x_px:g} {mark.y_px:g} here "
                    f"and {before.x_px:g} {before.y_px:g} in {before.source}; keep one of the two."
                )
            point.append(row)
            image.append(index[found])
            marks.append(mark)
    if not marks:
        said = [image + like_photo(image, names) for image in list(unknown)[:_SHOWN]]
        raise JaxbaError(
            f"{name} marks none of the photos: it names {', '.join(said)}, the folder holds "
            f"{', '.join(names[:_SHOWN])}; write the names as in the folder, or leave the list away."
        )
    left = [
        LeftOut(
            name=image,
            reason=f"is marked ({', '.join(marked)}), but is none of the photos that can be used"
            + like_photo(image, names),
        )
        for image, marked in unknown.items()
    ]
    xy_px = np.array([[mark.x_px, mark.y_px] for mark in marks])
    size_px = np.array([[photos[k].width_px, photos[k].height_px] for k in image], float)
    xy_px, notes = _scaled(xy_px, size_px, [photos[k] for k in image], mark_width_px, name)
    outside = _outside(xy_px, size_px)
    for k in np.flatnonzero(outside):
        photo = photos[image[k]]
        left.append(
            LeftOut(
                name=f"{points[point[k]].name} in {photo.name}",
                reason=f"the mark {marks[k].x_px:g} {marks[k].y_px:g} ({marks[k].source}) lies outside the photo of "
                f"{photo.width_px} x {photo.height_px} pixels",
            )
        )
    keep = ~outside
    notes += _same_pixel(points, photos, np.array(point), np.array(image), xy_px)
    return PhotoMarks(
        point=np.array(point, np.int64)[keep], image=np.array(image, np.int64)[keep], xy_px=xy_px[keep],
        left_out=tuple(left), notes=tuple(notes),
    )  # fmt: skip


def _same_pixel(
    points: Sequence[SurveyedPoint],
    photos: Sequence[Photo],
    point: Int[np.ndarray, " marks"],
    image: Int[np.ndarray, " marks"],
    xy_px: Float[np.ndarray, "marks 2"],
) -> list[str]:
    """Return notes on pairs of points that lie apart and are marked at one pixel of a photo: one has the wrong name."""
    found = []
    for k in range(len(point)):
        near = np.flatnonzero((image == image[k]) & (np.hypot(*(xy_px - xy_px[k]).T) < _ONE_PIXEL))
        for other in near[near > k].tolist():
            one, two = points[int(point[k])], points[int(point[other])]
            if (one.x, one.y) != (two.x, two.y):
                found.append(
                    f"{one.name} and {two.name} are marked at one pixel of {photos[int(image[k])].name} and lie "
                    "apart: one of the marks is wrong."
                )
    return found


def _outside(xy_px: Float[np.ndarray, "marks 2"], size_px: Float[np.ndarray, "marks 2"]) -> Bool[np.ndarray, " marks"]:
    return np.any((xy_px < 0) | (xy_px > size_px), axis=1)


def _scaled(
    xy_px: Float[np.ndarray, "marks 2"],
    size_px: Float[np.ndarray, "marks 2"],
    photos: Sequence[Photo],
    mark_width_px: int | None,
    name: str,
) -> tuple[Float[np.ndarray, "marks 2"], list[str]]:
    """Return marks on the photos' own pixel grid, and how they got there; `photos`: of each mark."""
    first = photos[0]
    if mark_width_px is not None:
        factor = size_px[:, :1] / mark_width_px
        note = f"{name}: marks are scaled by {factor[0, 0]:.5f}, from photos {mark_width_px} px wide as given to those "
        return xy_px * factor, [f"{note}of {first.width_px} px (control.mark_width_px)."]
    outside = _outside(xy_px, size_px)
    count, total = int(outside.sum()), len(xy_px)
    original = np.array([photo.original_size_px or (np.nan, np.nan) for photo in photos], float)
    other = np.isfinite(original).all(axis=1) & (np.abs(original / size_px - 1) > 1e-6).any(axis=1)
    if count <= _OUTSIDE * total:
        if not other.any():
            return xy_px, []
        return xy_px, [
            f"{name}: marks are taken on the pixel grid of the files, in which {total - count} of {total} lie, though "
            f"EXIF says that photos were {original[other][0, 0]:.0f} px wide (control.mark_width_px says otherwise)."
        ]
    reach = f"up to {xy_px[:, 0].max():.0f} {xy_px[:, 1].max():.0f}"
    says = (
        f"{name}: {count} of {total} marks lie outside their photos ({reach}; {first.name} has {first.width_px} x "
        f"{first.height_px} pixels)"
    )
    shape = original[:, 0] / original[:, 1] * size_px[:, 1] / size_px[:, 0]
    scaled = xy_px * size_px / original
    still = int(_outside(scaled, size_px).sum())
    if not (other & (np.abs(shape - 1) < _SAME_FORMAT)).all():
        why = "EXIF does not tell an original size of the same format"
    elif still > _OUTSIDE * total:
        why = f"by EXIF's original width of {original[0, 0]:.0f} px {still} would still be outside"
    else:
        return scaled, [
            f"{says}, so they were set in the original photos: they are scaled by "
            f"{size_px[0, 0] / original[0, 0]:.5f}, from EXIF's {original[0, 0]:.0f} x {original[0, 1]:.0f} to "
            f"{first.width_px} x {first.height_px} pixels."
        ]
    raise JaxbaError(
        f"{says}, and {why}, so their scale is not known. Give the width of the photos that they were set in, such as "
        "--set control.mark_width_px=4272, or correct the marks."
    )
