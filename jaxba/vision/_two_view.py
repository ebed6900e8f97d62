"""Verify the matches of two images by their geometry, and find the relative pose.

Models. With both focal lengths known: an essential matrix by poselib's LO-RANSAC (five points, then refined), whose
pose is right on flat ground where OpenCV's is often not. Without: a fundamental matrix by OpenCV's MAGSAC. Beside it a
homography by MAGSAC. All are pinhole models with the principal point at the centre; the threshold takes up the
distortion. Seeds are fixed: the same matches give the same result.

Choice by the geometric robust information criterion (Torr 1998, "Geometric motion segmentation and model selection",
eq. 12 to 14), over n matches with residuals e and a sigma of half the threshold:

    GRIC = sum min(e^2 / sigma^2, 2 (4 - d)) + n d log 4 + k log 4n

d is 2 for a homography and 3 for an epipolar geometry; k is 8 and 5 (essential) or 7 (fundamental). The threshold of
the epipolar geometry is that of the homography, unless it is set.

Planes. Matches that keep to the epipolar lines and lie off the plane by up to 20 thresholds are trees and roofs, 4 to
7% of the inliers on flat nadir surveys, and tell most of heights: they stay. A homography decomposes to two poses that
differ by some 10 degrees and fit points of the plane alike (Ma et al. 2004, "An invitation to 3-D vision", 5.3): of
those that explain nine tenths of the inliers of the best, the one nearest to the attitudes is taken where they tell.
Attitudes that are far from all of them, as of photos stored upside down, are not believed.

Cost: about 5 ms a pair of some hundred matches.
"""

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from jaxtyping import Bool, Float

_ITERATIONS = {"min_iterations": 100, "max_iterations": 5000}
_MAGSAC_ITERATIONS = 5000
_RELIEF = 20.0
_BELIEVABLE_RAD = 0.25


@dataclass(frozen=True, kw_only=True, eq=False)
class PosePrior:
    """What attitudes and positions tell of a relative pose `x_j = R x_i + t`; sigmas in radians.

    - `rotation`, `rotation_std_rad`: R. `direction`, `direction_std_rad`: of t; None where positions do not tell.
    """

    rotation: Float[np.ndarray, "3 3"]
    rotation_std_rad: float
    direction: Float[np.ndarray, "3"] | None = None
    direction_std_rad: float = np.inf


@dataclass(frozen=True, kw_only=True, eq=False)
class TwoView:
    """What verification made of a pair's matches.

    - `is_inlier`: of each match. `is_planar`: the homography is the better model.
    - `model`: the better one; `none` where neither explains enough. `num_explained`: inliers of it, also then.
    - `rotation`, `direction`: `x_j = R x_i + t`, t of unit length; NaN without a pose.
    - `fundamental`: `y^T F x = 0` of pixels: the pose's, or estimated; NaN where a plane alone explains the matches.
    - `residual_px`: median over the inliers, of the chosen model. `angle_rad`: median angle between the inliers' rays.
    """

    is_inlier: Bool[np.ndarray, " matches"]
    is_planar: bool
    model: Literal["none", "essential", "fundamental", "homography"]
    num_explained: int
    rotation: Float[np.ndarray, "3 3"]
    direction: Float[np.ndarray, "3"]
    fundamental: Float[np.ndarray, "3 3"]
    residual_px: float
    angle_rad: float

    @property
    def num_inliers(self) -> int:
        return int(np.count_nonzero(self.is_inlier))


