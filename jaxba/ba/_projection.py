"""Projection of a problem's observations at its present values, for checks and quality: numpy in, numpy out.

The camera model runs in pieces of `_CHUNK` observations, so it compiles once (0.1 s) whatever the problem.
"""

import equinox as eqx
import jax
import numpy as np
from jax import Array
from jaxtyping import Float, Int
from scipy.spatial.transform import Rotation

from jaxba.ba._problem import Problem
from jaxba.geometry import AbstractCamera, Pose

_CHUNK = 16384
_PIECE = 500_000  # observations, some 150 bytes each, that are worked on at a time


def rotation_matrices(poses: Pose) -> Float[np.ndarray, "images 3 3"]:
    """Return the rotations `cam_from_world`."""
    return Rotation.from_quat(np.asarray(poses.quaternion, float), scalar_first=True).as_matrix()


def camera_centers(poses: Pose) -> Float[np.ndarray, "images 3"]:
    """Return where the cameras stand in the world, metres."""
    rotation = Rotation.from_quat(np.array(poses.quaternion, float), scalar_first=True)
    return -rotation.apply(np.array(poses.translation, float), inverse=True)


def points_in_cam(problem: Problem) -> Float[np.ndarray, "3 observations"]:
    """Return each observed point in the frame of its camera, metres; the last component is the depth."""
    image, point = np.asarray(problem.observations.image_index), np.asarray(problem.observations.point_index)
    rotations = rotation_matrices(problem.poses).reshape(-1, 9).T
    translations = np.asarray(problem.poses.translation, float).T
    points = np.asarray(problem.points, float).T
    found = np.empty((3, len(image)))
    for start in range(0, len(image), _PIECE):
        piece = slice(start, start + _PIECE)
        rotation, translation = rotations[:, image[piece]], translations[:, image[piece]]
        x, y, z = points[:, point[piece]]
        for i in range(3):
            found[i, piece] = rotation[3 * i] * x + rotation[3 * i + 1] * y + rotation[3 * i + 2] * z + translation[i]
    return found


def project(
    problem: Problem, point_in_cam: Float[np.ndarray, "3 rows"], observation: Int[np.ndarray, " rows"] | slice
) -> Float[np.ndarray, "2 rows"]:
    """Return the pixels of points in the cameras of these observations; not finite where the model has none."""
    camera = np.asarray(problem.camera_index)[np.asarray(problem.observations.image_index)[observation]]
    return project_in_cameras(problem.cameras, camera, point_in_cam)


def project_in_cameras(
    cameras: AbstractCamera, camera: Int[np.ndarray, " rows"], point_in_cam: Float[np.ndarray, "3 rows"]
) -> Float[np.ndarray, "2 rows"]:
    """Return the pixels of points, each in one of a batch of cameras; not finite where the model has none.

    - `cameras`: one model, its fields with one entry a camera. `camera`: the camera of each point.
    - `point_in_cam`: metres, in the frame of its camera.

    >>> import numpy as np
    >>> from jaxba.geometry import SimplePinhole
    >>> cameras = SimplePinhole(np.array([1000.0, 2000.0]), np.full(2, 500.0), np.full(2, 400.0))
    >>> project_in_cameras(cameras, np.array([0, 1]), np.array([[1.0, 1.0], [0.0, 0.0], [10.0, 10.0]])).tolist()
    [[600.0, 700.0], [400.0, 400.0]]
    """
    count = point_in_cam.shape[1]
    fields = [np.atleast_1d(np.asarray(getattr(cameras, name), float)) for name in cameras.parameter_names()]
    xy_px = np.empty((2, count))
    with jax.enable_x64(True):
        for start in range(0, count, _CHUNK):
            rows = np.minimum(np.arange(start, start + _CHUNK), count - 1)  # the last one fills up
            own = [f[camera[rows]] if len(f) > 1 else f.reshape(()) for f in fields]
            pixels = _pixels(type(cameras)(*own), *point_in_cam[:, rows])
            xy_px[:, start : start + _CHUNK] = np.stack(pixels)[:, : count - start]
    return xy_px


@eqx.filter_jit
def _pixels(camera: AbstractCamera, x: Array, y: Array, z: Array) -> tuple[Array, Array]:
    return camera.project_components(x, y, z)
