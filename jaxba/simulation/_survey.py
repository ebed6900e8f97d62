"""What a simulated survey is made of before a pixel is painted: the camera, the flight, targets and their marks.

World: metres east, north, up around `LATITUDE_DEG`, `LONGITUDE_DEG`, `HEIGHT_M` on the WGS 84 ellipsoid.
"""

from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int
from scipy.spatial.transform import Rotation

from jaxba._errors import JaxbaError
from jaxba.geo import projected_from_local
from jaxba.geometry import OpenCV
from jaxba.scene import Attitude, LocalFrame, cam_from_enu
from jaxba.simulation._flight import Terrain, flight_plan

LATITUDE_DEG, LONGITUDE_DEG, HEIGHT_M, CRS = 44.9, -93.2, 250.0, "EPSG:32615"
SENSOR_WIDTH_MM, FOCAL_MM, FOCAL_35MM = 13.2, 11.06, 29
FOCAL_ERROR = 0.0075
"""How much longer the lens is than its data sheet says, as a share."""

_OBLIQUE_PITCH_DEG = -62.0
_POSITION_JITTER_M, _YAW_JITTER_DEG, _PITCH_JITTER_DEG = 0.7, 3.0, 1.0
_MARK_BORDER_PX = 15.0
_CONTROL_STD_M = np.array([0.01, 0.01, 0.015])


@dataclass(frozen=True, kw_only=True, eq=False)
class Flight:
    """Where photos are taken and which way they look.

    - `center_m`: true positions in the world. `cam_from_world`: true attitudes.
    - `tags`: what the gimbal reports.
    """

    center_m: Float[np.ndarray, "images 3"]
    cam_from_world: Float[np.ndarray, "images 3 3"]
    tags: tuple[Attitude, ...]


@dataclass(frozen=True, kw_only=True, eq=False)
class Marks:
    """Targets, control points first, and where photos show them, ordered by target.

    - `xyz_m`: true, world. `surveyed_m`: as surveyed, in `CRS`, height last. `xy_px`: measured.
    """

    names: tuple[str, ...]
    xyz_m: Float[np.ndarray, "targets 3"]
    surveyed_m: Float[np.ndarray, "targets 3"]
    target_index: Int[np.ndarray, " marks"]
    image_index: Int[np.ndarray, " marks"]
    xy_px: Float[np.ndarray, "marks 2"]


def true_camera(width_px: int) -> OpenCV:
    """Return the camera that photos are taken with: longer than its data sheet says, off centre, distorted."""
    focal = FOCAL_MM / SENSOR_WIDTH_MM * width_px * (1 + FOCAL_ERROR)
    center = width_px * np.array([0.5 + 0.0058, 0.375 - 0.0041])
    return OpenCV(
        fx=focal,
        fy=0.9994 * focal,
        cx=float(center[0]),
        cy=float(center[1]),
        k1=-0.045,
        k2=0.015,
        p1=0.0006,
        p2=-0.0004,
    )


def survey_frame() -> LocalFrame:
    """Return the world of the survey, and the CRS of its control points."""
    return LocalFrame(
        latitude_deg=LATITUDE_DEG,
        longitude_deg=LONGITUDE_DEG,
        height_m=HEIGHT_M,
        crs=CRS,
        epsg=int(CRS.removeprefix("EPSG:")),
        crs_name="WGS 84 / UTM zone 15N",
        unit="metre",
        height_note="Heights are above the WGS 84 ellipsoid.",
        height_datum="ellipsoidal",
    )


