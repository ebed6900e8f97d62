"""Synthetic surveys: a UAV block with known truth, for tests, notebooks and benchmarks.

A camera flies a plan over smooth terrain, images see points, pixels and GNSS positions are measured with noise and
gross errors, and start values are spoilt. Each step draws from its own random stream, so that outliers, say, can be
switched on in an unchanged block. Host code in numpy; jax only projects through the camera model. On two cores 500
images take 0.5 s (1.0 s the first time), 2000 images 0.9 s.

World: metres east, north, up; the origin lies on the mean terrain under the middle of the block.
"""

from dataclasses import dataclass
from typing import get_args

import equinox as eqx
import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial.transform import Rotation

from jaxba._errors import JaxbaError
from jaxba.ba import (
    AttitudePrior,
    ControlPointPrior,
    LeverArmPrior,
    Observations,
    PositionOffsetPrior,
    PositionPrior,
    Problem,
)
from jaxba.geometry import AbstractCamera, OpenCV, Pose
from jaxba.simulation._flight import (
    FlightPattern,
    Images,
    Tracks,
    field_of_view,
    flight_plan,
    make_tracks,
    smooth_terrain,
)

DRONE_CAMERA = OpenCV(fx=3652.0, fy=3649.0, cx=2748.5, cy=1816.2, k1=-0.045, k2=0.015, p1=0.0006, p2=-0.0004)
"""A drone's 20 MP camera, 5472 x 3648 pixels, with a mild distortion (up to 90 px, in the corners)."""


_FOCAL, _CENTER = ("f", "fx", "fy"), ("cx", "cy")
_MOST = 1e9  # of counts and metres: what lies beyond is a mistake


@dataclass(frozen=True)
class Truth:
    """What a synthetic survey was made from; images, points and observations in the order of its problem.

    - `poses`: `cam_from_world`. `cameras`: one entry a camera, pixels. `points`: metres, world.
    - `lever_arm`: camera to antenna, metres, camera frame.
    - `xy_px`: image points without noise. `is_outlier`: gross errors among the measured ones.
    - `gnss_is_outlier`: images with a wrong position.
    - `control_index`, `check_index`: marked points, with a prior in the problem or without one.
    - `pixel_std_px`, `gnss_std_m`: the noise put in, outliers aside; None without GNSS.
    """

    poses: Pose
    cameras: AbstractCamera
    camera_index: Int[np.ndarray, " images"]
    image_size_px: tuple[int, int]
    points: Float[np.ndarray, "points 3"]
    lever_arm: Float[np.ndarray, "3"]
    xy_px: Float[np.ndarray, "observations 2"]
    is_outlier: Bool[np.ndarray, " observations"]
    gnss_is_outlier: Bool[np.ndarray, " images"]
    control_index: Int[np.ndarray, " control"]
    check_index: Int[np.ndarray, " check"]
    pixel_std_px: float
    gnss_std_m: tuple[float, float, float] | None


@dataclass(frozen=True)
class Survey:
    """A problem with noisy measurements and start values, and the truth behind it."""

    problem: Problem
    truth: Truth


