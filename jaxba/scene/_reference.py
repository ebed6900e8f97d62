"""The survey's place on earth: the local frame of the adjustment, and what was measured of each image in it."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxba.scene._photo import LeftOut


@dataclass(frozen=True, kw_only=True)
class LocalFrame:
    """Local east, north, up in metres around a geodetic origin, and the CRS that results go to.

    - `latitude_deg`, `longitude_deg`, `height_m`: origin on WGS 84; the height is in the photos' own height system.
    - `crs`: the target CRS, as an authority code where it has one (`EPSG:32615`), else as WKT. `epsg`: its code.
    - `crs_name`: for people. `unit`: of its axes, such as `metre` or `US survey foot`.
    - `height_note`: in one sentence, what the heights of all results are above, and how that is known.
    - `height_datum`: what the photos' heights, and so the local frame's, are above: `ellipsoidal`, `mean_sea_level`,
      `unknown`, or a vertical CRS such as `EPSG:5773`. `height_unit`: of the heights of results in the target CRS.
    """

    latitude_deg: float
    longitude_deg: float
    height_m: float
    crs: str
    epsg: int | None
    crs_name: str
    unit: str
    height_note: str
    height_datum: str = "unknown"
    height_unit: str = "metre"


@dataclass(frozen=True)
class AssumedDatum:
    """What heights were taken to be above that do not say it: `LocalFrame.height_datum`, and whose they are.

    - `of`: `photos`, and the name of a list of points.
    """

    of: tuple[str, ...]
    datum: str


@dataclass(frozen=True, kw_only=True, eq=False)
class Reference:
    """Measured positions and attitudes in the local frame, one row an image; NaN where there is none.

    - `frame`: None where no image has a position: the block is then adjusted without a place on earth.
    - `xyz_m`, `std_m`: position and its sigma an axis (east, north, up), metres. Where a height is missing or not to be
      trusted, its sigma is infinite and the origin's height stands in for it.
    - `quaternion`: attitude, `cam_from_world`, scalar first. `attitude_std_rad`: its sigma about each axis.
    - `is_used`: the position is trusted enough to be a prior.
    - `height_above_ground_m`: from the flight's relative altitude; NaN where it is unknown.
    - `flight`: of each image, from 0, and `flight_std_m`: sigma of what the positions of a flight have in common and no
      others; None where flights are not told apart.
    - `review`: images whose position is not used, or used with a large sigma of its own, with the reason.
    - `assumed_datum`: of heights that do not say what they are above; None where all do.
    - `notes`: what was found and decided, in sentences.
    """

    frame: LocalFrame | None
    xyz_m: Float[np.ndarray, "images 3"]
    std_m: Float[np.ndarray, "images 3"]
    quaternion: Float[np.ndarray, "images 4"]
    attitude_std_rad: Float[np.ndarray, "images 3"]
    is_used: Bool[np.ndarray, " images"]
    height_above_ground_m: Float[np.ndarray, " images"]
    review: tuple[LeftOut, ...] = ()
    notes: tuple[str, ...] = ()
    flight: Int[np.ndarray, " images"] | None = None
    flight_std_m: float | None = None
    assumed_datum: AssumedDatum | None = None


@dataclass(frozen=True, eq=False)
class CommonOffset:
    """What all measured positions have in common, measured minus true, as an unknown: its start value and sigma."""

    start_m: Float[np.ndarray, "3"]
    std_m: Float[np.ndarray, "3"]


@dataclass(frozen=True, eq=False)
class FlightOffsets:
    """What the positions of each flight have in common, measured minus true, world, metres; one row a flight.

    - `number`: as in `Reference.flight`. `num_photos`: with a position that is used.
    - `offset_m`, `std_m`: NaN along an axis that is not measured; `std_m` also without sigmas.
    """

    number: Int[np.ndarray, " flights"]
    num_photos: Int[np.ndarray, " flights"]
    offset_m: Float[np.ndarray, "flights 3"]
    std_m: Float[np.ndarray, "flights 3"]
