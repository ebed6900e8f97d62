"""Attitudes as drones write them, and the rotation that they mean.

Yaw, pitch and roll turn a camera that looks along the aircraft's nose: yaw clockwise from true north, pitch up from the
horizon (-90 looks straight down), roll clockwise about the viewing direction, in the order yaw, pitch, roll (z-y'-x''
in north-east-down), which is DJI's gimbal convention. Other conventions are converted where they are read.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float


@dataclass(frozen=True, kw_only=True)
class Attitude:
    """Yaw, pitch and roll of a camera, degrees, in the convention of this module."""

    yaw_deg: float
    pitch_deg: float
    roll_deg: float


_NED_FROM_ENU = np.array([[0.0, 1, 0], [1, 0, 0], [0, 0, -1]])
_CAM_FROM_BODY = np.array([[0.0, 1, 0], [0, 0, 1], [1, 0, 0]])  # body: x ahead, y right, z down; camera: z ahead


def cam_from_enu(attitude: Attitude) -> Float[np.ndarray, "3 3"]:
    """Return the rotation from local east, north, up to the camera's frame (x right, y down, z forward).

    >>> down = cam_from_enu(Attitude(yaw_deg=0.0, pitch_deg=-90.0, roll_deg=0.0))
    >>> (down @ [0, 1, 0]).round(6).tolist()  # north is at the top of a photo taken straight down
    [0.0, -1.0, 0.0]
    """
    from scipy.spatial.transform import Rotation

    angles = [attitude.yaw_deg, attitude.pitch_deg, attitude.roll_deg]
    ned_from_body = Rotation.from_euler("ZYX", angles, degrees=True).as_matrix()
    return _CAM_FROM_BODY @ ned_from_body.T @ _NED_FROM_ENU
