"""Images that the view graph's rotations left out, added by the points that other images have fixed.

Minimal samples of three points with a consensus on all (poselib), then its refinement. Points and pixels meet through
the tracks. What one round adds fixes more points, which the next one uses.
"""

import dataclasses

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial.transform import Rotation

from jaxba.scene import Block, Tracks
from jaxba.sfm._points import with_points
from jaxba.sfm._rays import make_rays
from jaxba.sfm._start_cameras import StartCameras

MIN_INLIERS = 12  # with fewer points a wrong pose finds support by chance


def register_more(
    block: Block,
    tracks: Tracks,
    cameras: StartCameras,
    component: Int[np.ndarray, " n"],
    reasons: dict[int, str],
    min_angle_rad: float,
    max_error_px: float,
) -> Block:
    """Return the block with images added whose points fix their pose; `reasons` says it of the others."""
    while True:
        missing = np.setdiff1d(component, block.image_index)
        found = [resect(block, tracks, int(i), int(cameras.of_image[i]), max_error_px, MIN_INLIERS) for i in missing]
        good = [f for f in found if f.is_found]
        for f in found:
            if not f.is_found:
                text = f"{f.num_inliers} of its {f.num_points} points agree on a pose, {MIN_INLIERS} are needed"
                reasons.setdefault(f.image, text)
        if not good:
            return block
        index = np.concatenate([block.image_index, [f.image for f in good]])
        order = np.argsort(index)
        block = dataclasses.replace(
            block,
            image_index=index[order],
            quaternion=np.concatenate([block.quaternion, [f.quaternion for f in good]])[order],
            translation_m=np.concatenate([block.translation_m, [f.translation_m for f in good]])[order],
            camera_index=cameras.of_image[index[order]],
        )
        block = with_points(block, tracks, min_angle_rad=min_angle_rad, max_error_px=max_error_px)


@dataclasses.dataclass(frozen=True)
class Resected:
    """A pose, and the numbers that say why where there is none (NaN)."""

    image: int
    num_points: int
    num_inliers: int
    quaternion: Float[np.ndarray, "4"] = dataclasses.field(default_factory=lambda: np.full(4, np.nan))
    translation_m: Float[np.ndarray, "3"] = dataclasses.field(default_factory=lambda: np.full(3, np.nan))

    @property
    def is_found(self) -> bool:
        return bool(np.isfinite(self.quaternion).all())


def resect(
    block: Block, tracks: Tracks, image: int, camera_row: int, max_error_px: float, min_inliers: int
) -> Resected:
    """Return the pose of an image that is not in the block from the block's points, if enough of them agree.

    Enough are `min_inliers`, and a quarter of those that it sees. `camera_row`: of the block's cameras.
    """
    import poselib

    rows = np.flatnonzero(tracks.image_index == image)
    point_of_track = np.full(tracks.num_tracks, -1)
    point_of_track[block.track_index] = np.arange(block.num_points)
    point = point_of_track[tracks.track_index[rows]]
    rows, point = rows[point >= 0], point[point >= 0]
    alone = dataclasses.replace(
        block,
        image_index=np.array([image]),
        quaternion=np.array([[1.0, 0, 0, 0]]),
        translation_m=np.zeros((1, 3)),
        camera_index=np.array([camera_row]),
    )
    ray = make_rays(alone, np.zeros(len(rows), int), tracks.xy_px[rows]).direction.T
    ahead = np.isfinite(ray).all(axis=1) & (ray[:, 2] > 0.05)
    ray, point = ray[ahead], point[ahead]
    if len(ray) < min_inliers:
        return Resected(image, len(ray), 0)
    focal = float(block.camera_parameters[camera_row, 0])
    camera = {"model": "SIMPLE_PINHOLE", "width": 1, "height": 1, "params": [focal, 0.0, 0.0]}
    shift = block.points_m[point].mean(axis=0)
    pose, found = poselib.estimate_absolute_pose(
        focal * ray[:, :2] / ray[:, 2:], block.points_m[point] - shift, camera,
        {"max_reproj_error": max_error_px, "max_iterations": 10_000, "seed": 0}, {},
    )  # fmt: skip
    num_inliers = int(found["num_inliers"])
    if num_inliers < max(min_inliers, 0.25 * len(ray)):
        return Resected(image, len(ray), num_inliers)
    quaternion = np.asarray(pose.q)
    rotation = Rotation.from_quat(quaternion, scalar_first=True).as_matrix()
    return Resected(image, len(ray), num_inliers, quaternion, np.asarray(pose.t) - rotation @ shift)
