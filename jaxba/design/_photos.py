"""A block that might be flown: its photos, the ground, and the adjustment problem that they would make.

Nothing is measured: pixels are those of the true places, so that the problem stands at its solution, and what its
covariance says is what can be expected.
"""

from dataclasses import dataclass

import equinox as eqx
import numpy as np
from jaxtyping import Float, Int
from scipy.spatial.transform import Rotation

from jaxba._errors import JaxbaError
from jaxba.ba import (
    AbstractPrior,
    AspectPrior,
    IntrinsicsPrior,
    Observations,
    PositionOffsetPrior,
    PositionPrior,
    Problem,
    project_in_cameras,
)
from jaxba.design._ground import Ground
from jaxba.design._sections import Gnss, Ties
from jaxba.geometry import AbstractCamera, Pose
from jaxba.simulation import Images, Tracks, field_of_view, make_tracks

_MOST_TILT = 2.75  # horizontal over vertical, 70 degrees: beyond it ground is too flat in view to match
_FOCAL_STD, _CENTER_STD, _K_STD, _P_STD, _ASPECT_STD = 0.05, 0.01, 0.2, 0.01, 5e-4  # known of a camera beforehand
_MARK_BORDER = 0.004  # of the photo's longer side: nearer to its edge no target is marked


@dataclass(frozen=True, eq=False)
class Photos:
    """Photos of a block.

    - `center_m`: east, north, up. `cam_from_world`: rotations. `camera_index`: of each photo, in `cameras`.
    - `cameras`: one model, an entry a camera. `size_px`: columns and rows of their photos.
    """

    center_m: Float[np.ndarray, "images 3"]
    cam_from_world: Float[np.ndarray, "images 3 3"]
    cameras: AbstractCamera
    camera_index: Int[np.ndarray, " images"]
    size_px: tuple[int, int]

    @property
    def num(self) -> int:
        return len(self.center_m)

    @property
    def frame_px(self) -> Float[np.ndarray, "2 2"]:
        """Lowest and highest pixel coordinates; a camera without a principal point counts from its middle."""
        corner = np.zeros(2) if "cx" in self.cameras.parameter_names() else -np.array(self.size_px) / 2
        return np.stack([corner, corner + self.size_px])

    @property
    def view(self) -> Float[np.ndarray, "2 2"]:
        """Lowest and highest x/z and y/z in view of the first camera."""
        names = self.cameras.parameter_names()
        first = type(self.cameras)(*(float(np.atleast_1d(getattr(self.cameras, name))[0]) for name in names))
        return field_of_view(first, self.frame_px)

    @property
    def poses(self) -> Pose:
        rotation = Rotation.from_matrix(self.cam_from_world)
        return Pose(rotation.as_quat(canonical=True, scalar_first=True), -rotation.apply(self.center_m))

    def and_more(self, center_m: Float[np.ndarray, "n 3"], cam_from_world: Float[np.ndarray, "n 3 3"]) -> "Photos":
        """Return them with more photos of the first camera."""
        return Photos(
            np.concatenate([self.center_m, center_m]),
            np.concatenate([self.cam_from_world, cam_from_world]),
            self.cameras,
            np.append(self.camera_index, np.zeros(len(center_m), self.camera_index.dtype)),
            self.size_px,
        )


def problem_of(photos: Photos, ground: Ground, ties: Ties, gnss: Gnss, *, seed: int = 0) -> Problem:
    """Return what the adjustment of a block without control points would be, all of it at its true values.

    Raises `JaxbaError` where the photos see too little, or the block falls into parts.
    """
    tracks = _tie_points(photos, ground, ties, np.random.default_rng(seed))
    every = np.arange(photos.num, dtype=np.int32)
    priors: list[AbstractPrior] = [
        PositionPrior(image_index=every, xyz=photos.center_m, std_m=np.tile(gnss.std_m, (photos.num, 1))),
        *_of_cameras(photos),
    ]
    has_offset = max(gnss.common_std_m) > 0
    if has_offset:
        priors.append(PositionOffsetPrior(xyz=np.zeros((1, 3)), std_m=np.maximum([gnss.common_std_m], 1e-6)))
    observations = Observations(
        tracks.xy_px,
        np.full(len(tracks.xy_px), ties.std_px),
        tracks.image_index.astype(np.int32),
        tracks.point_index.astype(np.int32),
    )
    problem = Problem.build(
        photos.poses, photos.cameras, tracks.points, observations, camera_index=photos.camera_index, priors=priors
    )
    if "k3" in photos.cameras.parameter_names():
        problem = problem.fix(intrinsics=["k3"])
    if has_offset:
        offset = np.zeros((1, 3)), np.array(True)
        problem = eqx.tree_at(lambda p: (p.position_offset, p.free.position_offset), problem, offset)
    return problem


