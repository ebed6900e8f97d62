"""Lists that replace the positions (and attitudes) in photos' tags: OpenDroneMap's geo.txt, or CSV with a header line.

geo.txt, by blanks or tabs; all after `y` may be missing:

    EPSG:4326                     (or a PROJ string, or `WGS84 UTM 17N`)
    image x y [z] [yaw pitch roll] [horizontal_accuracy vertical_accuracy] [anything]

x is the easting or longitude whatever the CRS's own axis order; angles are degrees, and three zeros mean that they are
not known (OpenDroneMap's documentation). Accuracies are sigmas in metres; 0 means not known. NaN stands for what is
not known, a height too.

CSV: columns by name in any order (`name`, `latitude`, `longitude`, `altitude`, `yaw`, ... and common variants). `x` and
`y` need a `crs` column or a comment such as `# EPSG:32615` above the header; latitude and longitude are EPSG:4326
without one. The header may be a comment itself, so that the reference CSV that Metashape exports is read.

Neither format says what pitch 0 is. It is 0 at nadir for OpenDroneMap and Pix4D and -90 at nadir for a drone's gimbal;
a list whose median pitch is under -30 degrees is taken for a gimbal's, since the camera would look backwards in the
other reading.
"""

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass
from statistics import median

from jaxba._errors import JaxbaError
from jaxba.io._list_cells import no_photos, read_height, read_if_known, read_number, split_image, without_fillers
from jaxba.io._list_text import (
    PLACE_COLUMNS,
    Line,
    Table,
    columns_by_name,
    content_lines,
    csv_rows,
    find_table,
    read_crs,
    refuse_degrees_out_of_range,
)
from jaxba.scene import HeightKind, Position

_COLUMNS = {
    **PLACE_COLUMNS,
    "name": (
        "name", "image", "imagename", "image_name", "filename", "file_name", "file", "photo", "label", "sourcefile",
    ),
    "ellipsoidal": ("ellipsoidal_height", "height_ellipsoidal", "ellipsoid_height"),
    "yaw": ("yaw", "heading"),
    "pitch": ("pitch",),
    "roll": ("roll",),
}  # fmt: skip
_WIDTHS = (3, 4, 7, 9)  # columns of a line of geo.txt; a label may follow the last
_GIMBAL_PITCH_DEG = -30.0


@dataclass(frozen=True, kw_only=True)
class Geotag:
    """An entry of a list.

    - `name`: of the photo, as the list writes it. `line`: where it stands.
    - `position`: its `z_m` is as written, in the unit of the list's CRS.
    - `yaw_pitch_roll_deg`: as written, None where not known; `Geotags.is_nadir_zero` says what pitch 0 is.
    """

    name: str
    line: int
    position: Position
    yaw_pitch_roll_deg: tuple[float, float, float] | None = None


@dataclass(frozen=True, kw_only=True)
class Geotags:
    """- `is_nadir_zero`: pitch is 0 for a camera that looks down, else -90. `notes`: what was assumed."""

    entries: tuple[Geotag, ...]
    is_nadir_zero: bool = True
    notes: tuple[str, ...] = ()


def parse_geotags(text: str, name: str = "geo.txt", is_photo: Callable[[str], bool] = no_photos) -> Geotags:
    """Return the entries of a geo.txt or CSV.

    - `name`: of the file, for messages. `is_photo`: tells the names of photos, which may have blanks in them.

    Raises `JaxbaError` with file, line and value for what cannot be read, and for a photo that is listed twice.

    >>> parse_geotags("EPSG:4326\\nDJI_0028.JPG -91.9942 46.8425 198.6").entries[0].position.z_m
    198.6
    """
    content, comments = content_lines(text)
    if not content:
        raise JaxbaError(f"{name}: is empty; give a CRS line and a line a photo, or a CSV with a header line.")
    table = find_table(content, comments, _COLUMNS)
    entries, notes = (_read_geo(content, name, is_photo), []) if table is None else _read_csv(table, name)
    seen: dict[str, int] = {}
    for entry in entries:
        if entry.name in seen:
            raise JaxbaError(
                f"{name} line {entry.line}: {entry.name} is on line {seen[entry.name]} already; keep one of them."
            )
        seen[entry.name] = entry.line
    if not entries:
        raise JaxbaError(f"{name}: lists no photo; give a line a photo below the first, or leave the file away.")
    z, found = without_fillers(
        [entry.position.z_m for entry in entries], [entry.name for entry in entries], name, kind="photo",
        cure=" Where 0 was measured, write 0.001.",
    )  # fmt: skip
    kept = zip(entries, z, strict=True)
    entries = [entry if z_m is not None else _without_height(entry) for entry, z_m in kept]
    return _with_convention(entries, [*notes, *found], name)


def _without_height(entry: Geotag) -> Geotag:
    position = dataclasses.replace(entry.position, z_m=None, height_kind="unknown")
    return dataclasses.replace(entry, position=position)


def _with_convention(entries: list[Geotag], notes: list[str], name: str) -> Geotags:
    pitches = [entry.yaw_pitch_roll_deg[1] for entry in entries if entry.yaw_pitch_roll_deg]
    is_nadir_zero = not pitches or median(pitches) > _GIMBAL_PITCH_DEG
    if pitches:
        meaning = "0 looks down" if is_nadir_zero else "-90 looks down, as a gimbal counts"
        notes = [*notes, f"{name}: pitch (median {median(pitches):g} degrees) is read so that {meaning}."]
    return Geotags(entries=tuple(entries), is_nadir_zero=is_nadir_zero, notes=tuple(notes))


