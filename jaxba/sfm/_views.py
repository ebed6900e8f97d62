"""Views: which points of a block an image looks towards, and where they fall in it.

Points lie in cells, and a cell is passed over whose sphere lies outside the cone about the image's axis that holds its
corners. So the work for an image goes with what it sees, and not with the whole block.
"""

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial.transform import Rotation

from jaxba.ba import project_in_cameras
from jaxba.geometry import CAMERAS
from jaxba.scene import Block, Photo
from jaxba.sfm._rays import make_rays

_BORDER, _MARGIN = 17, 1.05  # pixels on each side of an image; of the angle to them
_IN_CELL = 500  # points, were they spread evenly over the ground
_OUTSIDE = 1.0  # per cent of the points on each side of an axis, that lie in the outer cells


class Views:
    """The views of a block's images."""

    def __init__(self, block: Block, photos: tuple[Photo, ...]) -> None:
        self._block = block
        self._size_px = np.array([[photos[i].width_px, photos[i].height_px] for i in block.image_index])
        self._angle_rad = self._angles()
        key = _cells(block.points_m)
        self._order = np.argsort(key, kind="stable")
        self._starts = np.flatnonzero(np.diff(key[self._order], prepend=-1))
        self._counts = np.diff(self._starts, append=len(key))
        ordered = block.points_m[self._order]
        low, high = (of.reduceat(ordered, self._starts) for of in (np.minimum, np.maximum))
        self._middle_m, self._radius_m = (low + high) / 2, np.linalg.norm(high - low, axis=1) / 2

    def towards(self, row: int) -> Int[np.ndarray, " points"]:
        """Return the points in the cells that an image looks towards, ascending."""
        in_cam = self._in_cam(row, self._middle_m)
        distance = np.linalg.norm(in_cam, axis=0)
        with np.errstate(all="ignore"):
            off_axis = np.arccos(np.clip(in_cam[2] / distance, -1.0, 1.0))
            beside = off_axis - np.arcsin(np.clip(self._radius_m / distance, 0.0, 1.0))
        limit = self._angle_rad[self._block.camera_index[row]]
        seen = np.flatnonzero(~(beside > limit) | (distance <= self._radius_m))
        first, counts = self._starts[seen], self._counts[seen]
        within = np.arange(counts.sum()) - np.repeat(np.cumsum(counts) - counts, counts)
        return np.sort(self._order[np.repeat(first, counts) + within])

    def pixels(
        self, row: int, points: Int[np.ndarray, " points"]
    ) -> tuple[Int[np.ndarray, " seen"], Float[np.ndarray, "seen 2"]]:
        """Return which of the points fall into an image, and where."""
        block = self._block
        in_cam = self._in_cam(row, block.points_m[points])
        cosine = np.cos(self._angle_rad[block.camera_index[row]])
        ahead = (in_cam[2] > 0) & (in_cam[2] >= cosine * np.sqrt(np.einsum("kn,kn->n", in_cam, in_cam)))
        points, in_cam = points[ahead], in_cam[:, ahead]
        camera = CAMERAS[block.camera_model](*block.camera_parameters.T)
        pixel = project_in_cameras(camera, np.full(len(points), block.camera_index[row]), in_cam).T
        inside = np.isfinite(pixel).all(axis=1) & ((pixel >= 0) & (pixel <= self._size_px[row])).all(axis=1)
        return points[inside], pixel[inside]

    def _in_cam(self, row: int, points_m: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "3 n"]:
        rotation = Rotation.from_quat(self._block.quaternion[row], scalar_first=True).as_matrix()
        return rotation @ points_m.T + self._block.translation_m[row][:, None]

    def _angles(self) -> Float[np.ndarray, " cameras"]:
        """Return the angle from each camera's axis beyond which its images see nothing; pi where unknown."""
        block = self._block
        found = np.full(len(block.camera_parameters), np.pi)
        along = np.linspace(0.0, 1.0, _BORDER)
        ends = np.zeros_like(along), np.ones_like(along)
        border = np.concatenate([np.stack(side, axis=1) for end in ends for side in ((along, end), (end, along))])
        for camera in np.unique(block.camera_index):
            row = int(np.flatnonzero(block.camera_index == camera)[0])
            rays = make_rays(block, np.full(len(border), row), border * self._size_px[row])
            axis = Rotation.from_quat(block.quaternion[row], scalar_first=True).as_matrix()[2]
            angle = np.arccos(np.clip(axis @ rays.direction, -1.0, 1.0)).max()
            found[camera] = min(_MARGIN * angle, np.pi) if np.isfinite(angle) else np.pi
        return found


def _cells(points_m: Float[np.ndarray, "points 3"]) -> Int[np.ndarray, " points"]:
    """Return a number for the cell of each point: cubes, and outer cells for the few that lie far out."""
    low, high = np.percentile(points_m, [_OUTSIDE, 100 - _OUTSIDE], axis=0)
    sides = np.sort(np.maximum(high - low, 1e-9))
    side = max(np.sqrt(sides[2] * sides[1] * _IN_CELL / len(points_m)), 1e-9)
    counts = np.ceil((high - low) / side).astype(np.int64)
    place = np.clip(np.floor((points_m - low) / side).astype(np.int64), -1, counts) + 1
    return (place[:, 0] * (counts[1] + 2) + place[:, 1]) * (counts[2] + 2) + place[:, 2]