def fly(
    flight_rng: np.random.Generator,
    attitude_rng: np.random.Generator,
    footprint_m: Float[np.ndarray, "2"],
    *,
    num_nadir: int,
    num_oblique: int,
    height_m: float,
    forward_overlap: float,
    side_overlap: float,
    attitude_std_deg: float,
) -> Flight:
    """Return the flight: lines that look straight down, then the tilted photos.

    `footprint_m` is what a photo covers on the mean terrain, across the line and along it.
    """
    count = num_nadir + num_oblique
    spacing, base = footprint_m * (1 - np.array([side_overlap, forward_overlap]))
    stations, level = flight_plan(num_nadir, base, spacing)
    heading = np.where(level.as_matrix()[:, 0, 0] > 0, 0.0, 180.0)
    around = 45.0 + 360.0 * np.arange(num_oblique) / max(num_oblique, 1)
    back_m = height_m / np.tan(np.deg2rad(-_OBLIQUE_PITCH_DEG))
    outside = -back_m * np.column_stack([np.sin(np.deg2rad(around)), np.cos(np.deg2rad(around))])
    shift, turn = flight_rng.normal(size=(2, count, 3))
    yaw = np.concatenate([heading, around]) + _YAW_JITTER_DEG * turn[:, 0]
    pitch = np.full(count, _OBLIQUE_PITCH_DEG) + _PITCH_JITTER_DEG * turn[:, 1]
    pitch[:num_nadir] = -90.0 + np.abs(_PITCH_JITTER_DEG * turn[:num_nadir, 1])  # gimbals stop at straight down
    yaw = (yaw + 180.0) % 360.0 - 180.0
    tags = tuple(Attitude(yaw_deg=float(y), pitch_deg=float(p), roll_deg=0.0) for y, p in zip(yaw, pitch, strict=True))
    errors = Rotation.from_rotvec(np.deg2rad(attitude_std_deg) * attitude_rng.normal(size=(count, 3)))
    turned = errors * Rotation.from_matrix(np.stack([cam_from_enu(tag) for tag in tags]))
    centers = np.column_stack([np.concatenate([stations, outside]), np.full(count, height_m)])
    return Flight(center_m=centers + _POSITION_JITTER_M * shift, cam_from_world=turned.as_matrix(), tags=tags)


def spread_targets(
    stations: Float[np.ndarray, "stations 2"], terrain: Terrain, count: int
) -> Float[np.ndarray, "targets 3"]:
    """Return places on the terrain, spread evenly over the stations, the first few of them as well (Roberts 2018)."""
    low, high = stations.min(axis=0), stations.max(axis=0)
    number = np.arange(1, count + 1)[:, None]
    plan = low + (0.5 + number * [0.7548776662, 0.5698402910]) % 1.0 * (high - low)
    return np.column_stack([plan, terrain(plan)])


def measure_targets(
    rng: np.random.Generator,
    camera: OpenCV,
    size_px: tuple[int, int],
    flight: Flight,
    names: tuple[str, ...],
    xyz_m: Float[np.ndarray, "targets 3"],
    *,
    mark_std_px: float,
) -> Marks:
    """Return the targets as surveyed, and their marks in all photos that show them.

    Raises:
        JaxbaError: a target that fewer than two photos show.
    """
    noise_m = _CONTROL_STD_M * rng.normal(size=xyz_m.shape)
    in_cam = np.einsum("nij,tnj->tni", flight.cam_from_world, xyz_m[:, None] - flight.center_m)
    with jax.enable_x64(True):
        xy_px = np.asarray(camera.project(jnp.asarray(in_cam)))
    size = np.array(size_px)
    # distortion folds back far outside: what lies well beyond the corners is out
    reach = 1.1 * np.hypot(*size) / 2 / float(camera.fx)
    ahead = np.hypot(in_cam[..., 0], in_cam[..., 1]) < reach * in_cam[..., 2]
    inside = ahead & np.all((xy_px > _MARK_BORDER_PX) & (xy_px < size - _MARK_BORDER_PX), axis=-1)
    for name, count in zip(names, inside.sum(axis=1), strict=True):
        if count < 2:
            raise JaxbaError(f"{name} lies in {count} photos, fewer than 2; raise the overlaps or num_images.")
    target, image = np.nonzero(inside)
    return Marks(
        names=names,
        xyz_m=xyz_m,
        surveyed_m=projected_from_local(survey_frame(), xyz_m) + noise_m,
        target_index=target,
        image_index=image,
        xy_px=xy_px[inside] + mark_std_px * rng.normal(size=(len(target), 2)),
    )
