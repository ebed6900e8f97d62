"""Blocks as OpenSfM's `reconstruction.json`: cameras, shots, points, and the origin on earth.

OpenSfM's world is local east, north, up around `reference_lla`, its poses are angle-axis and translation of
`cam_from_world`: as in a block. Its cameras count in units of the image's longer side from the image's centre,

    u = (x_px - width / 2) / max(width, height)

so focal length and principal point are divided by it. Models without fisheye become `brown`, whose five coefficients
are OpenCV's by name and formula (OpenSfM's documentation, "Geometric Models", where its code has 2 x_n^2 for 2 x).
"""

import json
import os
from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial.transform import Rotation

from jaxba._atomic import write_atomically
from jaxba._errors import JaxbaError
from jaxba.scene import Block, LocalFrame, Photo

_BROWN = ("k1", "k2", "p1", "p2", "k3")
_NAMES = {
    "SIMPLE_PINHOLE": ("f", "cx", "cy"),
    "PINHOLE": ("fx", "fy", "cx", "cy"),
    "SIMPLE_RADIAL": ("f", "cx", "cy", "k1"),
    "RADIAL": ("f", "cx", "cy", "k1", "k2"),
    "OPENCV": ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3"),
    "OPENCV_FISHEYE": ("fx", "fy", "cx", "cy", "k1", "k2", "k3", "k4"),
}


def write_opensfm(
    path: str | os.PathLike[str],
    block: Block,
    photos: Sequence[Photo],
    frame: LocalFrame | None,
    gnss_xyz_m: Float[np.ndarray, "images 3"],
    gnss_std_m: Float[np.ndarray, "images 3"],
) -> None:
    """Write a block as `reconstruction.json`, whole or not at all.

    - `photos`: of the registered images. `frame`: of the block's world; None where it has no place on earth.
    - `gnss_xyz_m`, `gnss_std_m`: measured positions of the images in the world and their sigmas; NaN where unknown.

    Raises:
        JaxbaError: a camera model that OpenSfM has not; or the file cannot be written.
    """
    content: dict[str, Any] = {"cameras": _cameras(block, photos)}
    content["shots"] = _shots(block, photos, gnss_xyz_m, gnss_std_m)
    content["points"] = {
        str(row + 1): {"color": [float(c) for c in rgb], "coordinates": xyz}
        for row, (xyz, rgb) in enumerate(zip(block.points_m.tolist(), block.rgb.tolist(), strict=True))
    }
    if frame is not None:
        content["reference_lla"] = {
            "latitude": frame.latitude_deg,
            "longitude": frame.longitude_deg,
            "altitude": frame.height_m,
        }
    text = json.dumps([content], indent=1, allow_nan=False, ensure_ascii=False) + "\n"
    with write_atomically(path) as file:
        file.write(text.encode())


def opensfm_camera(
    model: str, parameters: Float[np.ndarray, " parameters"], size_px: Int[np.ndarray, "2"]
) -> dict[str, Any]:
    """Return a camera as OpenSfM writes it.

    >>> opensfm_camera("SIMPLE_PINHOLE", np.array([800.0, 500, 380]), np.array([1000, 750]))["c_y"]
    0.005
    """
    if model not in _NAMES:
        raise JaxbaError(f"camera model {model}: OpenSfM has none like it; choose one of {', '.join(_NAMES)}.")
    values = dict(zip(_NAMES[model], map(float, parameters), strict=True))
    width, height = (int(side) for side in size_px)
    side = max(width, height)
    is_fisheye = model == "OPENCV_FISHEYE"
    return {
        "projection_type": "fisheye_opencv" if is_fisheye else "brown",
        "width": width,
        "height": height,
        "focal_x": values.get("fx", values.get("f", 0.0)) / side,
        "focal_y": values.get("fy", values.get("f", 0.0)) / side,
        "c_x": (values["cx"] - width / 2) / side,
        "c_y": (values["cy"] - height / 2) / side,
        **{name: values.get(name, 0.0) for name in (("k1", "k2", "k3", "k4") if is_fisheye else _BROWN)},
    }


def _cameras(block: Block, photos: Sequence[Photo]) -> dict[str, Any]:
    sizes = {int(row): (p.width_px, p.height_px) for row, p in zip(block.camera_index, photos, strict=True)}
    return {
        block.camera_names[row]: opensfm_camera(block.camera_model, block.camera_parameters[row], np.array(size))
        for row, size in sorted(sizes.items())
    }


def _shots(
    block: Block,
    photos: Sequence[Photo],
    gnss_xyz_m: Float[np.ndarray, "images 3"],
    gnss_std_m: Float[np.ndarray, "images 3"],
) -> dict[str, Any]:
    rotation = Rotation.from_quat(block.quaternion, scalar_first=True).as_rotvec().tolist()
    shots = {}
    for row, photo in enumerate(photos):
        shot: dict[str, Any] = {
            "rotation": rotation[row],
            "translation": block.translation_m[row].tolist(),
            "camera": block.camera_names[block.camera_index[row]],
            "orientation": photo.orientation,
        }
        if np.isfinite(gnss_xyz_m[row]).all():
            shot["gps_position"] = gnss_xyz_m[row].tolist()
            if np.isfinite(gnss_std_m[row, 0]):
                shot["gps_dop"] = float(gnss_std_m[row, 0])
        shots[photo.name] = {**shot, "vertices": [], "faces": [], "scale": 1.0, "covariance": [], "merge_cc": 0}
    return shots
