"""Measured attitudes in the local frame: each turned from north and up of its own place to those of the origin."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from jaxba.scene import Attitude, LocalFrame, cam_from_enu

MOVED_DEG = 1e-4
"""About 10 m: photos spread wider were not taken from one place."""
MIN_SAME = 5


def local_attitudes(
    frame: LocalFrame,
    attitudes: Sequence[Attitude | None],
    longitude_deg: Float[np.ndarray, " photos"],
    latitude_deg: Float[np.ndarray, " photos"],
    *,
    tilt_std_rad: float,
    yaw_std_rad: float,
) -> tuple[Float[np.ndarray, "photos 4"], Float[np.ndarray, "photos 3"], tuple[str, ...]]:
    """Return quaternions `cam_from_world` (scalar first), sigmas about the camera's axes, and notes; NaN without one.

    - `longitude_deg`, `latitude_deg`: of each photo; where NaN, the origin's north is taken.
    - `tilt_std_rad`: about any axis. `yaw_std_rad`: about the vertical, which a camera that looks down has for its own
      axis and a camera that looks ahead has as its y axis.

    In a flight that moves, attitudes that are zero in every photo are none, and where all photos have one and the same,
    its yaw is not believed.

    >>> frame = LocalFrame(latitude_deg=46.8, longitude_deg=-92.0, height_m=0.0, crs="EPSG:32615", epsg=32615,
    ...     crs_name="", unit="metre", height_note="")
    >>> down = Attitude(yaw_deg=90.0, pitch_deg=-90.0, roll_deg=0.0)
    >>> quaternion, std_rad, _ = local_attitudes(frame, [down], np.array([-92.0]), np.array([46.8]),
    ...     tilt_std_rad=0.03, yaw_std_rad=0.08)
    >>> std_rad.round(3).tolist()
    [[0.03, 0.03, 0.08]]
    """
    count = len(attitudes)
    quaternion, std_rad = np.full((count, 4), np.nan), np.full((count, 3), np.nan)
    rows = [k for k, attitude in enumerate(attitudes) if attitude is not None]
    distinct = {a for a in attitudes if a is not None}
    notes: list[str] = []
    places = np.stack([longitude_deg[rows], latitude_deg[rows]], axis=1)
    places = places[np.isfinite(places).all(axis=1)]
    if len(rows) >= MIN_SAME and len(distinct) == 1 and len(places) and np.ptp(places, axis=0).max() > MOVED_DEG:
        same = next(iter(distinct))
        if same == Attitude(yaw_deg=0.0, pitch_deg=0.0, roll_deg=0.0):
            return (
                quaternion,
                std_rad,
                (f"Attitudes are zero in all {len(rows)} photos that have one: a placeholder, none is used.",),
            )
        notes.append(
            f"Attitudes are the same in all {len(rows)} photos that have one (yaw {same.yaw_deg:g}, pitch "
            f"{same.pitch_deg:g}, roll {same.roll_deg:g} degrees): a setting rather than a measurement? Their yaw is "
            "not used."
        )
        yaw_std_rad = np.pi
    origin = _enu_from_ecef(frame.longitude_deg, frame.latitude_deg)
    for k in rows:
        attitude, lon, lat = attitudes[k], float(longitude_deg[k]), float(latitude_deg[k])
        assert attitude is not None
        here = _enu_from_ecef(lon, lat) if np.isfinite(lon) and np.isfinite(lat) else origin
        cam_from_here = cam_from_enu(attitude)
        quaternion[k] = Rotation.from_matrix(cam_from_here @ here @ origin.T).as_quat(canonical=True, scalar_first=True)
        up = cam_from_here[:, 2]
        std_rad[k] = np.sqrt(tilt_std_rad**2 + max(yaw_std_rad**2 - tilt_std_rad**2, 0.0) * up**2)
    return quaternion, std_rad, tuple(notes)


def _enu_from_ecef(longitude_deg: float, latitude_deg: float) -> Float[np.ndarray, "3 3"]:
    """Return the rotation from earth-centred axes to east, north, up at a place."""
    sin_lon, cos_lon = np.sin(np.radians(longitude_deg)), np.cos(np.radians(longitude_deg))
    sin_lat, cos_lat = np.sin(np.radians(latitude_deg)), np.cos(np.radians(latitude_deg))
    return np.array(
        [
            [-sin_lon, cos_lon, 0.0],
            [-sin_lat * cos_lon, -sin_lat * sin_lon, cos_lat],
            [cos_lat * cos_lon, cos_lat * sin_lon, sin_lat],
        ]
    )
