"""Simulated surveys as the stages see them: photos, reference, view graph, tracks, a block with start values, control.

Without photos and features, a survey and its adjustment take a second, so that hundreds can be drawn.
"""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial.transform import Rotation

from jaxba.geometry import umeyama
from jaxba.scene import Block, Control, LocalFrame, Photo, Reference, Tracks, ViewGraph
from jaxba.sfm import transformed
from jaxba.simulation.synthetic import Survey, uav_block

FRAME = LocalFrame(
    latitude_deg=50.0, longitude_deg=14.0, height_m=300.0, crs="EPSG:32633", epsg=32633,
    crs_name="WGS 84 / UTM zone 33N", unit="metre", height_note="simulated",
)  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class Simulated:
    """- `survey`: the simulation. `block`: with start values and no points. The rest: as the stages give them."""

    survey: Survey
    photos: tuple[Photo, ...]
    reference: Reference
    view_graph: ViewGraph
    tracks: Tracks
    block: Block


def simulate(
    num_images: int = 20,
    *,
    attitude_error_rad: float = 0.001,
    position_error_m: float = 0.05,
    points_per_image: float = 120.0,
    **options: Any,
) -> Simulated:
    """Return a survey of `uav_block`; the block starts at the truth with errors of poses and focal length."""
    survey = uav_block(num_images, attitude_error_rad=0.0, points_per_image=points_per_image, **options)
    truth, problem = survey.truth, survey.problem
    rng = np.random.default_rng(7)
    width, height = truth.image_size_px
    photos = tuple(
        Photo(name=f"DJI_{i:04d}.JPG", path=Path("."), sha256="", width_px=width, height_px=height,
              camera=f"camera {truth.camera_index[i]}")
        for i in range(num_images)
    )  # fmt: skip
    observations = problem.observations
    image, point = np.asarray(observations.image_index), np.asarray(observations.point_index)
    tracks = Tracks(
        track_index=point.astype(np.int64),
        image_index=image.astype(np.int64),
        feature_index=_number_within(image),
        xy_px=np.asarray(observations.xy_px),
        rgb=rng.integers(0, 255, (problem.num_points, 3)).astype(np.uint8),
        components=(tuple(range(num_images)),),
    )
    prior: Any = problem.prior("position")
    unknown = np.full((num_images, 3), np.nan)
    reference = Reference(
        frame=None if prior is None else FRAME,
        xyz_m=unknown if prior is None else np.asarray(prior.xyz),
        std_m=unknown if prior is None else np.asarray(prior.std_m),
        quaternion=np.full((num_images, 4), np.nan),
        attitude_std_rad=unknown,
        is_used=np.full(num_images, prior is not None),
        height_above_ground_m=np.full(num_images, np.nan),
    )
    rotation = Rotation.from_quat(np.asarray(truth.poses.quaternion), scalar_first=True)
    turned = Rotation.from_rotvec(attitude_error_rad * rng.normal(size=(num_images, 3))) * rotation
    centers = np.asarray(truth.poses.center) + position_error_m * rng.normal(size=(num_images, 3))
    names = type(problem.cameras).parameter_names()
    block = Block(
        image_index=np.arange(num_images),
        quaternion=turned.as_quat(scalar_first=True),
        translation_m=-turned.apply(centers),
        camera_model="OPENCV",
        camera_names=tuple(f"camera {c}" for c in range(problem.num_cameras)),
        camera_parameters=np.stack([np.asarray(getattr(problem.cameras, n)) for n in names], axis=1),
        camera_index=np.asarray(truth.camera_index).astype(np.int64),
        points_m=np.zeros((0, 3)),
        track_index=np.zeros(0, np.int64),
        rgb=np.zeros((0, 3), np.uint8),
        observation_image=np.zeros(0, np.int64),
        observation_point=np.zeros(0, np.int64),
        observation_xy_px=np.zeros((0, 2)),
        is_georeferenced=prior is not None,
    )
    return Simulated(
        survey=survey, photos=photos, reference=reference, view_graph=view_graph_of(tracks), tracks=tracks, block=block
    )


def true_block(simulated: Simulated) -> Block:
    """Return the block with its true poses and cameras."""
    truth = simulated.survey.truth
    names = type(truth.cameras).parameter_names()
    parameters = np.stack([np.atleast_1d(np.asarray(getattr(truth.cameras, n), float)) for n in names], axis=1)
    return replace(
        simulated.block,
        quaternion=np.asarray(truth.poses.quaternion),
        translation_m=np.asarray(truth.poses.translation),
        camera_parameters=parameters,
    )


