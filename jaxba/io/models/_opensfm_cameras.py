"""OpenSfM's cameras in one of jaxba's models for a block.

    perspective                             RADIAL, f = focal side, the principal point in the middle
    brown, radial, simple_radial            OPENCV, and a perspective one beside them
    fisheye_opencv, fisheye                 OPENCV_FISHEYE; the latter has k1 and k2 alone

with `side` the longer one of the image.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from jaxba._errors import JaxbaError
from jaxba.io.models._opensfm_fields import number, told

_FISHEYE = "fisheye_opencv", "fisheye"
_LONGEST_PX = 1e7
_KINDS = "perspective", "brown", "radial", "simple_radial", *_FISHEYE


@dataclass(frozen=True, kw_only=True, eq=False)
class OpensfmCameras:
    """Cameras in one of jaxba's models, a row each."""

    model: str
    names: tuple[str, ...]
    parameters: Float[np.ndarray, "cameras parameters"]
    size_px: Int[np.ndarray, "cameras 2"]

    @staticmethod
    def of(file: Path, cameras: Mapping[str, Mapping[str, Any]]) -> "OpensfmCameras":
        """Return the cameras of a file; raises `JaxbaError` for kinds that jaxba has not or cannot join."""
        kinds = {}
        for name, camera in cameras.items():
            kind = kinds[name] = camera.get("projection_type", "perspective")
            if kind not in _KINDS:
                raise JaxbaError(
                    f"{file}: camera {name} is of the kind {told(kind)}, which jaxba has not; it has "
                    f"{', '.join(_KINDS)}. Reconstruct with one of these."
                )
        fisheye = [name for name, kind in kinds.items() if kind in _FISHEYE]
        if fisheye and len(fisheye) < len(kinds):
            other = next(name for name in kinds if name not in fisheye)
            raise JaxbaError(
                f"{file}: camera {fisheye[0]} is {kinds[fisheye[0]]} and {other} is {kinds[other]}; all cameras of a "
                "block have one model. Audit each camera's reconstruction by itself."
            )
        model = "OPENCV_FISHEYE" if fisheye else "OPENCV"
        if all(kind == "perspective" for kind in kinds.values()):
            model = "RADIAL"
        rows, sizes = [], []
        for name, camera in cameras.items():
            of = f"camera {name}"
            width, height = (number(file, of, camera, key) for key in ("width", "height"))
            if not (1 <= width < _LONGEST_PX and 1 <= height < _LONGEST_PX):
                raise JaxbaError(f"{file}: {of} is {width:g} x {height:g} pixels; set width and height of its images.")
            rows.append(_parameters(file, of, camera, kinds[name], model, width, height))
            sizes.append([int(width), int(height)])
        return OpensfmCameras(
            model=model, names=tuple(cameras), parameters=np.array(rows), size_px=np.array(sizes, np.int64)
        )


def _parameters(
    file: Path, of: str, camera: Mapping[str, Any], kind: str, model: str, width: float, height: float
) -> list[float]:
    """Return a camera's parameters in the order of the model."""
    side = max(width, height)

    def value(key: str, default: float | None = 0.0) -> float:
        return number(file, of, camera, key, default)

    if kind in ("perspective", "fisheye"):
        fx = fy = value("focal", None) * side
        cx, cy = width / 2, height / 2
    else:
        fx, fy = value("focal_x", None) * side, value("focal_y", None) * side
        cx, cy = value("c_x") * side + width / 2, value("c_y") * side + height / 2
    if not (fx > 0 and fy > 0):
        raise JaxbaError(f"{file}: {of} has a focal length of {min(fx, fy) / side:g}, which is not above 0.")
    if model == "RADIAL":
        return [fx, cx, cy, value("k1"), value("k2")]
    if model == "OPENCV":
        return [fx, fy, cx, cy, value("k1"), value("k2"), value("p1"), value("p2"), value("k3")]
    return [fx, fy, cx, cy, value("k1"), value("k2"), value("k3"), value("k4")]