def _read_geo(content: list[Line], name: str, is_photo: Callable[[str], bool]) -> list[Geotag]:
    crs, kind = read_crs(content[0][1], f"{name} line {content[0][0]}")
    entries = []
    for line, words in content[1:]:
        image, rest = split_image(words, is_photo)
        cells = _cells(rest.strip())
        where = f"{name} line {line}"
        count = 1 + len(cells)
        if count < 3:
            is_csv = max(map(words.count, ",;")) >= 2
            cure = " Separate columns by blanks, or name them in a header line." if is_csv else ""
            found = "1 column" if count == 1 else f"{count} columns"
            raise JaxbaError(f"{where}: '{words}' has {found}; give image x y, then z and more if known.{cure}")
        x, y = (read_number(cell, where, label) for cell, label in zip(cells, "xy", strict=False))
        # what follows a full set of columns is a label; a set that is not full must not be taken for one
        if count not in _WIDTHS and count < _WIDTHS[-1]:
            raise JaxbaError(
                f"{where}: has {count} columns; give 3 (image x y), 4 (and z), 7 (and yaw pitch roll) or 9 (and "
                "horizontal and vertical accuracy)."
            )
        z_m = read_height(cells[2], where) if count > 3 else None
        names = ("yaw", "pitch", "roll", "horizontal accuracy", "vertical accuracy")
        numbers = [read_if_known(cell, where, label) for cell, label in zip(cells[3:], names, strict=False)]
        numbers += [None] * (5 - len(numbers))
        entries.append(_entry(image, line, where, crs, kind, x, y, z_m, numbers[:3], numbers[3:]))
    return entries


def _cells(rest: str) -> list[str]:
    """Return the columns behind the image; those between tabs may be empty, unless tabs only pad them."""
    cells = [cell.strip() for cell in rest.split("\t")]
    is_table = len(cells) >= 2 and all(cells[:2]) and (1 + len(cells) in _WIDTHS or len(cells) >= _WIDTHS[-1])
    return cells if is_table and not any(" " in cell for cell in cells[:8]) else rest.split()


def _read_csv(table: Table, name: str) -> tuple[list[Geotag], list[str]]:
    place, unused = columns_by_name(table.header, _COLUMNS)
    notes = [f"{name}: columns that are not used: {', '.join(unused)}."] if any(unused) else []
    is_geographic = "latitude" in place and "longitude" in place
    if "name" not in place or not (is_geographic or ("x" in place and "y" in place)):
        raise JaxbaError(
            f"{name} line {table.line}: columns {', '.join(table.header)} hold no position of photos; name them name, "
            "and latitude and longitude, or x and y with a crs column."
        )
    if not is_geographic and "crs" not in place and table.crs is None:
        raise JaxbaError(f"{name}: x and y need a CRS; add a crs column, or a first line such as '# EPSG:32615'.")
    if "std" in place:
        title = table.header[place["std"]]
        notes.append(f"{name}: {title} is taken for the horizontal and the vertical sigma, metres.")
    empty = []
    known: dict[str, tuple[str, HeightKind]] = {}
    entries = []
    for line, cell in csv_rows(table, place, name):
        where = f"{name} line {line}"

        def value(column: str, where: str = where, cell=cell) -> float | None:
            return read_if_known(cell(column), where, column)

        text = cell("crs") or table.crs or ("EPSG:4326" if is_geographic else "")
        if text not in known:
            known[text] = read_crs(text, where)
        crs, kind = known[text]
        x, y = (value("longitude"), value("latitude")) if is_geographic else (value("x"), value("y"))
        if cell("name") and x is None and y is None:
            empty.append(cell("name"))
            continue
        if not cell("name") or x is None or y is None:
            raise JaxbaError(f"{where}: name or position is empty; fill it in, or delete the line.")
        z_m = read_height(cell("z"), where)
        if z_m is None and (z_m := read_height(cell("ellipsoidal"), where)) is not None:
            kind = "ellipsoidal"
        angles = [value("yaw"), value("pitch"), value("roll")]
        accuracies = [value("std_h") or value("std"), value("std_v") or value("std")]
        entries.append(_entry(cell("name"), line, where, crs, kind, x, y, z_m, angles, accuracies))
    if empty:
        notes.append(f"{name}: rows without a position are passed over: {', '.join(empty)}.")
    return entries, notes


def _entry(
    name: str,
    line: int,
    where: str,
    crs: str,
    kind: HeightKind,
    x: float,
    y: float,
    z_m: float | None,
    angles: list[float | None],
    accuracies: list[float | None],
) -> Geotag:
    refuse_degrees_out_of_range(crs, x, y, where)
    for label, value in zip(("horizontal", "vertical"), accuracies, strict=True):
        if value is not None and value < 0:
            raise JaxbaError(f"{where}: {label} accuracy {value:g} is negative; give a sigma in metres, 0 if unknown.")
    known = [angle for angle in angles if angle is not None]
    is_known = len(known) == 3 and any(known)
    return Geotag(
        name=name,
        line=line,
        position=Position(
            crs=crs,
            x=x,
            y=y,
            z_m=z_m,
            height_kind=kind if z_m is not None else "unknown",
            std_h_m=accuracies[0] or None,
            std_v_m=accuracies[1] or None,
            source=where,
        ),
        yaw_pitch_roll_deg=(known[0], known[1], known[2]) if is_known else None,
    )