def measured_anew(
    simulated: Simulated, rng: np.random.Generator, gnss_std_m: tuple[float, float, float], std_px: float = 0.5
) -> Simulated:
    """Return the same flight with errors of pixels and positions drawn anew: as many of each, in the same photos.

    The block starts where its positions put it, as after the start stage.
    """
    truth = simulated.survey.truth
    centers = np.asarray(truth.poses.center)
    std_m = np.tile(gnss_std_m, (len(centers), 1))
    reference = replace(
        simulated.reference, frame=FRAME, xyz_m=centers + std_m * rng.normal(size=centers.shape), std_m=std_m
    )
    tracks = replace(simulated.tracks, xy_px=truth.xy_px + std_px * rng.normal(size=truth.xy_px.shape))
    onto = umeyama(simulated.block.centers_m, reference.xyz_m)
    block = simulated.block if onto is None else transformed(simulated.block, onto)
    return replace(simulated, reference=reference, tracks=tracks, block=block)


def spread_control(
    simulated: Simulated,
    num_control: int,
    num_check: int,
    rng: np.random.Generator,
    *,
    std_m: tuple[float, float, float] = (0.02, 0.02, 0.03),
    mark_std_px: float = 0.3,
) -> Control:
    """Return points of the block as control and check points by turns, far from each other, in six photos or more.

    - `std_m`: of the survey. `mark_std_px`: of the marks, which nobody states.
    """
    truth, seen = simulated.survey.truth, simulated.survey.problem.observations
    point, image = np.asarray(seen.point_index), np.asarray(seen.image_index)
    chosen = _far_apart(truth.points, np.flatnonzero(np.bincount(point, minlength=len(truth.points)) >= 6),
                        num_control + num_check)  # fmt: skip
    is_check = np.zeros(len(chosen), bool)
    is_check[np.round(np.linspace(0, len(chosen) - 1, num_check)).astype(int)] = True
    rows = np.concatenate([np.flatnonzero(point == p) for p in chosen])
    sigmas = np.tile(std_m, (len(chosen), 1))
    numbers = {int(p): k for k, p in enumerate(chosen)}
    return Control(
        names=tuple(f"{'check' if check else 'gcp'}{k:02d}" for k, check in enumerate(is_check)),
        xyz_m=truth.points[chosen] + sigmas * rng.normal(size=sigmas.shape),
        std_m=sigmas,
        is_check=is_check,
        mark_point=np.array([numbers[int(p)] for p in point[rows]], dtype=np.int64),
        mark_image=image[rows].astype(np.int64),
        mark_xy_px=truth.xy_px[rows] + mark_std_px * rng.normal(size=(len(rows), 2)),
        mark_std_is_assumed=True,
    )


def _far_apart(
    points_m: Float[np.ndarray, "points 3"], rows: Int[np.ndarray, " rows"], count: int
) -> Int[np.ndarray, " count"]:
    chosen = [int(rows[0])]
    while len(chosen) < count:  # the farthest from those before
        away = np.linalg.norm(points_m[rows, None] - points_m[chosen], axis=2).min(axis=1)
        chosen.append(int(rows[np.argmax(away)]))
    return np.array(chosen)


def view_graph_of(tracks: Tracks) -> ViewGraph:
    """Return a view graph in which every two images of a track are matched."""
    first, second = _pairs(tracks.track_index)
    key = np.stack([tracks.image_index[first], tracks.image_index[second]], axis=1)
    order = np.lexsort((key[:, 1], key[:, 0]))
    pairs, counts = np.unique(key, axis=0, return_counts=True)
    matches = np.stack([tracks.feature_index[first], tracks.feature_index[second]], axis=1)[order]
    count = len(pairs)
    return ViewGraph(
        pairs=pairs, status=np.full(count, 2, np.uint8), offsets=np.concatenate([[0], np.cumsum(counts)]),
        matches=matches, num_putative=counts, is_planar=np.zeros(count, bool), quaternion=np.full((count, 4), np.nan),
        direction=np.full((count, 3), np.nan), residual_px=np.full(count, np.nan),
        distinctiveness=np.full(count, np.nan), angle_rad=np.full(count, np.nan),
    )  # fmt: skip


def _pairs(group: Int[np.ndarray, " n"]) -> tuple[Int[np.ndarray, " pairs"], Int[np.ndarray, " pairs"]]:
    """Return all pairs of rows with the same group; rows are sorted by it."""
    first, second = [], []
    for step in range(1, len(group)):
        same = np.flatnonzero(group[step:] == group[:-step])
        if not len(same):
            break
        first.append(same)
        second.append(same + step)
    return np.concatenate(first), np.concatenate(second)


def _number_within(group: Int[np.ndarray, " n"]) -> Int[np.ndarray, " n"]:
    order = np.argsort(group, kind="stable")
    starts = np.searchsorted(group[order], group[order])
    number = np.empty(len(group), np.int64)
    number[order] = np.arange(len(group)) - starts
    return number
