"""A small survey with known truth: photos of a painted terrain with the tags of a drone, control points, the truth.

    survey/photos/SIM_0001.JPG ...   what the pipeline reads
    survey/gcp_list.txt              control points and their marks, as OpenDroneMap writes them
    survey/check_list.txt            check points, in the same form
    survey/truth.npz                 poses, camera, terrain, points: not to be shown to the pipeline
    survey/README.txt

Lines run north and south; the last photos look at the middle of the block from all sides, tilted, which tells the focal
length apart from the height. Tags hold what a drone knows: a position off by the GNSS's noise, the barometer's height
over the take-off, the attitude that the gimbal reports, and the focal length of the lens's data sheet. Each step draws
from its own random stream, so that one option changes nothing but what it names. The same parameters give the same
bytes.

Pixels of marks count from the outer corner of the first pixel, as OpenDroneMap's and jaxba's do: its centre is
(0.5, 0.5). Heights are above the WGS 84 ellipsoid.
"""

import contextlib
import datetime
import io
import os
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from jaxba._atomic import cannot_write, write_atomically
from jaxba._errors import JaxbaError
from jaxba.engine import Parameters, parameter
from jaxba.geo import geodetic_from_local, projected_from_local
from jaxba.geometry import OpenCV
from jaxba.scene import Attitude
from jaxba.simulation import PhotoTags, expose, ground_points, jpeg_with_tags, paint_ground, pixel_rays, render
from jaxba.simulation._flight import Terrain, smooth_terrain
from jaxba.simulation._survey import (
    CRS,
    FOCAL_35MM,
    FOCAL_MM,
    HEIGHT_M,
    LATITUDE_DEG,
    LONGITUDE_DEG,
    SENSOR_WIDTH_MM,
    Flight,
    Marks,
    fly,
    measure_targets,
    spread_targets,
    survey_frame,
    true_camera,
)

_RTK_STD_M = 0.1  # receivers that state less have a fixed RTK solution
_RELIEF, _WAVE = 0.17, 0.5  # of the terrain, shares of the flight height
_FALLOFF, _NOISE_STD = 0.15, 2.0
_TRUTH_GRID_M = 0.25
_BAROMETER_STD_M = 0.2  # of relative altitudes, whatever the GNSS's noise
_TEXELS_PER_PIXEL = 0.7  # side of a texel over that of a pixel on the ground, straight down
README, _TITLE = "README.txt", "Simulated survey"


@dataclass(frozen=True, kw_only=True)
class Params(Parameters):
    """What the user may set."""

    num_images: int = parameter(24, low=6, high=500, help="photos in all")
    num_oblique: int = parameter(4, low=0, high=50, help="of them tilted, looking at the middle of the block")
    width_px: int = parameter(1200, low=320, high=6000, help="columns of a photo; rows are three quarters of it")
    height_m: float = parameter(70.0, low=20, high=400, help="of the flight over the terrain")
    forward_overlap: float = parameter(0.75, low=0.3, high=0.95, help="of neighbours along a line")
    side_overlap: float = parameter(0.6, low=0.2, high=0.95, help="of neighbouring lines")
    gnss_std_h_m: float = parameter(0.03, low=0.001, high=20, help="noise of positions, east and north; 0.1: RTK")
    gnss_std_v_m: float = parameter(0.05, low=0.001, high=40, help="noise of positions, up")
    attitude_std_deg: float = parameter(1.5, low=0, high=10, help="noise of the attitude tags about each axis")
    num_control: int = parameter(5, low=0, high=50, help="control points")
    num_check: int = parameter(5, low=0, high=50, help="check points")
    mark_std_px: float = parameter(0.3, low=0, high=5, help="noise of marks an axis")
    seed: int = parameter(0, low=0, high=2**31, help="the same seed gives the same survey")


@dataclass(frozen=True, kw_only=True)
class Written:
    """What was written, for the terminal."""

    photos: Path
    num_photos: int
    image_size_px: tuple[int, int]
    num_control: int
    num_check: int
    num_bytes: int


def write_survey(folder: str | os.PathLike[str], params: Params) -> Written:
    """Write the survey's files into a folder, which is made; an older simulated survey in it is replaced.

    The truth is written last and removed first, so a folder with `truth.npz` holds a whole survey.

    Raises:
        JaxbaError: a folder that holds something else, or cannot be written to; parameters that fit no survey.
    """
    path = Path(folder)
    _check_folder(path)
    with contextlib.suppress(FileNotFoundError):
        (path / "truth.npz").unlink()
    num_bytes, names = 0, set()
    for name, content in simulate(params):
        target = path / name
        try:
            target.parent.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise cannot_write(target.parent, error) from error
        with write_atomically(target) as file:
            file.write(content)
        num_bytes += len(content)
        names.add(target.name)
        if name == README:
            _remove_old_photos(path / "photos")
    return Written(
        photos=path / "photos",
        num_photos=params.num_images,
        image_size_px=_size_px(params),
        num_control=params.num_control,
        num_check=params.num_check,
        num_bytes=num_bytes,
    )


