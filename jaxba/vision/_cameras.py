"""Which photos were taken by one camera: the same body, lens, band, zoom and size, so that they share intrinsics.

What tells cameras apart in words is compared without regard to case, blanks, kinds of dashes and zeros behind the
point: `5.0-25.0 mm` and `5.0 - 25 mm` are one lens. What tells zooms apart in numbers is compared to within its
rounding, so that a fixed lens whose tags jitter (8.8 and 8.79 mm) stays one camera:

| number | one camera up to | why |
| --- | --- | --- |
| focal length, mm | 1% | tags hold one or two decimals |
| digital zoom ratio | 1% | |
| 35 mm equivalent | 5% | whole millimetres |
| focal length, px | 20% | two tags of one lens differ by less, or the photo is refused |
"""

import re
from collections import Counter, defaultdict
from collections.abc import Callable, Sequence
from dataclasses import replace

from jaxba.scene import Lens, Photo
from jaxba.vision._exif import BASE, Tags, text

_LENS_SERIAL = 0xA435
_DRONE_SERIALS = ("drone-dji:DroneSerialNumber", "drone-parrot:SerialNumber", "drone:DroneSerialNumber")
_DASHES = re.compile("[\u2010-\u2015\u2212]")
_ZEROS = re.compile(r"(\d\.\d*?)0+(?!\d)")
_NUMBERS: tuple[tuple[Callable[[Photo], float | None], float, str, bool], ...] = (
    (lambda photo: photo.lens.focal_mm, 0.01, "{:.4g} mm", True),
    (lambda photo: photo.lens.digital_zoom, 0.01, "{:.3g}x digital zoom", True),
    (lambda photo: photo.lens.equivalent_mm, 0.05, "as {:.4g} mm on film", False),
    (lambda photo: photo.focal_px, 0.20, "{:.4g} px", False),
)
"""How to read each number, its tolerance, its words, and whether they are part of every name that has the number."""


def find_lens(tags: Tags, make: str, model: str, focal_mm: float | None) -> Lens:
    """Return what tells a photo's camera from others."""
    name = model if model.lower().startswith(make.lower()) else f"{make} {model}"
    serial = tags.text(BASE.BodySerialNumber) or text(tags.xmp.get("drone-dji:CameraSerialNumber"))
    serial = serial or text(tags.xmp.get("aux:SerialNumber"))
    drone = "" if serial.strip("0") else text(next(filter(None, map(tags.xmp.get, _DRONE_SERIALS)), ""))
    lens = tags.text(BASE.LensModel) or text(tags.xmp.get("aux:Lens"))
    lens_serial = tags.text(_LENS_SERIAL)
    parts = [name.strip() or "unknown camera"]
    if serial.strip("0"):
        parts.append(f"serial {serial}")
    if drone.strip("0"):
        parts.append(f"drone {drone}")
    if lens and _spelled(lens) != _spelled(model):
        parts.append(lens)
    if lens_serial.strip("0"):
        parts.append(f"lens {lens_serial}")
    for words, key in (
        ("", "drone-dji:ImageSource"),  # the wide and the tele camera of one gimbal
        ("band ", "Camera:BandName"),
        ("rig camera ", "Camera:RigCameraIndex"),
    ):
        if value := text(tags.xmp.get(key)):
            parts.append(f"{words}{value}")
    zoom, film_mm = tags.number(BASE.DigitalZoomRatio), tags.number(BASE.FocalLengthIn35mmFilm)
    return Lens(
        body=", ".join(parts),
        focal_mm=focal_mm,
        digital_zoom=zoom if zoom and zoom > 1 else 1.0,
        equivalent_mm=film_mm if film_mm and film_mm > 0 else None,
    )


def camera_name(photo: Photo) -> str:
    """Return the name of a photo's camera, if there were no other photo."""
    return shared_cameras([photo])[0][0].camera


def shared_cameras(photos: Sequence[Photo]) -> tuple[list[Photo], list[str]]:
    """Return photos that have one camera's name where one camera took them, and notes on lenses of two spellings."""
    names: dict[int, str] = {}
    notes = []
    for rows in _grouped(range(len(photos)), lambda k: (_spelled(photos[k].lens.body), _size(photos[k]))):
        bodies = Counter(photos[k].lens.body for k in rows)
        if len(bodies) > 1:
            spellings = " and ".join(f"'{body}' ({count})" for body, count in bodies.most_common())
            notes.append(f"One camera is written in {len(bodies)} ways and counts as one: {spellings}.")
        body, size = bodies.most_common(1)[0][0], "{}x{}".format(*_size(photos[rows[0]]))
        _name(photos, rows, [body], size, names, 0)
    return [replace(photo, camera=names[k]) for k, photo in enumerate(photos)], notes


def _name(photos: Sequence[Photo], rows: list[int], words: list[str], size: str, names: dict[int, str], number: int):
    """Name the photos of one body, told apart by one number after the other."""
    if number == len(_NUMBERS):
        names.update(dict.fromkeys(rows, ", ".join([*words, size])))
        return
    read, tolerance, form, is_always_said = _NUMBERS[number]
    stands_for = _representatives([read(photos[k]) for k in rows], tolerance)
    if number > 0:  # a photo without it is of the commonest; without a focal length in mm, it may be of any lens
        commonest = Counter(value for value in stands_for if value is not None).most_common(1)
        stands_for = [value if value is not None or not commonest else commonest[0][0] for value in stands_for]
    is_said = is_always_said or len(set(stands_for)) > 1
    for alike in _grouped(range(len(rows)), lambda k: stands_for[k]):
        value = stands_for[alike[0]]
        is_none = value is None or (number == 1 and value == 1)
        more = [form.format(value)] if is_said and not is_none else []
        _name(photos, [rows[k] for k in alike], [*words, *more], size, names, number + 1)


def _representatives(values: Sequence[float | None], tolerance: float) -> list[float | None]:
    """Return for each value the commonest of those that are equal to within a tolerance; None for none."""
    stands_for: dict[float | None, float | None] = {None: None}
    counts = Counter(value for value in values if value is not None)
    rising = sorted(counts)
    while rising:
        alike = [value for value in rising if value <= rising[0] * (1 + tolerance)]
        stands_for |= dict.fromkeys(alike, max(alike, key=lambda value: (counts[value], -value)))
        rising = rising[len(alike) :]
    return [stands_for[value] for value in values]


def _grouped(rows: Sequence[int], key: Callable[[int], object]) -> list[list[int]]:
    groups: dict[object, list[int]] = defaultdict(list)
    for row in rows:
        groups[key(row)].append(row)
    return list(groups.values())


def _spelled(words: str) -> str:
    r"""Return words without what is spelled in several ways.

    >>> _spelled("5.0 \u2013 25.0 mm") == _spelled("5-25.00MM"), _spelled("f/2.80") == _spelled("f/2.08")
    (True, False)
    """
    plain = _DASHES.sub("-", "".join(words.casefold().split()))
    return re.sub(r"\.(?!\d)", "", _ZEROS.sub(r"\1", plain))


def _size(photo: Photo) -> tuple[int, int]:
    return photo.width_px, photo.height_px