@dataclass(frozen=True, kw_only=True)
class Pinhole:
    """Size of an image, and its focal length where it is known."""

    width_px: int
    height_px: int
    focal_px: float | None

    @property
    def center_px(self) -> Float[np.ndarray, "2"]:
        return np.array([self.width_px / 2, self.height_px / 2])

    def rays(self, xy_px: Float[np.ndarray, "matches 2"]) -> Float[np.ndarray, "matches 3"]:
        """Return directions in the camera's frame, of unit length."""
        rays = np.column_stack([(xy_px - self.center_px) / self.focal_px, np.ones(len(xy_px))])
        return rays / np.linalg.norm(rays, axis=1, keepdims=True)

    def matrix(self) -> Float[np.ndarray, "3 3"]:
        focal = 1.0 if self.focal_px is None else self.focal_px
        return np.array([[focal, 0, self.center_px[0]], [0, focal, self.center_px[1]], [0, 0, 1.0]])


def verify(
    first_px: Float[np.ndarray, "matches 2"],
    second_px: Float[np.ndarray, "matches 2"],
    first: Pinhole,
    second: Pinhole,
    *,
    threshold_px: float,
    epipolar_threshold_px: float | None = None,
    confidence: float = 0.99,
    min_inliers: int = 12,
    prior: PosePrior | None = None,
) -> TwoView:
    """Return the inliers of the better of two models, and the relative pose where the focal lengths are known.

    `threshold_px`: of the homography, and of the epipolar geometry where `epipolar_threshold_px` is None.

    Matches that lie at the same pixel of both images are none of the scene's: a watermark, dust on the sensor, the
    aircraft's own gear. They are outliers. Fewer than `min_inliers` inliers of the rest count as none.

    >>> rng = np.random.default_rng(0)
    >>> points = rng.uniform([-3, -3, 8], [3, 3, 12], (50, 3))
    >>> camera = Pinhole(width_px=1000, height_px=1000, focal_px=1000.0)
    >>> first, second = (p[:, :2] / p[:, 2:] * 1000 + 500 for p in (points, points - [1.0, 0, 0]))
    >>> found = verify(first, second, camera, camera, threshold_px=1.0)
    >>> int(found.is_inlier.sum()), (found.direction + 0).round(3).tolist()
    (50, [-1.0, 0.0, 0.0])
    """
    moved = np.linalg.norm(first_px - second_px, axis=1) > 1.0
    x, y = first_px[moved], second_px[moved]
    if len(x) < max(min_inliers, 8):
        return _nothing(len(moved), 0)
    line_px = threshold_px if epipolar_threshold_px is None else epipolar_threshold_px
    calibrated = first.focal_px is not None and second.focal_px is not None
    pose = _essential(x, y, first, second, line_px, confidence) if calibrated else None
    fundamental = _fundamental_of(pose, first, second) if pose else _fundamental(x, y, line_px, confidence)
    homography = _homography(x, y, threshold_px, confidence)
    epipolar_px = sampson_px(fundamental, x, y) if fundamental is not None else np.full(len(x), np.inf)
    plane_px = transfer_px(homography, x, y) if homography is not None else np.full(len(x), np.inf)
    plane_gric = _gric(2 * plane_px / threshold_px, 2, 8)
    is_planar = plane_gric < _gric(2 * epipolar_px / line_px, 3, 5 if pose else 7)
    residual = plane_px if is_planar else epipolar_px
    relief = (epipolar_px < line_px) & (plane_px < _RELIEF * threshold_px)
    inlier = (plane_px < threshold_px) | relief if is_planar else epipolar_px < line_px
    num_explained = int(np.count_nonzero(inlier))
    if num_explained < min_inliers:
        return _nothing(len(moved), num_explained)
    is_inlier = moved.copy()
    is_inlier[moved] = inlier
    rotation, direction, angle = np.full((3, 3), np.nan), np.full(3, np.nan), np.nan
    if calibrated and pose is not None:
        if is_planar and homography is not None and prior is not None:
            pose = _nearest_pose(pose, homography, x[inlier], y[inlier], first, second, line_px, prior)
        length = float(np.linalg.norm(pose.t))
        rotation, direction = np.asarray(pose.R), np.asarray(pose.t) / (length if length > 0 else 1.0)
        cosine = np.sum((first.rays(x[inlier]) @ rotation.T) * second.rays(y[inlier]), axis=1)
        angle = float(np.median(np.arccos(np.clip(cosine, -1, 1))))
        fundamental = _fundamental_of(pose, first, second) if length > 0 else None
    if fundamental is None or (is_planar and pose is None):  # a plane's is anybody's
        fundamental = np.full((3, 3), np.nan)
    return TwoView(
        is_inlier=is_inlier,
        is_planar=bool(is_planar),
        model="homography" if is_planar else "essential" if pose is not None else "fundamental",
        num_explained=num_explained,
        rotation=rotation,
        direction=direction,
        fundamental=fundamental,
        residual_px=float(np.median(residual[inlier])),
        angle_rad=angle,
    )