def simulate(params: Params) -> Iterator[tuple[str, bytes]]:
    """Yield the survey's files, path below its folder and content, one after the other; the truth comes last.

    Raises:
        JaxbaError: too many tilted photos, or a target that fewer than two photos show.
    """
    num_nadir = params.num_images - params.num_oblique
    if num_nadir < 4:
        raise JaxbaError(
            f"num_oblique={params.num_oblique} leaves fewer than 4 of {params.num_images} photos to look straight "
            "down; choose fewer, or more num_images."
        )
    streams = np.random.default_rng(params.seed).spawn(8)
    flight_rng, terrain_rng, paint_rng, gnss_rng, attitude_rng, mark_rng, sensor_rng, barometer_rng = streams
    camera, size_px = true_camera(params.width_px), _size_px(params)
    images = tuple(f"SIM_{number:04d}.JPG" for number in range(1, params.num_images + 1))
    terrain = smooth_terrain(terrain_rng, _RELIEF * params.height_m, _WAVE * params.height_m)
    flight = fly(
        flight_rng,
        attitude_rng,
        params.height_m * np.array(size_px) / camera.fx,
        num_nadir=num_nadir,
        num_oblique=params.num_oblique,
        height_m=params.height_m,
        forward_overlap=params.forward_overlap,
        side_overlap=params.side_overlap,
        attitude_std_deg=params.attitude_std_deg,
    )
    names = _target_names(params)
    xyz_m = spread_targets(flight.center_m[:num_nadir, :2], terrain, len(names))
    marks = measure_targets(mark_rng, camera, size_px, flight, names, xyz_m, mark_std_px=params.mark_std_px)
    std_m = np.array([params.gnss_std_h_m, params.gnss_std_h_m, params.gnss_std_v_m])
    measured = flight.center_m + std_m * gnss_rng.normal(size=flight.center_m.shape)
    geodetic = geodetic_from_local(survey_frame(), measured)
    relative_m = flight.center_m[:, 2] + _BAROMETER_STD_M * barometer_rng.normal(size=params.num_images)

    rays = pixel_rays(camera, size_px)
    poses = zip(flight.cam_from_world, flight.center_m, strict=True)
    plans = [ground_points(rays, rotation, center, terrain)[..., :2] for rotation, center in poses]
    low = np.min([plan.min(axis=(0, 1)) for plan in plans], axis=0) - 1.0
    high = np.max([plan.max(axis=(0, 1)) for plan in plans], axis=0) + 1.0
    texel_m = _TEXELS_PER_PIXEL * params.height_m / float(camera.fx)
    ground = paint_ground(paint_rng, terrain, low_m=low, high_m=high, texel_m=texel_m, targets_m=xyz_m[:, :2])
    yield README, _readme(params)
    for index, (name, plan) in enumerate(zip(images, plans, strict=True)):
        picture = expose(render(ground, plan, size_px), sensor_rng, falloff=_FALLOFF, noise_std=_NOISE_STD)
        tags = _tags(params, index, geodetic[index], relative_m[index], flight.tags[index])
        yield f"photos/{name}", jpeg_with_tags(picture, tags)
    yield "gcp_list.txt", _mark_list(marks, images, range(params.num_control))
    yield "check_list.txt", _mark_list(marks, images, range(params.num_control, len(marks.names)))
    yield "truth.npz", _truth(camera, flight, images, measured, marks, terrain, low, high, params.num_control)


def _tags(params: Params, index: int, geodetic: Float[np.ndarray, "3"], up_m: float, gimbal: Attitude) -> PhotoTags:
    """Return the tags of a photo at (longitude, latitude, height)."""
    time = datetime.datetime(2024, 6, 1, 10) + index * datetime.timedelta(seconds=2)
    return PhotoTags(
        make="jaxba",
        model="simulated",
        time=time.strftime("%Y:%m:%d %H:%M:%S"),
        focal_mm=FOCAL_MM,
        focal_35mm=FOCAL_35MM,
        sensor_width_mm=SENSOR_WIDTH_MM,
        latitude_deg=float(geodetic[1]),
        longitude_deg=float(geodetic[0]),
        altitude_m=float(geodetic[2]),
        relative_altitude_m=float(up_m),
        gimbal=gimbal,
        flight=Attitude(yaw_deg=gimbal.yaw_deg, pitch_deg=0.0, roll_deg=0.0),
        std_h_m=params.gnss_std_h_m,
        std_v_m=params.gnss_std_v_m,
        is_rtk=params.gnss_std_h_m < _RTK_STD_M,
    )


