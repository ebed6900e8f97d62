"""Photos: what is known of each frame before a pixel is looked at.

An image's index, wherever one stands in the pipeline, is its place in the metadata stage's `photos`, which are sorted
by name. Images are used on their stored pixel grid: EXIF's orientation is recorded, and no pixel is turned by it.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from jaxba.scene._attitude import Attitude

FocalSource = Literal["given", "calibrated", "focal_plane", "sensor_table", "equivalent_35mm"]
HeightKind = Literal["ellipsoidal", "mean_sea_level", "unknown"]
Fix = Literal["rtk_fixed", "rtk_float", "differential", "single", "unknown"]


@dataclass(frozen=True, kw_only=True)
class PhotoFile:
    """A file in the photo folder.

    - `name`: path below the folder, with forward slashes; names the photo everywhere. `path`: where it is.
    - `sha256`: of its contents, hexadecimal.
    """

    name: str
    path: Path
    sha256: str


@dataclass(frozen=True, kw_only=True)
class Position:
    """A measured position of the camera.

    - `crs`: what `x` and `y` are in; always east (or longitude) first, degrees where the CRS is geographic.
    - `z_m`: height; `height_kind` says above what. Metres.
    - `relative_altitude_m`: above the take-off point, never mixed with `z_m`.
    - `std_h_m`, `std_v_m`: accuracy as the photo or list states it, horizontal (an axis) and vertical.
    - `fix`: of the GNSS receiver. `source`: where it was read, for messages. `list_name`: of the list that gives it in
      place of the tags; empty where these do.
    """

    crs: str = "EPSG:4326"
    x: float
    y: float
    z_m: float | None = None
    height_kind: HeightKind = "unknown"
    relative_altitude_m: float | None = None
    std_h_m: float | None = None
    std_v_m: float | None = None
    fix: Fix = "unknown"
    source: str = "EXIF"
    list_name: str = ""


@dataclass(frozen=True, kw_only=True)
class Lens:
    """What tells the camera of a photo from others, as its tags say it.

    - `body`: make, model, serial number, lens, band and place in a rig, in words.
    - `focal_mm`: of the lens. `digital_zoom`: by which the photo was cut and enlarged, 1 without.
    - `equivalent_mm`: focal length on 35 mm film that gives the same view, of the photo as it is stored.
    """

    body: str = "unknown camera"
    focal_mm: float | None = None
    digital_zoom: float = 1.0
    equivalent_mm: float | None = None


@dataclass(frozen=True, kw_only=True)
class Photo:
    """A usable frame.

    - `width_px`, `height_px`: of the stored pixel grid, read from the image itself and not from its tags.
    - `original_size_px`: width and height that EXIF states, from before a resize; None where it states none.
    - `orientation`: EXIF's, 1 to 8; recorded, not applied.
    - `camera`: photos with the same text share one camera's intrinsics. `lens`: what of the tags tells cameras apart.
    - `focal_px`: for this pixel grid. `focal_source`: how it was found; both None where nothing tells it.
    - `tag_position`: what the tags say where a list replaces them as `position`; else None.
    - `attitude`: of the camera (the gimbal). `flight_attitude`: of the aircraft.
    - `notes`: what was odd and how it was handled.
    - `mask`: an image file, black where no features are to be taken.
    """

    name: str
    path: Path
    sha256: str
    width_px: int
    height_px: int
    camera: str
    orientation: int = 1
    make: str = ""
    model: str = ""
    time: str | None = None
    focal_px: float | None = None
    focal_source: FocalSource | None = None
    position: Position | None = None
    tag_position: Position | None = None
    attitude: Attitude | None = None
    flight_attitude: Attitude | None = None
    notes: tuple[str, ...] = ()
    original_size_px: tuple[int, int] | None = None
    lens: Lens = Lens()
    mask: PhotoFile | None = None

    @property
    def megapixels(self) -> float:
        return self.width_px * self.height_px / 1e6


@dataclass(frozen=True, kw_only=True)
class LeftOut:
    """Something left out or doubted, named with the reason: nothing is dropped in silence.

    - `name`: the photo, or the pair as `a.jpg, b.jpg`. `reason`: one sentence with the numbers and the cure.
    """

    name: str
    reason: str
