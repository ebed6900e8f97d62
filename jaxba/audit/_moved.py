"""What moved from a model to its new adjustment: each image's pose, each intrinsic.

The two blocks differ by a similarity that nothing fixes. It is fitted to the points that both have, robustly: a point
farther from its partner than `_FAR` times the median does not count. Poses are compared behind it.

By how much an image moved is told three ways: the shift of its place over the sigma of that place in the new block's
shape, in the unit of the world, and in pixels: how far its points lie apart in the photo when they are seen from the
model's pose and from the new one, through the new camera. Sigmas alone would name images of a large block that moved
by nothing that matters, pixels alone those of a weak one.
"""

import dataclasses
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from jaxba.audit._claims import points_in_cam, residuals_px
from jaxba.audit._readjust import Readjusted
from jaxba.geometry import CAMERAS, Similarity, umeyama
from jaxba.scene import Block
from jaxba.sfm import transformed

_FAR, _TURNS = 5.0, 20
_RING = 32  # rays around the image's middle


@dataclass(frozen=True, kw_only=True, eq=False)
class MovedImages:
    """How far the images of the new block lie from the model's, one row an image; NaN where it is not known.

    - `shift`: of its place, in units of the world (metres where control places it). `turn_rad`: of its attitude.
    - `over_sigma`: the shift over its sigma, of three coordinates together. `apart_px`: median over its points.
    """

    shift: Float[np.ndarray, " images"]
    turn_rad: Float[np.ndarray, " images"]
    over_sigma: Float[np.ndarray, " images"]
    apart_px: Float[np.ndarray, " images"]


@dataclass(frozen=True, kw_only=True)
class MovedIntrinsic:
    """An intrinsic of a camera that was adjusted.

    - `before`: by the model. `after`, `std`: by the new adjustment.
    - `apart_px`: the farthest that a pixel moves by this change alone.
    """

    camera: str
    name: str
    before: float
    after: float
    std: float
    apart_px: float

    @property
    def over_sigma(self) -> float:
        """The change over its sigma."""
        return abs(self.after - self.before) / self.std if self.std > 0 else np.nan


def moved_images(found: Readjusted) -> MovedImages:
    """Return how far each image of the new block lies from where the model has it."""
    new: Block = found.outputs.block
    rows = np.searchsorted(found.start.image_index, new.image_index)
    old = transformed(found.start, _onto(found.start, new))
    shift = old.centers_m[rows] - new.centers_m
    before, after = (Rotation.from_quat(of, scalar_first=True) for of in (old.quaternion[rows], new.quaternion))
    over_sigma = np.full(len(rows), np.nan)
    if found.center_covariance is not None:
        for k, covariance in enumerate(found.center_covariance):
            if np.linalg.cond(covariance) < 1e15:
                over_sigma[k] = np.sqrt(shift[k] @ np.linalg.solve(covariance, shift[k]))
    from_old = dataclasses.replace(new, quaternion=old.quaternion[rows], translation_m=old.translation_m[rows])
    apart = np.hypot(*(residuals_px(from_old) - residuals_px(new)).T)
    apart[points_in_cam(from_old)[:, 2] <= 0] = np.inf
    order = np.argsort(new.observation_image, kind="stable")
    ends = np.cumsum(np.bincount(new.observation_image, minlength=new.num_images))[:-1]
    return MovedImages(
        shift=np.linalg.norm(shift, axis=1),
        turn_rad=np.array((before * after.inv()).magnitude()),
        over_sigma=over_sigma,
        apart_px=np.array([np.median(part) if len(part) else np.nan for part in np.split(apart[order], ends)]),
    )


def _onto(old: Block, new: Block) -> Similarity:
    """Return the similarity from the model to the new block over the points of both."""
    source, target = old.points_m[new.track_index], new.points_m
    use = np.isfinite(target).all(axis=1)
    found = Similarity.identity()
    for _ in range(_TURNS):
        fitted = umeyama(source[use], target[use])
        if fitted is None:
            break
        found = fitted
        apart = np.linalg.norm(found.points(source) - target, axis=1)
        before, use = use, apart <= _FAR * np.median(apart)
        if np.array_equal(before, use):
            break
    return found


def moved_intrinsics(found: Readjusted) -> list[MovedIntrinsic]:
    """Return the intrinsics of every camera that were adjusted."""
    new: Block = found.outputs.block
    names = CAMERAS[new.camera_model].parameter_names()
    rows = []
    for camera, label in enumerate(new.camera_names):
        mine = np.flatnonzero(new.camera_index == camera)
        if not len(mine):
            continue
        photo = found.photos[int(new.image_index[mine[0]])]
        after, std = new.camera_parameters[camera], found.outputs.intrinsics_std[camera]
        before = found.start.camera_parameters[camera]
        for k, name in enumerate(names):
            if name in found.held or not std[k] > 0:
                continue
            changed = np.where(np.arange(len(names)) == k, before, after)
            rows.append(
                MovedIntrinsic(
                    camera=label, name=name, before=float(before[k]), after=float(after[k]), std=float(std[k]),
                    apart_px=_apart_px(new.camera_model, after, changed, photo.width_px, photo.height_px),
                )
            )  # fmt: skip
    return rows


def _apart_px(
    model: str,
    one: Float[np.ndarray, " parameters"],
    other: Float[np.ndarray, " parameters"],
    width_px: int,
    height_px: int,
) -> float:
    """Return the farthest that two cameras see a ray apart, over rays in the largest circle inside the image."""
    from jaxba.ba import project_in_cameras

    radius = min(width_px, height_px) / 2 / one[0]
    angle = 2 * np.pi * np.arange(_RING) / _RING
    ring = np.stack([np.cos(angle), np.sin(angle)]) * radius
    rays = np.concatenate([np.concatenate([ring, ring / 2, np.zeros((2, 1))], axis=1), np.ones((1, 2 * _RING + 1))])
    cameras = CAMERAS[model].from_parameters(np.stack([one, other]))
    seen = [project_in_cameras(cameras, np.full(rays.shape[1], k), rays) for k in (0, 1)]
    return float(np.max(np.hypot(*(seen[0] - seen[1]))))