def sampson_px(
    fundamental: Float[np.ndarray, "3 3"],
    first_px: Float[np.ndarray, "matches 2"],
    second_px: Float[np.ndarray, "matches 2"],
) -> Float[np.ndarray, " matches"]:
    """Return the Sampson distance of each match, pixels (Hartley and Zisserman 2004, eq. 11.9)."""
    x, y = _homogeneous(first_px), _homogeneous(second_px)
    line_second, line_first = x @ fundamental.T, y @ fundamental
    squared = np.sum(line_second[:, :2] ** 2, axis=1) + np.sum(line_first[:, :2] ** 2, axis=1)
    return np.abs(np.sum(y * line_second, axis=1)) / np.sqrt(np.maximum(squared, np.finfo(float).tiny))


def transfer_px(
    homography: Float[np.ndarray, "3 3"],
    first_px: Float[np.ndarray, "matches 2"],
    second_px: Float[np.ndarray, "matches 2"],
) -> Float[np.ndarray, " matches"]:
    """Return how far each match is from where the homography puts it: the larger of both directions, pixels."""
    try:
        inverse = np.linalg.inv(homography)
    except np.linalg.LinAlgError:
        return np.full(len(first_px), np.inf)
    forth = _mapped(homography, first_px) - second_px
    back = _mapped(inverse, second_px) - first_px
    distance = np.maximum(np.linalg.norm(forth, axis=1), np.linalg.norm(back, axis=1))
    return np.where(np.isfinite(distance), distance, np.inf)


def _gric(relative: Float[np.ndarray, " matches"], dimension: int, parameters: int) -> float:
    count = len(relative)
    cost = np.minimum(relative**2, 2.0 * (4 - dimension)).sum()
    return float(cost + count * dimension * np.log(4) + parameters * np.log(4 * count))


def _essential(x: Any, y: Any, first: Pinhole, second: Pinhole, threshold_px: float, confidence: float) -> Any:
    import poselib

    options = _ITERATIONS | {"max_epipolar_error": threshold_px, "success_prob": confidence, "seed": 0}
    pose, _ = poselib.estimate_relative_pose(x, y, _camera(first), _camera(second), options, {})
    return pose


def _fundamental(x: Any, y: Any, threshold_px: float, confidence: float) -> Float[np.ndarray, "3 3"] | None:
    import cv2

    found, _ = cv2.findFundamentalMat(x, y, cv2.USAC_MAGSAC, threshold_px, confidence, _MAGSAC_ITERATIONS)
    return found if found is not None and found.shape == (3, 3) else None


def _homography(x: Any, y: Any, threshold_px: float, confidence: float) -> Float[np.ndarray, "3 3"] | None:
    import cv2

    found, _ = cv2.findHomography(
        x, y, cv2.USAC_MAGSAC, threshold_px, maxIters=_MAGSAC_ITERATIONS, confidence=confidence
    )
    return found


