"""Attitudes of camera and aircraft, from the tags of each maker to the one convention of `jaxba.scene.Attitude`.

- DJI, and Autel under `drone:`: GimbalYawDegree ... in just that convention; FlightYawDegree ... of the aircraft.
- Parrot: CameraYawDegree ... likewise; DroneYawDegree ... of the aircraft.
- Pix4D's `Camera:Yaw`, `Pitch`, `Roll`, which senseFly, Parrot Sequoia, older Autel and MicaSense write: the body frame
  of a camera that looks down, so that pitch is 0 at nadir and 90 at the horizon ahead:

      ned_from_gimbal = Rz(yaw) Ry(pitch) Rx(roll) Ry(-90 deg)

  with the photo's top towards the body's x axis. (Programs disagree on the sign of senseFly's roll: OpenDroneMap turns
  it, Orthority does not; here it is Pix4D's, positive with the right wing down.)

Three exact zeros in a gimbal's tags are what a drone writes that does not know its attitude.
"""

import math

import numpy as np

from jaxba.scene import Attitude
from jaxba.vision._exif import Tags

_GIMBALS = (
    "drone-dji:Gimbal{}Degree", "drone:Gimbal{}Degree", "drone-parrot:Camera{}Degree",
)  # fmt: skip
_AIRCRAFT = ("drone-dji:Flight{}Degree", "drone:Flight{}Degree", "drone-parrot:Drone{}Degree")


def find_attitudes(tags: Tags, notes: list[str]) -> tuple[Attitude | None, Attitude | None]:
    """Return the attitudes of the camera and of the aircraft, each None where the tags do not tell it."""
    camera = None
    for pattern in _GIMBALS:
        camera = camera or _read(tags, pattern)
    if camera == Attitude(yaw_deg=0.0, pitch_deg=0.0, roll_deg=0.0):
        notes.append(
            "yaw, pitch and roll of the gimbal are all 0, as written when they are not known: counted as absent."
        )
        camera = None
    aircraft = None
    for pattern in _AIRCRAFT:
        aircraft = aircraft or _read(tags, pattern)
    body = _read(tags, "Camera:{}")
    if camera is None and body is not None:
        camera = attitude_from_nadir_body(body.yaw_deg, body.pitch_deg, body.roll_deg)
    return camera, aircraft


def attitude_from_nadir_body(yaw_deg: float, pitch_deg: float, roll_deg: float) -> Attitude:
    """Return the attitude of a camera that looks down from a body with these angles (Pix4D's convention).

    >>> attitude_from_nadir_body(30.0, 45.0, 0.0)
    Attitude(yaw_deg=30.0, pitch_deg=-45.0, roll_deg=0.0)
    """
    from scipy.spatial.transform import Rotation

    body = Rotation.from_euler("ZYX", [yaw_deg, pitch_deg, roll_deg], degrees=True)
    matrix = (body * Rotation.from_euler("Y", -90.0, degrees=True)).as_matrix()
    pitch = math.degrees(math.asin(float(np.clip(-matrix[2, 0], -1.0, 1.0))))
    if math.hypot(matrix[0, 0], matrix[1, 0]) > 1e-6:
        yaw, roll = math.atan2(matrix[1, 0], matrix[0, 0]), math.atan2(matrix[2, 1], matrix[2, 2])
    else:  # straight down or up, where only the sum or difference of yaw and roll means something
        yaw, roll = math.atan2(-matrix[0, 1], matrix[1, 1]), 0.0
    yaw_deg, roll_deg = math.degrees(yaw), math.degrees(roll)
    return Attitude(yaw_deg=round(yaw_deg, 9) + 0.0, pitch_deg=round(pitch, 9), roll_deg=round(roll_deg, 9) + 0.0)


def _read(tags: Tags, pattern: str) -> Attitude | None:
    yaw, pitch, roll = (tags.xmp_number(pattern.format(angle)) for angle in ("Yaw", "Pitch", "Roll"))
    if yaw is None or pitch is None or roll is None:
        return None
    return Attitude(yaw_deg=yaw, pitch_deg=pitch, roll_deg=roll)
