"""A block's intrinsics: which of them it can calibrate, what is known of them beforehand, and which end at a bound.

Known are what the photos tell of the focal length, a principal point in the middle within 1% of the width, and that
distortion is small. Bounds hold off what no lens is like.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from jaxba.geometry import CAMERAS
from jaxba.scene import Block, Photo

FOCAL_BOUNDS = (0.7, 1.4)
BOUNDS = {"k1": 0.5, "k2": 0.5, "k3": 0.5, "k4": 0.5, "p1": 0.05, "p2": 0.05}
_STD = {"k1": 0.2, "k2": 0.2, "k3": 0.2, "k4": 0.2, "p1": 0.01, "p2": 0.01}
_FOCAL_STD = {"given": 0.02, "calibrated": 0.02, "focal_plane": 0.05, "sensor_table": 0.05, "equivalent_35mm": 0.07}
_FOCAL_UNKNOWN_STD = 0.3
_CENTER_STD, _CENTER_BOUND = 0.01, 0.1  # of the image's width
_MARGIN = 1e-3  # of the way between the bounds
_LEAST_IMAGES_ALL_FREE = 8


def free_parameters(camera_model: str, *, num_images: int) -> tuple[str, ...]:
    """Return the parameters that a block of so many images can calibrate: focal length and k1 only in a small one."""
    names = CAMERAS[camera_model].parameter_names()
    if num_images >= _LEAST_IMAGES_ALL_FREE:
        return tuple(name for name in names if not (camera_model == "OPENCV" and name == "k3"))
    return tuple(name for name in names if name in ("f", "fx", "fy", "k1"))


@dataclass(frozen=True)
class NaturalIntrinsics:
    """What is known of the cameras beforehand, and their bounds; a row a camera."""

    center: Float[np.ndarray, "cameras parameters"]
    std: Float[np.ndarray, "cameras parameters"]
    lower: Float[np.ndarray, "cameras parameters"]
    upper: Float[np.ndarray, "cameras parameters"]


def natural_intrinsics(block: Block, photos: Sequence[Photo]) -> NaturalIntrinsics:
    """Return priors and bounds of the cameras of a block that has not been adjusted yet."""
    names = CAMERAS[block.camera_model].parameter_names()
    center, std = np.zeros(block.camera_parameters.shape), np.zeros(block.camera_parameters.shape)
    lower, upper = np.zeros(center.shape), np.zeros(center.shape)
    for c in range(len(center)):
        members = [photos[i] for i in block.image_index[block.camera_index == c]] or list(photos[:1])
        width, height = members[0].width_px, members[0].height_px
        focal, share = _focal(members)
        for k, name in enumerate(names):
            if name in ("f", "fx", "fy"):
                value = block.camera_parameters[c, k] if focal is None else focal
                low, high = (factor * value for factor in FOCAL_BOUNDS)
                row = value, share * value, low, high
            elif name in ("cx", "cy"):
                value = (width if name == "cx" else height) / 2
                row = value, _CENTER_STD * width, value - _CENTER_BOUND * width, value + _CENTER_BOUND * width
            else:
                row = 0.0, _STD[name], -BOUNDS[name], BOUNDS[name]
            center[c, k], std[c, k], lower[c, k], upper[c, k] = row
    return NaturalIntrinsics(center, std, lower, upper)


@dataclass(frozen=True, kw_only=True)
class AtBound:
    """An intrinsic of a camera at a bound: its value, and what is allowed."""

    camera: str
    parameter: str
    value: float
    low: float
    high: float


def intrinsics_at_bounds(block: Block, start: Block, photos: Sequence[Photo]) -> tuple[AtBound, ...]:
    """Return the intrinsics of an adjusted block that lie at a bound; `start` is the block before the adjustment."""
    natural = natural_intrinsics(start, photos)
    found = []
    for c, camera in enumerate(block.camera_names):
        for k, name in enumerate(CAMERAS[block.camera_model].parameter_names()):
            low, high = float(natural.lower[c, k]), float(natural.upper[c, k])
            value, margin = float(block.camera_parameters[c, k]), _MARGIN * (high - low)
            if value <= low + margin or value >= high - margin:
                found.append(AtBound(camera=camera, parameter=name, value=value, low=low, high=high))
    return tuple(found)


def _focal(members: Sequence[Photo]) -> tuple[float | None, float]:
    """Return the focal length that the photos tell, and its sigma as a share."""
    known = [(p.focal_px, p.focal_source) for p in members if p.focal_px is not None]
    if not known:
        return None, _FOCAL_UNKNOWN_STD
    return float(np.median([focal for focal, _ in known])), _FOCAL_STD[known[0][1] or "equivalent_35mm"]