def _nearest_pose(
    pose: Any, homography: Any, x: Any, y: Any, first: Pinhole, second: Pinhole, threshold_px: float, prior: PosePrior
) -> Any:
    """Return the pose nearest to the prior: the essential matrix's, or one of the two of the plane, each refined."""
    import poselib

    calibrated = np.linalg.inv(second.matrix()) @ homography @ first.matrix()
    rays_first, rays_second = first.rays(x), second.rays(y)
    if np.median(np.sum(rays_second * (rays_first @ calibrated.T), axis=1)) < 0:
        calibrated = -calibrated  # its scale makes depths positive
    poses, normals = poselib.motion_from_homography(calibrated)
    ahead = [np.mean(rays_first @ normal > 0) > 0.9 for normal in np.asarray(normals)]
    candidates = [pose]
    for candidate in (p for p, is_ahead in zip(poses, ahead, strict=True) if is_ahead):
        if np.linalg.norm(candidate.t) > 0:
            refined, _ = poselib.refine_relative_pose(x, y, candidate, _camera(first), _camera(second), {})
            candidates.append(refined)
    distances = [sampson_px(_fundamental_of(candidate, first, second), x, y) for candidate in candidates]
    explained = np.array([np.count_nonzero(distance < threshold_px) for distance in distances])
    possible = [c for c, count in zip(candidates, explained, strict=True) if count >= 0.9 * explained.max()]
    nearest = min(possible, key=lambda candidate: _misfit(candidate, prior))
    believable = max(_BELIEVABLE_RAD, 4 * prior.rotation_std_rad)
    return nearest if _angle_rad(nearest, prior) < believable else pose


def _misfit(pose: Any, prior: PosePrior) -> float:
    """Return the squared deviation from the prior in units of its sigmas."""
    misfit = (_angle_rad(pose, prior) / prior.rotation_std_rad) ** 2
    length = np.linalg.norm(pose.t)
    if prior.direction is not None and length > 0:
        angle = np.arccos(np.clip(np.asarray(pose.t) @ prior.direction / length, -1, 1))
        misfit += (angle / prior.direction_std_rad) ** 2
    return float(misfit)


def _angle_rad(pose: Any, prior: PosePrior) -> float:
    """Return the angle of the rotation between a pose and its prior."""
    turn = np.asarray(pose.R) @ prior.rotation.T
    return float(np.arccos(np.clip((np.trace(turn) - 1) / 2, -1, 1)))


def _camera(pinhole: Pinhole) -> dict[str, Any]:
    width, height = pinhole.width_px, pinhole.height_px
    params = [pinhole.focal_px, *pinhole.center_px]
    return {"model": "SIMPLE_PINHOLE", "width": width, "height": height, "params": params}


def _fundamental_of(pose: Any, first: Pinhole, second: Pinhole) -> Float[np.ndarray, "3 3"]:
    t = np.asarray(pose.t)
    cross = np.array([[0, -t[2], t[1]], [t[2], 0, -t[0]], [-t[1], t[0], 0]])
    return np.linalg.inv(second.matrix()).T @ cross @ np.asarray(pose.R) @ np.linalg.inv(first.matrix())


def _homogeneous(xy_px: Float[np.ndarray, "matches 2"]) -> Float[np.ndarray, "matches 3"]:
    return np.column_stack([xy_px, np.ones(len(xy_px))])


def _mapped(
    homography: Float[np.ndarray, "3 3"], xy_px: Float[np.ndarray, "matches 2"]
) -> Float[np.ndarray, "matches 2"]:
    mapped = _homogeneous(xy_px) @ homography.T
    with np.errstate(divide="ignore", invalid="ignore"):
        return mapped[:, :2] / mapped[:, 2:]


def _nothing(num_matches: int, num_explained: int) -> TwoView:
    return TwoView(
        is_inlier=np.zeros(num_matches, bool),
        is_planar=False,
        model="none",
        num_explained=num_explained,
        rotation=np.full((3, 3), np.nan),
        direction=np.full(3, np.nan),
        fundamental=np.full((3, 3), np.nan),
        residual_px=np.nan,
        angle_rad=np.nan,
    )
