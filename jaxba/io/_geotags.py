"""Lists that replace the positions (and attitudes) in photos' tags: OpenDroneMap's geo.txt, or CSV with a header line.

geo.txt, by blanks or tabs; all after `y` may be missing:

    EPSG:4326                     (or a PROJ string, or `WGS84 UTM 17N`)
    image x y [z] [yaw pitch roll] [horizontal_accuracy vertical_accuracy] [anything]

x is the easting or longitude whatever the CRS's own axis order; angles are degrees, and three zeros mean that they are
not known (OpenDroneMap's documentation). Accuracies are sigmas in metres; 0 means not known.

CSV: columns by name in any order (`name`, `latitude`, `longitude`, `altitude`, `yaw`, ... and common variants). `x` and
`y` need a `crs` column or a comment such as `# EPSG:32615` on the first line; latitude and longitude are EPSG:4326
without one.

Neither format says what pitch 0 is. It is 0 at nadir for OpenDroneMap and Pix4D and -90 at nadir for a drone's gimbal;
a list whose median pitch is under -30 degrees is taken for a gimbal's, since the camera would look backwards in the
other reading.
"""

from dataclasses import dataclass
from statistics import median

from jaxba._errors import JaxbaError
from jaxba.io._list_text import (
    PLACE_COLUMNS,
    Line,
    columns_by_name,
    content_lines,
    crs_of_comment,
    csv_rows,
    header_titles,
    read_crs,
    read_number,
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


def parse_geotags(text: str, name: str = "geo.txt") -> Geotags:
    """Return the entries of a geo.txt or CSV.

    - `name`: of the file, for messages.

    Raises `JaxbaError` with file, line and value for what cannot be read, and for a photo that is listed twice.

    >>> parse_geotags("EPSG:4326\\nDJI_0028.JPG -91.9942 46.8425 198.6").entries[0].position.z_m
    198.6
    """
    content, comment = content_lines(text)
    if not content:
        raise JaxbaError(f"{name}: is empty; give a CRS line and a line a photo, or a CSV with a header line.")
    header = header_titles(content[0][1], _COLUMNS["name"])
    if header is not None:
        entries, notes = _read_csv(content, header, crs_of_comment(comment), name)
    else:
        entries, notes = _read_geo(content, name), []
    seen: dict[str, int] = {}
    for entry in entries:
        if entry.name in seen:
            raise JaxbaError(
                f"{name} line {entry.line}: {entry.name} is on line {seen[entry.name]} already; keep one of them."
            )
        seen[entry.name] = entry.line
    if not entries:
        raise JaxbaError(f"{name}: lists no photo; give a line a photo below the first, or leave the file away.")
    return _with_convention(entries, notes, name)


def _with_convention(entries: list[Geotag], notes: list[str], name: str) -> Geotags:
    pitches = [entry.yaw_pitch_roll_deg[1] for entry in entries if entry.yaw_pitch_roll_deg]
    is_nadir_zero = not pitches or median(pitches) > _GIMBAL_PITCH_DEG
    if pitches:
        meaning = "0 looks down" if is_nadir_zero else "-90 looks down, as a gimbal counts"
        notes = [*notes, f"{name}: pitch (median {median(pitches):g} degrees) is read so that {meaning}."]
    return Geotags(entries=tuple(entries), is_nadir_zero=is_nadir_zero, notes=tuple(notes))


def _read_geo(content: list[Line], name: str) -> list[Geotag]:
    crs, kind = read_crs(content[0][1], f"{name} line {content[0][0]}")
    entries = []
    for line, words in content[1:]:
        cells = words.split("\t") if words.count("\t") >= 2 else words.split()
        where = f"{name} line {line}"
        if len(cells) < 3:
            raise JaxbaError(f"{where}: '{words}' has {len(cells)} columns; give image x y, then z and more if known.")
        x, y = (read_number(cells[k], where, "xy"[k - 1]) for k in (1, 2))
        # what follows a full set of columns is a label; a set that is not full must not be taken for one
        count = max(k for k in (3, 4, 7, 9) if k <= len(cells))
        if len(cells) not in (3, 4, 7, 9) and len(cells) < 9:
            raise JaxbaError(
                f"{where}: has {len(cells)} columns; give 3 (image x y), 4 (and z), 7 (and yaw pitch roll) or 9 (and "
                "horizontal and vertical accuracy)."
            )
        names = ("z", "yaw", "pitch", "roll", "horizontal accuracy", "vertical accuracy")[: count - 3]
        numbers = [read_number(cells[3 + k], where, label) for k, label in enumerate(names)]
        numbers += [None] * (6 - len(numbers))
        entries.append(_entry(cells[0], line, where, crs, kind, x, y, numbers[0], numbers[1:4], numbers[4:6]))
    return entries


def _read_csv(
    content: list[Line], header: list[str], comment_crs: str | None, name: str
) -> tuple[list[Geotag], list[str]]:
    place, unused = columns_by_name(header, _COLUMNS)
    notes = [f"{name}: columns that are not used: {', '.join(unused)}."] if any(unused) else []
    is_geographic = "latitude" in place and "longitude" in place
    if not is_geographic and not ("x" in place and "y" in place):
        raise JaxbaError(
            f"{name} line {content[0][0]}: columns {', '.join(header)} hold no position; name them latitude and "
            "longitude, or x and y with a crs column."
        )
    if not is_geographic and "crs" not in place and comment_crs is None:
        raise JaxbaError(f"{name}: x and y need a CRS; add a crs column, or a first line such as '# EPSG:32615'.")
    known: dict[str, tuple[str, HeightKind]] = {}
    entries = []
    for line, cell in csv_rows(content[1:], header, place, name):
        where = f"{name} line {line}"

        def value(column: str, where: str = where, cell=cell) -> float | None:
            return read_number(cell(column), where, column) if cell(column) else None

        text = cell("crs") or comment_crs or ("EPSG:4326" if is_geographic else "")
        if text not in known:
            known[text] = read_crs(text, where)
        crs, kind = known[text]
        x, y = (value("longitude"), value("latitude")) if is_geographic else (value("x"), value("y"))
        if not cell("name") or x is None or y is None:
            raise JaxbaError(f"{where}: name or position is empty; fill it in, or delete the line.")
        z_m = value("z")
        if z_m is None and (z_m := value("ellipsoidal")) is not None:
            kind = "ellipsoidal"
        angles = [value("yaw"), value("pitch"), value("roll")]
        accuracies = [value("std_h"), value("std_v")]
        entries.append(_entry(cell("name"), line, where, crs, kind, x, y, z_m, angles, accuracies))
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
