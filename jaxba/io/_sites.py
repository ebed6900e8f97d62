"""Where photos were taken and how they looked, as a table with one row a photo: the adjusted ones, then the others."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial.transform import Rotation

from jaxba.scene import Attitude, Block, Photo, Reference, cam_from_enu

_NED_FROM_ENU = np.array([[0.0, 1, 0], [1, 0, 0], [0, 0, -1]])
_CAM_FROM_BODY = cam_from_enu(Attitude(yaw_deg=0.0, pitch_deg=0.0, roll_deg=0.0)) @ _NED_FROM_ENU


@dataclass(frozen=True, kw_only=True, eq=False)
class Sites:
    """Where photos were taken, one row a photo; NaN where a number is not known.

    - `xyz_m`: in the local frame. `is_registered`: the place is adjusted; else it is the measured one.
    - `std_m`: sigma of the adjusted place, local east, north, up. `gnss_residual_m`: adjusted minus measured, likewise.
    - `attitude_deg`: yaw, pitch and roll of the adjusted camera, as drones write them. `heading_deg`: direction that
      the top of the photo points to, clockwise from north. Both from the local frame's north.
    - `num_observations`, `median_error_px`: of the photo. `reason`: why it is not registered, else empty.
    """

    name: tuple[str, ...]
    camera: tuple[str, ...]
    xyz_m: Float[np.ndarray, "photos 3"]
    is_registered: Bool[np.ndarray, " photos"]
    std_m: Float[np.ndarray, "photos 3"]
    gnss_residual_m: Float[np.ndarray, "photos 3"]
    attitude_deg: Float[np.ndarray, "photos 3"]
    heading_deg: Float[np.ndarray, " photos"]
    num_observations: Int[np.ndarray, " photos"]
    median_error_px: Float[np.ndarray, " photos"]
    reason: tuple[str, ...]


def make_sites(
    block: Block,
    photos: Sequence[Photo],
    reference: Reference,
    *,
    std_m: Float[np.ndarray, "images 3"],
    gnss_residual_m: Float[np.ndarray, "images 3"],
    error_px: Float[np.ndarray, " observations"],
) -> Sites:
    """Return a row for each photo that has a place, in the photos' order.

    - `photos`, `reference`: of all images. `std_m`, `gnss_residual_m`: of the block's. `error_px`: of its observations.
    """
    row_of = {int(index): row for row, index in enumerate(block.image_index)}
    reasons = {left.name: left.reason for left in block.unregistered}
    has_place = np.isfinite(reference.xyz_m.sum(axis=1))
    shown = [i for i in range(len(photos)) if i in row_of or has_place[i]]
    rows = np.array([row_of.get(i, -1) for i in shown], dtype=np.int64)
    is_registered = rows >= 0
    counts = np.bincount(block.observation_image, minlength=block.num_images)
    of_image = np.split(error_px[np.argsort(block.observation_image, kind="stable")], np.cumsum(counts)[:-1])
    medians = np.array([np.median(errors) if len(errors) else np.nan for errors in of_image])
    rotation = Rotation.from_quat(block.quaternion, scalar_first=True).as_matrix()
    reason = []
    for i, found in zip(shown, is_registered, strict=True):
        known = found or np.isfinite(reference.std_m[i, 2])
        why = "" if found else reasons.get(photos[i].name, "not registered")
        reason.append(why if known else f"{why} (its height is not known; the survey's stands in for it)")

    def of_block(values: np.ndarray, missing: float | int) -> np.ndarray:
        """Return the values of the block's images in the table's order."""
        table = np.full((len(shown), *values.shape[1:]), missing, values.dtype)
        table[is_registered] = values[rows[is_registered]]
        return table

    return Sites(
        name=tuple(photos[i].name for i in shown),
        camera=tuple(photos[i].camera for i in shown),
        xyz_m=np.where(is_registered[:, None], of_block(block.centers_m, np.nan), reference.xyz_m[shown]),
        is_registered=is_registered,
        std_m=of_block(np.asarray(std_m), np.nan),
        gnss_residual_m=of_block(np.asarray(gnss_residual_m), np.nan),
        attitude_deg=of_block(attitude_deg(rotation), np.nan),
        heading_deg=of_block(heading_deg(rotation), np.nan),
        num_observations=of_block(counts, 0),
        median_error_px=of_block(medians, np.nan),
        reason=tuple(reason),
    )


def attitude_deg(cam_from_world: Float[np.ndarray, "images 3 3"]) -> Float[np.ndarray, "images 3"]:
    """Return yaw, pitch, roll of which `cam_from_enu` makes these rotations; roll is 0 straight down.

    Near straight down yaw and roll are not apart: a camera that leans sideways by one degree has a roll of 90.
    """
    ned_from_body = _NED_FROM_ENU @ np.swapaxes(cam_from_world, 1, 2) @ _CAM_FROM_BODY
    pitch = np.arcsin(np.clip(-ned_from_body[:, 2, 0], -1, 1))
    is_vertical = np.hypot(ned_from_body[:, 0, 0], ned_from_body[:, 1, 0]) < 1e-9
    yaw = np.arctan2(ned_from_body[:, 1, 0], ned_from_body[:, 0, 0])
    roll = np.arctan2(ned_from_body[:, 2, 1], ned_from_body[:, 2, 2])
    yaw = np.where(is_vertical, np.arctan2(-ned_from_body[:, 0, 1], ned_from_body[:, 1, 1]), yaw)
    return np.degrees(np.stack([yaw, pitch, np.where(is_vertical, 0.0, roll)], axis=1))


def heading_deg(cam_from_world: Float[np.ndarray, "images 3 3"]) -> Float[np.ndarray, " images"]:
    """Return the direction of the top of photos that look down, and of view of those that look ahead; 0 to 360.

    It is that of the sum of both axes, which equals yaw where roll is 0.
    """
    ahead_and_up = cam_from_world[:, 2] - cam_from_world[:, 1]
    return np.degrees(np.arctan2(ahead_and_up[:, 0], ahead_and_up[:, 1])) % 360
