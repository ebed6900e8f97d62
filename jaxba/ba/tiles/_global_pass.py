"""The pass over the block after its tiles are merged: what tiles disagree about, adjusted while all else is held.

1. **Points.** Merged images and a common camera fit no tile's points any more. So all points are adjusted, and every
   image is held.
2. **Images where tiles meet.** Images of several tiles are free, and images that see a point whose images no tile has
   together, and all points that these images see. What takes part is a problem of its own: the observations of free
   images and of free points, and the rows of priors of what is free. All other rows are constants.

So the cost of the block falls in each by what the cost of its problem falls. For 400 images in 9 tiles the means cost
2.7 times what the exact adjustment does, and 1.01 times after the pass (`python -m benchmarks.tiles --merge`).

Intrinsics and the lever arm keep the means of the tiles, but for cameras that free images alone have. To free them in 1
gains 0.1% of the cost and takes the focal length away from the exact one, since images that are held as their tiles had
them pull at it: from 0.1 to 0.6 px in such a block, and check points from 0.025 to 0.034 m off the truth (no command is
kept).
"""

from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Bool, Float, Int

from jaxba.ba._compiler import fast_jit
from jaxba.ba._problem import Problem
from jaxba.ba._projection import camera_centers, rotation_matrices
from jaxba.ba._selection import Selection
from jaxba.ba._solution import Solution
from jaxba.ba._solve import solve
from jaxba.ba._system import own_unknowns
from jaxba.ba.tiles._cut import rows_about, sub_problem
from jaxba.ba.tiles._partition import BlockTile
from jaxba.geometry import AbstractCamera, AbstractLoss

_CHUNK = 4096
_LEAST_ANGLE = 1e-3  # radians: rays that are more parallel fix no depth


def shared_images(problem: Problem, tiles: Sequence[BlockTile]) -> Bool[np.ndarray, " images"]:
    """Return True for images of several tiles, and for those that see a point whose images no tile has together."""
    image, point = np.asarray(problem.observations.image_index), np.asarray(problem.observations.point_index)
    number = np.zeros(problem.num_images, int)
    seen = np.bincount(point, minlength=problem.num_points)
    is_whole = seen < 2
    for tile in tiles:
        number[tile.images] += 1
        inside = np.zeros(problem.num_images, bool)
        inside[tile.images] = True
        is_whole |= np.bincount(point[inside[image]], minlength=problem.num_points) == seen
    shared = number > 1
    shared[image[~is_whole[point]]] = True
    return shared


def adjust_points(problem: Problem, loss: AbstractLoss, stops: dict[str, Any]) -> Solution | None:
    """Return the block's solution with all but points held; None where no point is free."""
    held = _held(problem.fix(poses=True), True)
    return solve(held, loss=loss, **stops) if np.any(held.free.points) else None


def adjust_shared(
    problem: Problem, shared: Bool[np.ndarray, " images"], loss: AbstractLoss, stops: dict[str, Any]
) -> tuple[Problem, Solution | None]:
    """Return the block with shared images and their points adjusted, and the solution; None where none is free."""
    seen = problem.observations
    image, point = np.asarray(seen.image_index), np.asarray(seen.point_index)
    free_images = shared & np.asarray(problem.free.poses)
    free_points = np.zeros(problem.num_points, bool)
    free_points[point[free_images[image]]] = True
    free_points &= np.asarray(problem.free.points)
    rows = np.flatnonzero(free_images[image] | free_points[point])
    if not len(rows):
        return problem, None
    images, points = np.unique(image[rows]), np.unique(point[rows])
    camera_index = np.asarray(problem.camera_index)
    free_cameras = ~np.isin(np.arange(problem.num_cameras), camera_index[~free_images])
    free = {"image_index": free_images, "point_index": free_points, "camera_index": free_cameras}
    cameras = np.unique(camera_index[images])
    of_priors = [rows_about(prior, free, shared=False) for prior in problem.priors]  # the antenna is held
    part = sub_problem(problem, rows, images, points, cameras, of_priors)
    part = part.fix(poses=~free_images[images], points=~free_points[points])
    part = _held(part, np.broadcast_to(~free_cameras[cameras][:, None], part.lower.shape))
    solution = solve(part, loss=loss, **stops)
    values = own_unknowns(problem)
    values.poses.quaternion[images] = solution.poses.quaternion
    values.poses.translation[images] = solution.poses.translation
    values.points[points] = solution.points
    intrinsics = np.array(values.intrinsics)
    intrinsics[cameras] = own_unknowns(solution.apply(part)).intrinsics
    changed = values.poses, type(problem.cameras).from_parameters(intrinsics), values.points
    return eqx.tree_at(lambda p: (p.poses, p.cameras, p.points), problem, changed), solution


