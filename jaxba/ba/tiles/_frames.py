"""Frames: the positions and rotations that a tile tells, in its own frame, and those known in the block's.

What was measured or is held fixed in the block is written like a tile: antennas and surveyed points with their sigmas,
attitudes, fixed images and points. So a tile is tied to the block as it is tied to another tile. A tile's lever arm is
a length of its own frame, and grows with it.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial.transform import Rotation

from jaxba.ba._problem import Problem
from jaxba.ba._projection import camera_centers, rotation_matrices
from jaxba.ba.groups import AttitudePrior, ControlPointPrior, PositionPrior
from jaxba.ba.tiles._partition import BlockTile

CENTER, POINT, ANTENNA = 0, 1, 2
"""Kinds of positions that a frame tells."""

_HELD_STD = 1e-3  # metres, radians: of what is held fixed in the block, beside what was measured


@dataclass(frozen=True, eq=False)
class Frame:
    """What is known in one frame.

    - `kind`, `number`, `xyz`: of positions: centres and antennas of images, points; by numbers of the block, metres.
    - `std_m`: sigmas an axis; NaN in a tile, where differences show them.
    - `images`, `rotations`: `cam_from_frame` of images. `std_rad`: sigmas, NaN in a tile.
    """

    kind: Int[np.ndarray, " n"]
    number: Int[np.ndarray, " n"]
    xyz: Float[np.ndarray, "n 3"]
    std_m: Float[np.ndarray, "n 3"]
    images: Int[np.ndarray, " m"]
    rotations: Float[np.ndarray, "m 3 3"]
    std_rad: Float[np.ndarray, " m"]

    @property
    def key(self) -> Int[np.ndarray, " n"]:
        """One number for each position."""
        return self.number.astype(np.int64) * 3 + self.kind


def frame_of_tile(tile: BlockTile) -> Frame:
    """Return what a tile says: centres and antennas of its images, their rotations, its points."""
    problem = tile.problem
    rotations, centers = rotation_matrices(problem.poses), camera_centers(problem.poses)
    antennas = centers + np.einsum("nji,j->ni", rotations, np.asarray(problem.lever_arm, float))
    xyz = np.concatenate([centers, antennas, np.asarray(problem.points, float)])
    return Frame(
        kind=np.repeat([CENTER, ANTENNA, POINT], [len(centers), len(centers), problem.num_points]),
        number=np.concatenate([tile.images, tile.images, tile.points]),
        xyz=xyz,
        std_m=np.full(xyz.shape, np.nan),
        images=np.asarray(tile.images),
        rotations=rotations,
        std_rad=np.full(len(centers), np.nan),
    )


def frame_of_block(problem: Problem) -> Frame:
    """Return what is known in the block's own frame: what its priors measured, and what is held fixed."""
    held_images, held_points = (np.flatnonzero(~np.asarray(free)) for free in (problem.free.poses, problem.free.points))
    rotations = rotation_matrices(problem.poses)
    parts: list[tuple[int, np.ndarray, np.ndarray, np.ndarray]] = [
        (CENTER, held_images, camera_centers(problem.poses)[held_images], np.full(3, _HELD_STD)),
        (POINT, held_points, np.asarray(problem.points, float)[held_points], np.full(3, _HELD_STD)),
    ]
    turns = [(held_images, rotations[held_images], np.full(len(held_images), _HELD_STD))]
    offsets = np.asarray(problem.position_offset, float)
    for prior in problem.priors:
        if isinstance(prior, PositionPrior):
            parts.append(
                (
                    ANTENNA,
                    np.asarray(prior.image_index),
                    np.asarray(prior.xyz - prior.offset(offsets)),
                    np.asarray(prior.std_m),
                )
            )
        elif isinstance(prior, ControlPointPrior):
            free = np.asarray(problem.free.points)[prior.point_index]
            index, xyz, std_m = (np.asarray(of)[free] for of in (prior.point_index, prior.xyz, prior.std_m))
            parts.append((POINT, index, xyz, std_m))
        elif isinstance(prior, AttitudePrior):
            free = np.asarray(problem.free.poses)[prior.image_index]
            index, quaternion, std_rad = (
                np.asarray(of)[free] for of in (prior.image_index, prior.quaternion, prior.std_rad)
            )
            measured = Rotation.from_quat(quaternion.reshape(-1, 4), scalar_first=True).as_matrix()
            turns.append((index, measured, np.max(std_rad, axis=1, initial=0.0)))
    return Frame(
        kind=np.concatenate([np.full(len(index), kind) for kind, index, _, _ in parts]),
        number=np.concatenate([index for _, index, _, _ in parts]),
        xyz=np.concatenate([xyz for _, _, xyz, _ in parts]),
        std_m=np.concatenate([np.broadcast_to(std_m, xyz.shape) for _, _, xyz, std_m in parts]),
        images=np.concatenate([index for index, _, _ in turns]),
        rotations=np.concatenate([matrices for _, matrices, _ in turns]),
        std_rad=np.concatenate([std_rad for _, _, std_rad in turns]),
    )
