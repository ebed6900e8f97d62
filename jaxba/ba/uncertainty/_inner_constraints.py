"""The datum of inner constraints: what a block knows of its shape, placed where its points' sigmas are smallest.

Photos leave seven directions D of a block free (Triggs et al. 2000, section 9): N D = 0. Of all ways to fix these,
inner constraints over the points, `sum D_i^T dx_i = 0`, give the covariance C of the smallest trace over them (Meissl
1969; Granshaw 1980). With D orthonormal over the points and W the identity there, it follows from the covariance Q of
the block held in any other way by S-transformation (Baarda 1973),

    C = P Q P^T,   P = I - D D^T W

and from that of seven coordinates of three points, which bend nothing. Where scale bars hold the scale, it is six.
"""

import dataclasses
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from jaxba._errors import JaxbaError
from jaxba.ba._problem import Problem
from jaxba.ba._unknowns import Step
from jaxba.ba.checks import free_directions
from jaxba.ba.groups import ControlPointPrior, ScaleBarPrior

_LEAST_POINTS = 10
_HELD = 1e-3  # sigma of the seven coordinates over the block's rms extent; the result does not depend on it


class FreeBlock(NamedTuple):
    """A block of which only photos and scale bars tell.

    - `held`: the same with as many coordinates held by a prior as directions are free, the last of its priors.
    - `poses`, `points`: D over both.
    """

    held: Problem
    poses: Float[np.ndarray, "images 6 free"]
    points: Float[np.ndarray, "points 3 free"]

    def columns(self) -> list[Step]:
        """Return W D as right-hand sides."""
        problem = self.held
        poses, intrinsics = np.zeros((problem.num_images, 6)), np.zeros(problem.free.intrinsics.shape)
        antenna = np.zeros(problem.antenna.shape)
        return [Step(poses, intrinsics, antenna, np.array(self.points[:, :, k])) for k in range(self.points.shape[2])]

    def transformed(
        self, poses: np.ndarray, points: np.ndarray, solutions: list[Step]
    ) -> tuple[Float[np.ndarray, "images 6 6"], Float[np.ndarray, "points 3 3"]]:
        """Return blocks of C from those of Q; `solutions`: Q W D."""
        across_poses, across_points = (
            np.stack([getattr(s, of) for s in solutions], axis=2) for of in ("poses", "points")
        )
        among = np.einsum("nij,nik->jk", self.points, across_points)

        def of_kind(blocks: np.ndarray, along: np.ndarray, across: np.ndarray) -> np.ndarray:
            mixed = along @ np.swapaxes(across, 1, 2)
            return blocks - mixed - np.swapaxes(mixed, 1, 2) + along @ among @ np.swapaxes(along, 1, 2)

        return of_kind(poses, self.poses, across_poses), of_kind(points, self.points, across_points)


def num_free(problem: Problem) -> int:
    """Return how many directions nothing holds in a problem of photos and scale bars."""
    return 6 if problem.num_bar_ends else 7


def of_photos_alone(label: str, problem: Problem) -> Problem:
    """Return a problem without the priors of poses and points, its scale bars aside.

    The lever arm, of which nothing is known then, is held fixed; position offsets are left out.

    Raises `JaxbaError` where poses or points are fixed.
    """
    free = problem.free
    for kind, mask in (("poses", free.poses), ("points", free.points)):
        fixed = int(np.count_nonzero(~np.asarray(mask)))
        if fixed:
            raise JaxbaError(
                f'{label}: datum "inner" is for a block that nothing holds, and {fixed} {kind} are fixed; free them, '
                'or leave the datum at "priors".'
            )
    bars, num_offsets = problem.prior("scale_bar"), len(problem.position_offset) - problem.num_bar_ends
    priors = [prior for prior in problem.priors if hasattr(prior, "camera_index")]
    if isinstance(bars, ScaleBarPrior):
        priors.append(dataclasses.replace(bars, offset_index=np.asarray(bars.offset_index) - np.int32(num_offsets)))
    free = dataclasses.replace(free, lever_arm=np.array(False), position_offset=np.array(bars is not None))
    ends = np.asarray(problem.position_offset)[num_offsets:]
    return dataclasses.replace(problem, priors=tuple(priors), free=free, position_offset=ends)


def free_block(label: str, problem: Problem) -> FreeBlock:
    """Return a problem of photos and scale bars, that was checked, as inner constraints hold it.

    Raises `JaxbaError` for a block of several parts.
    """
    poses, points, size = free_directions(label, problem)
    count = num_free(problem)
    poses, points = poses[:, :, :count], points[:, :, :count]  # the scale is the last one
    root = np.linalg.cholesky(np.einsum("nij,nik->jk", points, points))
    poses, points = (np.swapaxes(np.linalg.solve(root, np.swapaxes(d, 1, 2)), 1, 2) for d in (poses, points))
    xyz = np.asarray(problem.points, float)
    seen = np.flatnonzero(problem.free.points)
    corners = _corners(xyz, seen) if len(seen) >= _LEAST_POINTS else seen[:0]
    if len(np.unique(corners)) < 3:
        raise JaxbaError(
            f'{label}: datum "inner" needs {_LEAST_POINTS} points or more that lie apart and off one line; there are '
            f'{len(seen)}. Leave the datum at "priors".'
        )
    std_m = np.full((3, 3), np.inf)
    std_m.reshape(-1)[_best_rows(points[corners].reshape(9, count))] = _HELD * size
    prior = ControlPointPrior(point_index=corners.astype(np.int32), xyz=xyz[corners], std_m=std_m)
    return FreeBlock(dataclasses.replace(problem, priors=(*problem.priors, prior)), poses, points)


def _corners(xyz: Float[np.ndarray, "points 3"], among: Int[np.ndarray, " n"]) -> Int[np.ndarray, "3"]:
    """Return three points that lie far from each other, and from one line."""
    near = xyz[among] - np.median(xyz[among], axis=0)
    far = np.sum(near**2, axis=1)
    inside = far <= np.quantile(far, 0.95)  # the farthest may be the weakest
    among, near = among[inside], near[inside]
    first = np.argmax(np.sum(near**2, axis=1))
    second = np.argmax(np.sum((near - near[first]) ** 2, axis=1))
    along = (near[second] - near[first]) / np.linalg.norm(near[second] - near[first])
    third = np.argmax(np.linalg.norm(np.cross(near - near[first], along), axis=1))
    return among[[first, second, third]]


def _best_rows(rows: Float[np.ndarray, "9 free"]) -> list[int]:
    """Return as many rows as columns that are as independent as can be had one by one."""
    left, chosen = rows.copy(), []
    for _ in range(rows.shape[1]):
        chosen.append(int(np.argmax(np.sum(left**2, axis=1))))
        unit = left[chosen[-1]] / np.linalg.norm(left[chosen[-1]])
        left = left - np.outer(left @ unit, unit)
    return chosen