def _held(problem: Problem, intrinsics: Selection) -> Problem:
    """Return the problem with these intrinsics and the lever arm held."""
    held = problem.fix(intrinsics=intrinsics)
    return eqx.tree_at(lambda p: (p.free.lever_arm, p.free.position_offset), held, (np.array(False),) * 2)


def intersect(problem: Problem, points: Int[np.ndarray, " points"]) -> tuple[Problem, Bool[np.ndarray, " points"]]:
    """Return the block with these points intersected from their rays, and for which of them that was possible.

    A point gets the least sum of squared distances to its rays, as `jaxba.triangulate`. It is left as it is where it is
    seen fewer than twice, where its rays are parallel, and where it would lie behind a camera.
    """
    seen = problem.observations
    place = np.full(problem.num_points, -1)
    place[points] = np.arange(len(points))
    rows = np.flatnonzero(place[np.asarray(seen.point_index)] >= 0)
    if not len(rows):
        return problem, np.zeros(len(points), bool)
    image, of_row = np.asarray(seen.image_index)[rows], place[np.asarray(seen.point_index)[rows]]
    ray = _rays(problem, image, np.asarray(seen.xy_px, float)[rows])
    known = np.isfinite(ray).all(axis=1)
    image, of_row, ray = image[known], of_row[known], ray[known]
    direction = np.einsum("nji,nj->ni", rotation_matrices(problem.poses)[image], ray)
    center = camera_centers(problem.poses)[image]
    count = np.maximum(np.bincount(of_row, minlength=len(points)), 1)

    def mean(values: Float[np.ndarray, "n k"]) -> Float[np.ndarray, "points k"]:
        total = [np.bincount(of_row, column, len(points)) for column in values.T]
        return np.stack(total, axis=1) / count[:, None]

    middle = mean(center)
    across = np.eye(3) - direction[:, :, None] * direction[:, None]
    matrix = mean(across.reshape(-1, 9)).reshape(-1, 3, 3)
    rhs = mean(np.einsum("nij,nj->ni", across, center - middle[of_row]))
    values, vectors = np.linalg.eigh(matrix)
    good = values[:, 0] > _LEAST_ANGLE**2
    inverse = np.where(good[:, None], 1 / np.maximum(values, np.finfo(float).tiny), 0.0)
    xyz = middle + np.einsum("pij,pj,pkj,pk->pi", vectors, inverse, vectors, rhs)
    depth = np.einsum("ni,ni->n", direction, xyz[of_row] - center)
    good &= np.bincount(of_row, depth <= 0, len(points)) == 0
    changed = np.array(problem.points, float)
    changed[points[good]] = xyz[good]
    return eqx.tree_at(lambda p: p.points, problem, changed), good


def _rays(problem: Problem, image: Int[np.ndarray, " n"], xy_px: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 3"]:
    """Return unit directions in the camera, NaN where none has the pixel; in pieces of one size, compiled once."""
    parameters = own_unknowns(problem).intrinsics[np.asarray(problem.camera_index)[image]]
    found = np.empty((len(xy_px), 3))
    model = type(problem.cameras)
    with jax.enable_x64(True):
        for start in range(0, len(xy_px), _CHUNK):
            rows = np.minimum(np.arange(start, start + _CHUNK), len(xy_px) - 1)
            piece = _unprojected(model.from_parameters(parameters[rows]), xy_px[rows])
            found[start : start + _CHUNK] = np.asarray(piece)[: len(xy_px) - start]
    return found


@fast_jit
def _unprojected(cameras: AbstractCamera, xy_px: Float[Array, "n 2"]) -> Float[Array, "n 3"]:
    return cameras.unproject(jnp.asarray(xy_px))
