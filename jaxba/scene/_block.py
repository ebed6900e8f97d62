"""A block of images: poses, cameras and points as plain arrays, before and after the adjustment."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int, UInt8

from jaxba.scene._photo import LeftOut


@dataclass(frozen=True, kw_only=True, eq=False)
class Block:
    """Registered images, their cameras, and points with their observations.

    - `image_index`: the registered images, rising; every other array that speaks of images has their order.
    - `quaternion` (scalar first), `translation_m`: `cam_from_world`.
    - `camera_model`: a name in `jaxba.geometry.CAMERAS`. `camera_parameters`: a row a camera, in the model's order.
    - `camera_names`: the `Photo.camera` of each row. `camera_index`: row of each registered image.
    - `points_m`: world. `track_index`: the track of each point. `rgb`: its colour.
    - `observation_image`: row in `image_index`. `observation_point`: row in `points_m`. `observation_xy_px`: measured.
    - `is_georeferenced`: the world is the survey's local frame (metres east, north, up); else any frame, any scale.
    - `unregistered`: images that have no pose, with the reason.
    - `notes`: what was found and decided, in sentences.
    """

    image_index: Int[np.ndarray, " images"]
    quaternion: Float[np.ndarray, "images 4"]
    translation_m: Float[np.ndarray, "images 3"]
    camera_model: str
    camera_names: tuple[str, ...]
    camera_parameters: Float[np.ndarray, "cameras parameters"]
    camera_index: Int[np.ndarray, " images"]
    points_m: Float[np.ndarray, "points 3"]
    track_index: Int[np.ndarray, " points"]
    rgb: UInt8[np.ndarray, "points 3"]
    observation_image: Int[np.ndarray, " observations"]
    observation_point: Int[np.ndarray, " observations"]
    observation_xy_px: Float[np.ndarray, "observations 2"]
    is_georeferenced: bool
    unregistered: tuple[LeftOut, ...] = ()
    notes: tuple[str, ...] = ()

    @property
    def num_images(self) -> int:
        return self.image_index.shape[0]

    @property
    def num_points(self) -> int:
        return self.points_m.shape[0]

    @property
    def num_observations(self) -> int:
        return self.observation_image.shape[0]

    @property
    def centers_m(self) -> Float[np.ndarray, "images 3"]:
        """Positions of the cameras in the world, `-R^T t`."""
        w, xyz = self.quaternion[:, :1], self.quaternion[:, 1:]
        # R^T t by the conjugate quaternion: t + 2 v x (v x t + w t) with v = -xyz
        inner = np.cross(-xyz, self.translation_m) + w * self.translation_m
        return -(self.translation_m + 2 * np.cross(-xyz, inner))
