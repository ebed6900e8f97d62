"""The network of a block that was flown: a project's own adjustment, at its result."""

import dataclasses

import equinox as eqx
import numpy as np
from jaxtyping import Float

from jaxba._errors import JaxbaError
from jaxba.ba import PositionOffsetPrior, PositionPrior, Problem
from jaxba.design._ground import ground_of_points
from jaxba.design._network import Network
from jaxba.design._photos import Photos
from jaxba.design._sections import Gnss
from jaxba.geometry import AbstractLoss, Pose

_RTK_M = 0.1  # positions of a larger sigma are those of a single receiver, which have an offset in common


def network_of_block(
    problem: Problem, size_px: tuple[int, int], mark_std_px: float, loss: AbstractLoss | None = None
) -> Network:
    """Return the network of an adjusted problem, in the coordinates of its world about their middle.

    Positions of a single receiver have an offset in common that a run without control does not estimate, since nothing
    would tell it; here it counts. The area is what the photos stand around.

    - `size_px`: columns and rows of the photos. `mark_std_px`: sigma of a mark in a photo.

    Raises `JaxbaError` where the photos stand on a line.
    """
    import shapely

    poses = Pose(np.asarray(problem.poses.quaternion, float), np.asarray(problem.poses.translation, float))
    rotation = np.asarray(poses.rotation)
    centers = -np.einsum("nji,nj->ni", rotation, np.asarray(poses.translation))
    hull = shapely.convex_hull(shapely.multipoints(centers[:, :2]))
    if not isinstance(hull, shapely.Polygon) or hull.area < 1e-3 * hull.length**2:
        raise JaxbaError("the photos stand on one line, which has no area to map; fly a second line beside it.")
    photos = Photos(centers, rotation, problem.cameras, np.asarray(problem.camera_index, np.int32), size_px)
    ground = ground_of_points(np.asarray(problem.points, float))
    area_m = np.asarray(shapely.get_coordinates(hull))[:-1]
    return Network(photos, ground, _with_common_offset(problem), area_m, mark_std_px, loss)


def _with_common_offset(problem: Problem) -> Problem:
    prior = problem.prior(PositionPrior.name)
    if not isinstance(prior, PositionPrior) or len(problem.position_offset) > problem.num_bar_ends:
        return problem
    std_m: Float[np.ndarray, "rows 3"] = np.asarray(prior.std_m, float)
    if problem.num_bar_ends or not np.median(std_m[:, 0]) > _RTK_M:
        return problem
    offset = PositionOffsetPrior(xyz=np.zeros((1, 3)), std_m=np.array([Gnss(kind="plain").common_std_m]))
    problem = dataclasses.replace(problem, priors=(*problem.priors, offset))
    return eqx.tree_at(
        lambda p: (p.position_offset, p.free.position_offset), problem, (np.zeros((1, 3)), np.array(True))
    )