def _mark_list(marks: Marks, images: tuple[str, ...], targets: range) -> bytes:
    """Return OpenDroneMap's list of some targets: the CRS, then `x y z px py image name` a mark."""
    lines = [CRS]
    for target, image, (px, py) in zip(marks.target_index, marks.image_index, marks.xy_px, strict=True):
        if target in targets:
            x, y, z = marks.surveyed_m[target]
            lines.append(f"{x:.4f} {y:.4f} {z:.4f} {px:.3f} {py:.3f} {images[image]} {marks.names[target]}")
    return "\n".join([*lines, ""]).encode()


def _truth(
    camera: OpenCV,
    flight: Flight,
    images: tuple[str, ...],
    measured_m: Float[np.ndarray, "images 3"],
    marks: Marks,
    terrain: Terrain,
    low_m: Float[np.ndarray, "2"],
    high_m: Float[np.ndarray, "2"],
    num_control: int,
) -> bytes:
    """Return `truth.npz`; the terrain's heights stand on a grid of 0.25 m, rows to the north, columns to the east."""
    east, north = (np.arange(low, high + _TRUTH_GRID_M, _TRUTH_GRID_M) for low, high in zip(low_m, high_m, strict=True))
    height = terrain(np.stack(np.meshgrid(east, north), axis=-1).reshape(-1, 2)).reshape(len(north), len(east))
    names = camera.parameter_names()
    rotation = Rotation.from_matrix(flight.cam_from_world)
    arrays = {
        "image_name": np.array(images),
        "pose_quaternion_wxyz": rotation.as_quat(canonical=True, scalar_first=True),
        "pose_translation_m": -rotation.apply(flight.center_m),
        "center_m": flight.center_m,
        "center_in_crs_m": projected_from_local(survey_frame(), flight.center_m),
        "measured_position_m": measured_m,
        "camera_model": np.array("OPENCV"),
        "camera_parameter_name": np.array(names),
        "camera_parameters": np.array([getattr(camera, name) for name in names]),
        "target_name": np.array(marks.names, dtype=np.str_),
        "target_is_control": np.arange(len(marks.names)) < num_control,
        "target_xyz_m": marks.xyz_m,
        "target_in_crs_m": projected_from_local(survey_frame(), marks.xyz_m),
        "target_surveyed_m": marks.surveyed_m,
        "terrain_east_m": east,
        "terrain_north_m": north,
        "terrain_height_m": height.astype(np.float32),
        "frame_latitude_longitude_height": np.array([LATITUDE_DEG, LONGITUDE_DEG, HEIGHT_M]),
        "crs": np.array(CRS),
    }
    file = io.BytesIO()
    np.savez(file, **arrays)
    return file.getvalue()


def _check_folder(path: Path) -> None:
    """Raise where a folder holds anything but a simulated survey."""
    if path.exists() and not path.is_dir():
        raise JaxbaError(f"{path}: is a file; choose the name of a folder.")
    if not path.is_dir() or not any(path.iterdir()):
        return
    readme = path / README
    if not readme.is_file() or not readme.read_bytes().startswith(_TITLE.encode()):
        raise JaxbaError(f"{path}: is not empty and holds no simulated survey; choose a new or an empty folder.")


def _remove_old_photos(folder: Path) -> None:
    for photo in folder.glob("SIM_*.JPG") if folder.is_dir() else ():
        if re.fullmatch(r"SIM_\d{4}\.JPG", photo.name):
            photo.unlink()


def _size_px(params: Params) -> tuple[int, int]:
    return params.width_px, params.width_px * 3 // 4


def _readme(params: Params) -> bytes:
    width, height = _size_px(params)
    return (
        f"{_TITLE}: {params.num_images} photos of {width} x {height} pixels, {params.num_control} control and "
        f"{params.num_check} check points in {CRS}, ellipsoidal heights.\n"
        "truth.npz holds what it was made from; pixels in the lists count from the outer corner of the first pixel.\n"
    ).encode()


def _target_names(params: Params) -> tuple[str, ...]:
    control, check = range(1, params.num_control + 1), range(1, params.num_check + 1)
    return tuple([f"gcp{i:02d}" for i in control] + [f"check{i:02d}" for i in check])
