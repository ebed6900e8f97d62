"""Synthetic surveys as the stages before `start` would hand them on: photos, reference, view graph, tracks, truth."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from jaxba.scene import EdgeStatus, LocalFrame, Photo, Reference, Tracks, ViewGraph
from jaxba.simulation import Survey, uav_block

FRAME = LocalFrame(
    latitude_deg=50.0, longitude_deg=-0.1, height_m=30.0, crs="EPSG:32630", epsg=32630,
    crs_name="WGS 84 / UTM zone 30N", unit="metre", height_note="above the ellipsoid",
)  # fmt: skip


@dataclass(frozen=True)
class Case:
    photos: tuple[Photo, ...]
    reference: Reference
    view_graph: ViewGraph
    tracks: Tracks
    survey: Survey
    is_wrong: np.ndarray  # edges

    @property
    def rotations(self) -> np.ndarray:
        return Rotation.from_quat(np.asarray(self.survey.truth.poses.quaternion), scalar_first=True).as_matrix()

    @property
    def centers(self) -> np.ndarray:
        return -np.einsum("nji,nj->ni", self.rotations, np.asarray(self.survey.truth.poses.translation))


def make_case(
    num_images: int = 30,
    *,
    seed: int = 0,
    wrong_edges: float = 0.0,
    rotation_noise_rad: float = 0.01,
    direction_noise_rad: float = 0.02,
    gnss_std_m: tuple[float, float, float] | None = (1.0, 1.0, 2.0),
    attitude_std_rad: float | None = None,
    focal_error: float = 0.01,
    **options: object,
) -> Case:
    """Return a survey with relative poses from its truth plus noise, some of them grossly wrong."""
    options = {"points_per_image": 180.0, "mean_track_length": 4.5, "outlier_fraction": 0.01} | options
    survey = uav_block(num_images, seed=seed, gnss_std_m=gnss_std_m, **options)
    truth, seen = survey.truth, survey.problem.observations
    rng = np.random.default_rng(seed)
    image, point = np.asarray(seen.image_index), np.asarray(seen.point_index)
    order = np.lexsort((image, point))
    _, track = np.unique(point[order], return_inverse=True)
    image = image[order]
    tracks = Tracks(
        track_index=track, image_index=image.astype(int), feature_index=np.arange(len(image)),
        xy_px=np.asarray(seen.xy_px)[order], rgb=np.full((track.max() + 1, 3), 99, np.uint8),
        components=(tuple(range(num_images)),),
    )  # fmt: skip
    view_graph, is_wrong = _view_graph(
        survey, tracks, num_images, rng, wrong_edges, rotation_noise_rad, direction_noise_rad
    )
    width, height = truth.image_size_px
    focal = float(np.ravel(truth.cameras.focal_and_center()[0])[0]) * (1 + focal_error)
    photos = tuple(
        Photo(
            name=f"{k:03d}.jpg", path=Path(f"{k:03d}.jpg"), sha256="0", width_px=width, height_px=height, camera="c",
            focal_px=focal, focal_source="focal_plane",
        )
        for k in range(num_images)
    )  # fmt: skip
    return Case(photos, _reference(survey, num_images, rng, attitude_std_rad), view_graph, tracks, survey, is_wrong)


def _reference(survey: Survey, num_images: int, rng: np.random.Generator, attitude_std_rad: float | None) -> Reference:
    nothing = np.full((num_images, 3), np.nan)
    prior = survey.problem.prior("position")
    quaternion, attitude_std = np.full((num_images, 4), np.nan), nothing
    if attitude_std_rad is not None:
        true = Rotation.from_quat(np.asarray(survey.truth.poses.quaternion), scalar_first=True)
        noisy = Rotation.from_rotvec(attitude_std_rad * rng.normal(size=(num_images, 3))) * true
        quaternion = noisy.as_quat(canonical=True, scalar_first=True)
        attitude_std = np.full((num_images, 3), attitude_std_rad)
    return Reference(
        frame=None if prior is None else FRAME,
        xyz_m=nothing if prior is None else np.asarray(prior.xyz),
        std_m=nothing if prior is None else np.asarray(prior.std_m),
        quaternion=quaternion,
        attitude_std_rad=attitude_std,
        is_used=np.full(num_images, prior is not None),
        height_above_ground_m=np.full(num_images, np.nan),
    )


def _view_graph(
    survey: Survey,
    tracks: Tracks,
    num_images: int,
    rng: np.random.Generator,
    wrong_edges: float,
    rotation_noise_rad: float,
    direction_noise_rad: float,
) -> tuple[ViewGraph, np.ndarray]:
    sees = np.zeros((num_images, tracks.num_tracks))
    sees[tracks.image_index, tracks.track_index] = 1
    shared = np.triu(sees @ sees.T, 1).astype(int)
    pairs = np.argwhere(shared >= 12)
    count = shared[pairs[:, 0], pairs[:, 1]]
    true = Rotation.from_quat(np.asarray(survey.truth.poses.quaternion), scalar_first=True)
    translation = np.asarray(survey.truth.poses.translation)
    relative = true[pairs[:, 1]] * true[pairs[:, 0]].inv()
    shift = translation[pairs[:, 1]] - relative.apply(translation[pairs[:, 0]])
    direction = shift / np.linalg.norm(shift, axis=1, keepdims=True)
    is_wrong = np.zeros(len(pairs), bool)
    is_wrong[rng.permutation(len(pairs))[: round(wrong_edges * len(pairs))]] = True
    noise = rotation_noise_rad * rng.normal(size=(len(pairs), 3)) / np.sqrt(3)
    axis = rng.normal(size=(len(pairs), 3))
    axis *= rng.uniform(0.2, 1.5, size=(len(pairs), 1)) / np.linalg.norm(axis, axis=1, keepdims=True)
    turned = Rotation.from_rotvec(np.where(is_wrong[:, None], axis, noise)) * relative
    direction = direction + direction_noise_rad * rng.normal(size=direction.shape)
    direction[is_wrong] = rng.normal(size=(is_wrong.sum(), 3))
    return ViewGraph(
        pairs=pairs.astype(np.int32),
        status=np.full(len(pairs), EdgeStatus.GOOD, np.uint8),
        offsets=np.concatenate([[0], np.cumsum(count)]).astype(np.int64),
        matches=np.zeros((count.sum(), 2), np.int32),
        num_putative=(2 * count).astype(np.int32),
        is_planar=np.zeros(len(pairs), bool),
        quaternion=turned.as_quat(canonical=True, scalar_first=True),
        direction=direction / np.linalg.norm(direction, axis=1, keepdims=True),
        residual_px=np.full(len(pairs), 0.5),
        distinctiveness=np.full(len(pairs), 0.5),
        angle_rad=np.full(len(pairs), 0.2),
    ), is_wrong
