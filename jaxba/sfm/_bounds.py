"""Which adjusted intrinsics lie at their bounds."""

from collections.abc import Sequence
from dataclasses import dataclass

from jaxba.geometry import CAMERAS
from jaxba.scene import Block, Photo
from jaxba.sfm._problem import natural_intrinsics

_MARGIN = 1e-3  # of the way between the bounds


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
