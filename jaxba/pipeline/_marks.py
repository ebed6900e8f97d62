"""Marks of control points on the photos' own pixel grid as it is stored; what cannot be used is named.

Marks are often set in the original photos, and the photos shrunk afterwards. That shows by marks beyond the photos'
edges. They are scaled by a factor that something states: `control.mark_width_px`, or the size that EXIF keeps from
before; without one they are refused. Where no more than a tenth lies outside, these are mistakes and left out.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxba._errors import JaxbaError
from jaxba.io import Mark, SurveyedPoint, like_photo, photo_finder
from jaxba.pipeline._mark_turn import TURNS, best_turn, on_stored_grid, other_size, shown_size
from jaxba.scene import LeftOut, Photo

Expected = Callable[[Int[np.ndarray, " marks"], Int[np.ndarray, " marks"]], Float[np.ndarray, "marks 2"]]
"""Returns where points, by their row, are roughly seen in images; NaN where that is unknown."""
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


@dataclass(frozen=True, kw_only=True, eq=False)
class _Given:
    """Marks as a list gives them.

    - `photos`: of each mark. `size_px`: width and height of these as stored. `mark_width_px`: of those in which marks
      were set, None where nobody says it. `name`: of the list.
    """

    xy_px: Float[np.ndarray, "marks 2"]
    photos: Sequence[Photo]
    mark_width_px: int | None
    name: str

    @property
    def size_px(self) -> Float[np.ndarray, "marks 2"]:
        return np.array([[photo.width_px, photo.height_px] for photo in self.photos], float)

    @property
    def orientation(self) -> Int[np.ndarray, " marks"]:
        """Of the photos, by EXIF."""
        return np.array([photo.orientation for photo in self.photos])


def marks_in_photos(
    points: Sequence[SurveyedPoint],
    photos: Sequence[Photo],
    mark_width_px: int | None,
    name: str,
    *,
    orientation: str = "auto",
    expected: Expected | None = None,
) -> PhotoMarks:
    """Return the marks of points in photos.

    - `mark_width_px`: of the photos that marks were set in. `name`: of the list, for messages.
    - `orientation`: under which they were shown then: `stored`, `exif`, or one for all, `2` to `8`; `auto` takes them
      for set on the stored grid, and refuses marks that another orientation fits. `expected`: where points are seen.

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
    given = _Given(
        xy_px=np.array([[mark.x_px, mark.y_px] for mark in marks]),
        photos=[photos[k] for k in image],
        mark_width_px=mark_width_px,
        name=name,
    )
    own, notes = given.orientation, []
    seen_px = None if expected is None else expected(np.array(point), np.array(image))
    if orientation == "auto":
        notes = _refuse_turned(given, seen_px)
    turn = own if orientation == "exif" else np.full(len(own), int(orientation) if orientation.isdigit() else 1)
    if orientation not in ("auto", "stored"):
        how = "each photo's EXIF orientation" if orientation == "exif" else f"orientation {orientation}"
        notes.append(f"{name}: marks are turned back by {how} (control.mark_orientation={orientation}).")
    xy_px, scaled = _on_grid(given, turn)
    notes += scaled
    if orientation == "auto" and np.array_equal(xy_px, on_stored_grid(given.xy_px, given.size_px, turn)):
        _refuse_other_size(given, xy_px, seen_px)
    outside = _outside(xy_px, given.size_px)
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


def _on_grid(given: _Given, turn: Int[np.ndarray, " marks"]) -> tuple[Float[np.ndarray, "marks 2"], list[str]]:
    """Return marks that were set in photos shown under orientations, scaled, on the stored grid, and notes."""
    scaled, notes = _scaled(given, turn)
    return on_stored_grid(scaled, given.size_px, turn), notes