def _tie_points(photos: Photos, ground: Ground, ties: Ties, rng: np.random.Generator) -> Tracks:
    def terrain(plan_m: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, " n"]:
        return np.asarray(ground.at(plan_m), float)[:, 2]

    low = float(np.min(ground.height_m))
    above = photos.center_m[:, 2] - low
    reach = float(np.max(above[:, None] * _horizontal(photos)))
    nadir = float(np.median(above)) * np.abs(photos.view).max(axis=0)
    images = Images(
        photos.center_m, photos.cam_from_world, photos.cameras, photos.camera_index, photos.frame_px, 0.0, photos.view
    )
    try:
        return make_tracks(
            rng,
            images,
            terrain,
            reach_m=np.full(2, reach),
            beyond_m=nadir,
            num_tie=round(ties.points_per_image * photos.num),
            mean_length=ties.mean_track_length,
            num_marks=0,
        )
    except JaxbaError as error:
        raise JaxbaError(f"the photos would not make a block: {error}") from None


def marks(
    photos: Photos, xyz_m: Float[np.ndarray, "points 3"]
) -> tuple[Int[np.ndarray, " marks"], Int[np.ndarray, " marks"], Float[np.ndarray, "marks 2"]]:
    """Return the photo, the point and the pixel of all marks of some points, ordered by point."""
    in_cam = np.einsum("nij,pnj->pni", photos.cam_from_world, xyz_m[:, None] - photos.center_m)
    view = photos.view
    with np.errstate(divide="ignore", invalid="ignore"):
        slope = in_cam[..., :2] / in_cam[..., 2:]
    ahead = (in_cam[..., 2] > 0) & np.all((slope > view[0]) & (slope < view[1]), axis=-1)
    point, image = np.nonzero(ahead)
    xy_px = project_in_cameras(photos.cameras, photos.camera_index[image], in_cam[point, image].T).T
    border = _MARK_BORDER * max(photos.size_px)
    low, high = photos.frame_px[0] + border, photos.frame_px[1] - border
    inside = np.all((xy_px > low) & (xy_px < high), axis=1)
    return image[inside], point[inside], xy_px[inside]


def _horizontal(photos: Photos) -> Float[np.ndarray, "images 4"]:
    """Return how far, over the height, the corners of each photo see."""
    (left, top), (right, bottom) = photos.view
    corners = np.array([[left, top, 1.0], [left, bottom, 1.0], [right, top, 1.0], [right, bottom, 1.0]])
    rays = np.einsum("nji,cj->nci", photos.cam_from_world, corners)
    down = np.maximum(-rays[..., 2], 1e-9)
    return np.minimum(np.linalg.norm(rays[..., :2], axis=-1) / down, _MOST_TILT)


def _of_cameras(photos: Photos) -> list[AbstractPrior]:
    """Return what is known of cameras before the flight, as weakly as a run takes it."""
    names = photos.cameras.parameter_names()
    columns = [np.atleast_1d(np.asarray(getattr(photos.cameras, name), float)) for name in names]
    std = {
        **dict.fromkeys(("f", "fx", "fy"), _FOCAL_STD * columns[0]),
        **dict.fromkeys(("cx", "cy"), np.full(len(columns[0]), _CENTER_STD * photos.size_px[0])),
        **dict.fromkeys(("p1", "p2"), np.full(len(columns[0]), _P_STD)),
    }
    index = np.arange(len(columns[0]), dtype=np.int32)
    sigmas = np.stack([std.get(name, np.full(len(index), _K_STD)) for name in names], axis=1)
    priors: list[AbstractPrior] = [
        IntrinsicsPrior(camera_index=index, parameters=np.stack(columns, axis=1), std=sigmas)
    ]
    if names[:2] == ("fx", "fy"):
        ratio = columns[0] / columns[1]
        priors.append(AspectPrior(camera_index=index, ratio=ratio, std=np.full(len(index), _ASPECT_STD)))
    return priors
