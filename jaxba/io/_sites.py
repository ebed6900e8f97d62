"""Where photos were taken and how they looked, as a table with one row a photo: the adjusted ones, then the others.

**Omega, phi, kappa** are those of photogrammetry, as Metashape and Pix4D have them: `R = Rx(omega) Ry(phi) Rz(kappa)`
takes the camera's axes (x right, y up, z backwards) to those of the grid (x, y of the CRS, and up). A photo that looks
straight down has omega and phi 0, and kappa is the turn of its right side from the grid's x axis, anticlockwise.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial.transform import Rotation

from jaxba.scene import Attitude, Block, Photo, Reference, cam_from_enu

SITE_COLUMNS = {
    "name": "file name of the photo, with its folder below that of the photos",
    "camera": "camera of the photo; photos of one camera share its focal length and distortion",
    "registered": "true: the place is the adjusted one; false: the photo is not in the block, the place is measured",
    "std_e_m": "sigma of the adjusted place along true east, metres; empty where it is not known",
    "std_n_m": "sigma along true north, metres; empty where it is not known",
    "std_u_m": "sigma up, metres; empty where it is not known",
    "gnss_residual_e_m": "adjusted minus measured place along true east, less its flight's offset, metres; "
    "empty where none was used",
    "gnss_residual_n_m": "adjusted minus measured place along true north, less its flight's offset, metres; "
    "empty where none was used",
    "gnss_residual_u_m": "adjusted minus measured place up, less its flight's offset, metres; "
    "empty where none was used",
    "yaw_deg": "yaw of the camera, degrees clockwise from true north, as drones write it; undetermined straight down",
    "pitch_deg": "pitch of the camera, degrees: 0 level, -90 straight down",
    "roll_deg": "roll of the camera, degrees: positive with the right side down; undetermined straight down",
    "heading_deg": "direction that the top of the photo points to, degrees clockwise from true north, 0 to 360",
    "omega_deg": "omega, degrees, of R = Rx(omega) Ry(phi) Rz(kappa) from the camera (x right, y up, z backwards) to "
    "the grid (x, y of the CRS, and up); 0 straight down",
    "phi_deg": "phi, degrees, of the same; 0 straight down",
    "kappa_deg": "kappa, degrees, of the same; straight down the turn of the photo's right side from the grid's x "
    "axis, anticlockwise, -180 to 180",
    "num_observations": "image points of the photo that take part in the adjustment",
    "median_error_px": "median reprojection error of the photo, pixels",
    "reason": "why the photo is not registered; empty where it is",
}
_NED_FROM_ENU = np.array([[0.0, 1, 0], [1, 0, 0], [0, 0, -1]])
_CAM_FROM_BODY = cam_from_enu(Attitude(yaw_deg=0.0, pitch_deg=0.0, roll_deg=0.0)) @ _NED_FROM_ENU


@dataclass(frozen=True, kw_only=True, eq=False)
class Sites:
    """Where photos were taken, one row a photo; NaN where a number is not known.

    - `xyz_m`: in the local frame. `is_registered`: the place is adjusted; else it is the measured one.
    - `std_m`: sigma of the adjusted place, local east, north, up. `gnss_residual_m`: adjusted minus measured, likewise.
    - `attitude_deg`: yaw, pitch and roll of the adjusted camera, as drones write them. `heading_deg`: direction that
      the top of the photo points to, clockwise from north. Both from the local frame's north.
    - `omega_phi_kappa_deg`: of the adjusted camera, in the grid of the target CRS.
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
    omega_phi_kappa_deg: Float[np.ndarray, "photos 3"]
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
    grid_from_local: Float[np.ndarray, "images 3 3"],
) -> Sites:
    """Return a row for each photo that has a place, in the photos' order.

    - `photos`, `reference`: of all images. `std_m`, `gnss_residual_m`: of the block's. `error_px`: of its observations.
    - `grid_from_local`: rotation to the grid's axes at each of the block's images.
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
        omega_phi_kappa_deg=of_block(omega_phi_kappa_deg(grid_from_local @ np.swapaxes(rotation, 1, 2)), np.nan),
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


def omega_phi_kappa_deg(grid_from_cam: Float[np.ndarray, "images 3 3"]) -> Float[np.ndarray, "images 3"]:
    """Return omega, phi, kappa of cameras (x right, y down, z forward); omega is 0 where phi is 90 or -90 degrees.

    >>> omega_phi_kappa_deg(np.diag([1.0, -1.0, -1.0])[None]).tolist()  # straight down, the top to the grid's north
    [[0.0, 0.0, 0.0]]
    """
    r = grid_from_cam * np.array([1.0, -1.0, -1.0])
    level = np.hypot(r[:, 0, 0], r[:, 0, 1])
    phi, is_sideways = np.arctan2(r[:, 0, 2], level), level < 1e-9
    omega = np.where(is_sideways, 0.0, np.arctan2(-r[:, 1, 2], r[:, 2, 2]))
    kappa = np.where(is_sideways, np.arctan2(r[:, 1, 0], r[:, 1, 1]), np.arctan2(-r[:, 0, 1], r[:, 0, 0]))
    return np.degrees(np.stack([omega, phi, kappa], axis=1)) + 0.0  # no -0.0


def heading_deg(cam_from_world: Float[np.ndarray, "images 3 3"]) -> Float[np.ndarray, " images"]:
    """Return the direction of the top of photos that look down, and of view of those that look ahead; 0 to 360.

    It is that of the sum of both axes, which equals yaw where roll is 0.
    """
    ahead_and_up = cam_from_world[:, 2] - cam_from_world[:, 1]
    return np.degrees(np.arctan2(ahead_and_up[:, 0], ahead_and_up[:, 1])) % 360