def _refuse_turned(given: _Given, expected_px: Float[np.ndarray, "marks 2"] | None) -> list[str]:
    """Refuse marks that fit on turned photos alone; return notes on photos that viewers turn."""

    def placed(turn: Int[np.ndarray, " marks"]) -> Float[np.ndarray, "marks 2"] | None:
        try:
            return _on_grid(given, turn)[0]
        except JaxbaError:  # they lie outside
            return None

    name, photos = given.name, given.photos
    best, away_px = best_turn(placed, given.orientation, expected_px, float(given.size_px.max()))
    turned = sorted({photo.name for photo in photos if photo.orientation > 1})
    are = f"{len(turned)} marked photos have an EXIF orientation other than 1"
    if turned:
        first = next(photo for photo in photos if photo.orientation > 1)
        are += f" ({first.name}: {first.orientation}, {TURNS[first.orientation]} by viewers)"
    if best == "stored":
        return [f"{name}: {are}; marks count on the stored pixel grid."] if turned else []
    how = "as their EXIF orientation says" if best == "exif" else f"as by EXIF orientation {best}, {TURNS[int(best)]}"
    off = f", {away_px[best]:.0f} px from where positions and attitudes see the points (median)" if away_px else ""
    text = (
        f"{name}: marks count on the photos' stored pixel grid, on which these do not fit. They fit if they were set "
        f"in photos that were turned {how}{off}"
        + (f"; unturned, {away_px['stored']:.0f} px" if "stored" in away_px else "; unturned, they lie outside")
    )
    cure = (
        f"Set control.mark_orientation={best} to turn them back, or control.mark_orientation=stored to take them as "
        "they are."
    )
    if not turned and "stored" in away_px:  # a yaw that is off by half a turn looks the same
        return [f"{text}. They are taken as they are; the attitudes may be wrong instead. {cure}"]
    raise JaxbaError(f"{text}.{f' {are}.' if turned else ''} {cure}")


def _refuse_other_size(
    given: _Given, xy_px: Float[np.ndarray, "marks 2"], expected_px: Float[np.ndarray, "marks 2"] | None
) -> None:
    """Refuse marks on the photos' grid that fit photos of another size, such as the previews of a viewer, alone."""
    found = None if expected_px is None else other_size(xy_px, expected_px, float(given.size_px.max()))
    if found is None:
        return
    factor, away_px, unscaled_px = found
    width = given.size_px[0, 0]
    raise JaxbaError(
        f"{given.name}: marks count on the photos' pixel grid, {width:.0f} px wide, and there they lie "
        f"{unscaled_px:.0f} px from where positions and attitudes see the points (median); set in photos of some "
        f"{width / factor:.0f} px width they would lie {away_px:.0f} px from there. Give the width of the photos that "
        f"they were set in, such as --set control.mark_width_px={width / factor:.0f}, or take them as they are "
        "(control.mark_orientation=stored)."
    )


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


def _scaled(given: _Given, turn: Int[np.ndarray, " marks"]) -> tuple[Float[np.ndarray, "marks 2"], list[str]]:
    """Return marks on the pixels of the photos as shown under the orientations `turn`, and how they got there."""
    xy_px, name, mark_width_px = given.xy_px, given.name, given.mark_width_px
    size_px = shown_size(given.size_px, turn)
    first = given.photos[0]
    width, height = size_px[0].astype(int)
    if mark_width_px is not None:
        factor = size_px[:, :1] / mark_width_px
        note = f"{name}: marks are scaled by {factor[0, 0]:.5f}, from photos {mark_width_px} px wide as given to those "
        return xy_px * factor, [f"{note}of {width} px (control.mark_width_px)."]
    outside = _outside(xy_px, size_px)
    count, total = int(outside.sum()), len(xy_px)
    original = np.array([photo.original_size_px or (np.nan, np.nan) for photo in given.photos], float)
    original = shown_size(original, turn)
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
        f"{name}: {count} of {total} marks lie outside their photos ({reach}; {first.name} has {width} x {height} "
        "pixels)"
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
            f"{width} x {height} pixels."
        ]
    raise JaxbaError(
        f"{says}, and {why}, so their scale is not known. Give the width of the photos that they were set in, such as "
        "--set control.mark_width_px=4272, or correct the marks."
    )