def uav_block(
    num_images: int = 500,
    *,
    seed: int = 0,
    camera: AbstractCamera = DRONE_CAMERA,
    image_size_px: tuple[int, int] = (5472, 3648),
    num_cameras: int = 1,
    height_m: float = 100.0,
    forward_overlap: float = 0.8,
    side_overlap: float = 0.6,
    flight: FlightPattern = "lines",
    num_lines: int | None = None,
    position_jitter_m: float = 1.0,
    attitude_jitter_rad: float = 0.03,
    terrain_relief_m: float = 20.0,
    points_per_image: float = 66.0,
    mean_track_length: float = 3.75,
    num_control: int = 0,
    num_check: int = 10,
    control_std_m: tuple[float, float, float] = (0.01, 0.01, 0.02),
    pixel_std_px: float = 0.5,
    outlier_fraction: float = 0.0,
    outlier_px: tuple[float, float] = (5.0, 200.0),
    gnss_std_m: tuple[float, float, float] | None = (0.03, 0.03, 0.06),
    gnss_outlier_fraction: float = 0.0,
    gnss_outlier_m: tuple[float, float] = (1.0, 10.0),
    lever_arm_m: tuple[float, float, float] = (0.0, 0.0, 0.0),
    lever_arm_std_m: float | None = None,
    position_offset_m: tuple[float, float, float] = (0.0, 0.0, 0.0),
    position_offset_std_m: float | None = None,
    attitude_prior: bool = False,
    attitude_error_rad: float = 0.0175,
    position_error_m: float = 0.0,
    focal_error: float = 0.01,
    point_error_m: float = 2.0,
) -> Survey:
    """Return a UAV block, a problem to adjust with its truth; the same one for the same seed.

    The block:

    - `camera`: the true camera, scalar fields. A model without a principal point has
      pixel coordinates centred on the image.
    - `num_cameras`: with more than one, each is a variation of `camera` (focal length 0.2%, principal point 3 px,
      distortion 10%) for a stretch of consecutive images; `num_images` of them give each image its own.
    - `height_m`: above the mean terrain.
    - `flight`: "lines" to and fro; "crossing", half of the images along lines across those of the other half; "second",
      half of them in a second flight along the same lines; "orbit", a circle as wide as the cameras fly high, from
      which they look at its middle, 45 degrees down.
    - `num_lines`: of a flight; by default as many as make it square. With 2 or 3 it is a corridor.
    - `position_jitter_m`, `attitude_jitter_rad`: sigma an axis of the flight about its plan.
    - `terrain_relief_m`: highest minus lowest terrain; 0 is flat.
    - `points_per_image`: tie points over images. `mean_track_length`: of tie points, or as near to it as the overlap
      allows; none is shorter than 2.
    - `num_control`, `num_check`: marks spread over the block and measured in all images that they lie in. Points are
      ordered control, check, tie.

    The measurements:

    - `pixel_std_px`: an axis; 0 gives exact pixels, to which the problem then gives a sigma of 1.
    - `outlier_fraction`: of the tie points' observations, moved by `outlier_px` (least, most) in any direction.
    - `gnss_std_m`: east, north, up; None for no position prior. `gnss_outlier_fraction`: of the images, moved by
      `gnss_outlier_m` (least, most) in any direction.
    - `lever_arm_m`: camera to antenna, camera frame. `lever_arm_std_m`: None holds it fixed at its true value; a sigma
      frees it, with a prior and a start value that are off by that sigma.
    - `position_offset_m`: of all GNSS positions in common. `position_offset_std_m`: a sigma makes it an unknown, with a
      prior of zero and that sigma, and a start value of zero; None leaves it as it is.

    The start values: positions from GNSS (without it, the true ones) and `position_error_m` on top; attitudes with a
    sigma of `attitude_error_rad` about each axis, which `attitude_prior` makes a prior too; focal lengths too long by
    the fraction `focal_error`, principal points in the image's centre, no distortion; points off by `point_error_m` an
    axis, control points as surveyed. All of it is free, except for a `k3` that is truly zero and the lever arm.

    Raises `JaxbaError` where an option is out of range, an image sees fewer than 20 points, or the block falls apart.

    >>> survey = uav_block(12, seed=1, outlier_fraction=0.02)
    >>> survey.problem.num_images, survey.problem.num_points, survey.truth.points.shape
    (12, 802, (802, 3))
    """
    for name, value, low, high in (
        ("num_images", num_images, 2, _MOST),
        ("num_cameras", num_cameras, 1, num_images),
        ("num_lines", 1 if num_lines is None else num_lines, 1, num_images),
        ("height_m", height_m, 1e-3, _MOST),
        ("forward_overlap", forward_overlap, 0.0, 0.99),
        ("side_overlap", side_overlap, 0.0, 0.99),
        ("position_jitter_m", position_jitter_m, 0.0, _MOST),
        ("attitude_jitter_rad", attitude_jitter_rad, 0.0, np.pi),
        ("terrain_relief_m", terrain_relief_m, 0.0, height_m),
        ("points_per_image", points_per_image, 1.0, _MOST),
        ("mean_track_length", mean_track_length, 2.0, _MOST),
        ("num_control", num_control, 0, _MOST),
        ("num_check", num_check, 0, _MOST),
        ("pixel_std_px", pixel_std_px, 0.0, _MOST),
        ("attitude_error_rad", attitude_error_rad, 0.0, np.pi),
        ("position_error_m", position_error_m, 0.0, _MOST),
        ("focal_error", focal_error, -0.9, 10.0),
        ("point_error_m", point_error_m, 0.0, _MOST),
        ("seed", seed, 0, np.inf),
        *((f"camera.{name}", getattr(camera, name), 1.0, _MOST) for name in _FOCAL if name in camera.parameter_names()),
        ("outlier_fraction", outlier_fraction, 0.0, 1.0),
        ("gnss_outlier_fraction", gnss_outlier_fraction, 0.0, 1.0),
    ):
        if not low <= value <= high:
            raise JaxbaError(f"{name}={value} is out of range; choose it from {low:g} to {high:g}.")
    if flight not in get_args(FlightPattern):
        raise JaxbaError(f"flight={flight!r}: choose one of {', '.join(get_args(FlightPattern))}.")
    for name, value in (
        ("gnss_std_m", gnss_std_m),
        ("control_std_m", control_std_m),
        ("lever_arm_std_m", lever_arm_std_m),
        ("position_offset_std_m", position_offset_std_m),
        ("attitude_error_rad", attitude_error_rad if attitude_prior else None),
    ):
        if value is not None and not np.all(np.isfinite(value) & (np.asarray(value) > 0)):
            raise JaxbaError(f"{name}={value}: sigmas of priors must be positive and finite.")
    flight_rng, terrain_rng, track_rng, pixel_rng, gnss_rng, start_rng = np.random.default_rng(seed).spawn(6)

    corner = np.zeros(2) if "cx" in camera.parameter_names() else -np.array(image_size_px) / 2
    frame_px = np.stack([corner, corner + image_size_px])
    view = field_of_view(camera, frame_px)
    spacing_m, base_m = height_m * (view[1] - view[0]) * (1 - np.array([side_overlap, forward_overlap]))
    stations, level = flight_plan(num_images, base_m, spacing_m, num_lines, flight=flight, radius_m=height_m)
    shift, turn = flight_rng.normal(size=(2, num_images, 3))
    centers = np.column_stack([stations, np.full(num_images, height_m)]) + position_jitter_m * shift
    attitudes = Rotation.from_rotvec(attitude_jitter_rad * turn) * level
    cameras = _vary(flight_rng, camera, num_cameras)
    camera_index = (np.arange(num_images) * num_cameras // num_images).astype(np.int32)

    images = Images(centers, attitudes.as_matrix(), cameras, camera_index, frame_px, 4 * pixel_std_px, view)
    reach = np.abs(view).max(axis=0)
    reach_m = (reach + 2 * attitude_jitter_rad * (1 + reach**2)) * (height_m + terrain_relief_m / 2)
    around = flight == "orbit"  # all see what lies between them
    tracks = make_tracks(
        track_rng,
        images,
        smooth_terrain(terrain_rng, terrain_relief_m, height_m),
        reach_m=np.full(2, np.inf) if around else reach_m,
        beyond_m=np.zeros(2) if around else reach_m,
        num_tie=round(points_per_image * num_images),
        mean_length=mean_track_length,
        num_marks=num_control + num_check,
    )
    points = tracks.points

    measured_px, is_outlier = _measure_pixels(pixel_rng, tracks, frame_px, pixel_std_px, outlier_fraction, outlier_px)
    lever_arm = np.array(lever_arm_m, float)
    antennas, gnss_is_outlier = centers + attitudes.inv().apply(lever_arm), np.zeros(num_images, bool)
    if gnss_std_m is not None:
        gnss_is_outlier = _choose(gnss_rng, np.arange(num_images), num_images, gnss_outlier_fraction)
        antennas += gnss_std_m * gnss_rng.normal(size=antennas.shape)
        antennas += _gross(gnss_rng, gnss_is_outlier, gnss_outlier_m, 3)
        antennas += np.array(position_offset_m, float)
    surveyed = points[:num_control] + control_std_m * start_rng.normal(size=(num_control, 3))

    start_attitudes = Rotation.from_rotvec(attitude_error_rad * start_rng.normal(size=(num_images, 3))) * attitudes
    start_lever_arm = lever_arm + (lever_arm_std_m or 0.0) * start_rng.normal(size=3)
    start_centers = antennas - start_attitudes.inv().apply(start_lever_arm) if gnss_std_m is not None else centers
    start_poses = _pose(start_attitudes, start_centers + position_error_m * start_rng.normal(size=centers.shape))
    start_points = points + point_error_m * start_rng.normal(size=points.shape)
    start_points[:num_control] = surveyed

    every_image, control = np.arange(num_images, dtype=np.int32), np.arange(num_control, dtype=np.int32)
    priors = []
    if gnss_std_m is not None:
        std_m = np.tile(np.array(gnss_std_m, float), (num_images, 1))
        priors.append(PositionPrior(image_index=every_image, xyz=antennas, std_m=std_m))
    if attitude_prior:
        std_rad = np.full((num_images, 3), attitude_error_rad)
        priors.append(AttitudePrior(image_index=every_image, quaternion=start_poses.quaternion, std_rad=std_rad))
    if num_control:
        std_m = np.tile(np.array(control_std_m, float), (num_control, 1))
        priors.append(ControlPointPrior(point_index=control, xyz=surveyed, std_m=std_m))
    if lever_arm_std_m is not None:
        priors.append(LeverArmPrior(xyz=start_lever_arm[None], std_m=np.full((1, 3), float(lever_arm_std_m))))
    if position_offset_std_m is not None:
        priors.append(PositionOffsetPrior(xyz=np.zeros((1, 3)), std_m=np.full((1, 3), float(position_offset_std_m))))
    std_px = np.full(len(measured_px), pixel_std_px or 1.0)
    problem = Problem.build(
        start_poses,
        _start_cameras(cameras, focal_error, frame_px.mean(axis=0)),
        start_points,
        Observations(measured_px, std_px, tracks.image_index, tracks.point_index),
        camera_index=camera_index,
        priors=priors,
        lever_arm=start_lever_arm,
    )
    if isinstance(cameras, OpenCV) and not np.any(cameras.k3):
        problem = problem.fix(intrinsics=["k3"])
    problem = eqx.tree_at(lambda p: p.free.lever_arm, problem, np.array(lever_arm_std_m is not None))
    if position_offset_std_m is not None:
        offset = np.zeros((1, 3)), np.array(True)
        problem = eqx.tree_at(lambda p: (p.position_offset, p.free.position_offset), problem, offset)
    truth = Truth(
        poses=_pose(attitudes, centers),
        cameras=cameras,
        camera_index=camera_index,
        image_size_px=image_size_px,
        points=points,
        lever_arm=lever_arm,
        xy_px=tracks.xy_px,
        is_outlier=is_outlier,
        gnss_is_outlier=gnss_is_outlier,
        control_index=control,
        check_index=np.arange(num_control, tracks.num_marks, dtype=np.int32),
        pixel_std_px=pixel_std_px,
        gnss_std_m=gnss_std_m,
    )
    return Survey(problem, truth)


def _measure_pixels(
    rng: np.random.Generator,
    tracks: Tracks,
    frame_px: Float[np.ndarray, "2 2"],
    std_px: float,
    outlier_fraction: float,
    outlier_px: tuple[float, float],
) -> tuple[Float[np.ndarray, "observations 2"], Bool[np.ndarray, " observations"]]:
    """Return noisy image points, and which of them are gross errors; all stay inside the image."""
    ties = np.flatnonzero(tracks.point_index >= tracks.num_marks)
    noisy = tracks.xy_px + std_px * rng.normal(size=tracks.xy_px.shape)
    is_outlier = _choose(rng, ties, len(noisy), outlier_fraction)
    offset = _gross(rng, is_outlier, outlier_px, 2)
    moved = noisy + offset
    # what would leave the image is moved the other way
    moved = np.where((moved < frame_px[0]) | (moved > frame_px[1]), noisy - offset, moved)
    return np.clip(moved, frame_px[0], frame_px[1]), is_outlier


def _choose(
    rng: np.random.Generator, candidates: Int[np.ndarray, " candidates"], size: int, fraction: float
) -> Bool[np.ndarray, " size"]:
    """Return a mask of `size` with this fraction of the candidates chosen."""
    chosen = np.zeros(size, bool)
    chosen[rng.permutation(candidates)[: round(fraction * len(candidates))]] = True
    return chosen


def _gross(
    rng: np.random.Generator, chosen: Bool[np.ndarray, " n"], size: tuple[float, float], dimension: int
) -> Float[np.ndarray, "n dimension"]:
    """Return offsets in random directions, of lengths between the two given, zero where not chosen."""
    direction = rng.normal(size=(len(chosen), dimension))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    return direction * (chosen * rng.uniform(*size, size=len(chosen)))[:, None]


def _vary(rng: np.random.Generator, camera: AbstractCamera, num_cameras: int) -> AbstractCamera:
    """Return cameras like the given one, one entry a camera; a single one is the given one itself."""
    spread = 1.0 if num_cameras > 1 else 0.0
    columns = []
    for name in camera.parameter_names():
        value, draw = float(getattr(camera, name)), spread * rng.normal(size=num_cameras)
        if name in _FOCAL:
            columns.append(value * (1 + 0.002 * draw))
        elif name in _CENTER:
            columns.append(value + 3.0 * draw)
        else:
            columns.append(value * (1 + 0.1 * draw))
    return type(camera)(*columns)


def _start_cameras(cameras: AbstractCamera, focal_error: float, center_px: Float[np.ndarray, "2"]) -> AbstractCamera:
    """Return the cameras with wrong focal lengths, centred principal points and no distortion."""
    columns = []
    for name in cameras.parameter_names():
        value = np.asarray(getattr(cameras, name))
        if name in _FOCAL:
            columns.append(value * (1 + focal_error))
        else:
            columns.append(np.full_like(value, center_px[_CENTER.index(name)] if name in _CENTER else 0.0))
    return type(cameras)(*columns)


def _pose(attitudes: Rotation, centers: Float[np.ndarray, "images 3"]) -> Pose:
    """Return the poses, in numpy, of attitudes `cam_from_world` at these centres."""
    return Pose(attitudes.as_quat(canonical=True, scalar_first=True), -attitudes.apply(centers))
