"""Covariance: marginal covariances of poses, intrinsics, lever arm and points at a problem's present values.

The blocks of (J^T J)^-1 that belong to one image, camera or point; how they are computed stands in `_marginals.py`.
Poses are tangent steps (w in rad, v in metres) in the camera's frame, as `Pose.retract` takes them.

Cost: 500 images with 33k points take 0.9 s on two cores, after 5 s to compile, and 0.3 GB beside what is loaded.
"""

import dataclasses

import jax
import numpy as np
from jaxtyping import Float
from threadpoolctl import threadpool_limits

from jaxba._errors import JaxbaError
from jaxba.ba._marginals import Marginals, marginals
from jaxba.ba._plan import Plan, make_plan
from jaxba.ba._problem import Problem
from jaxba.ba._projection import rotation_matrices
from jaxba.ba._system import System, initial_unknowns, make_system
from jaxba.ba._unknowns import Unknowns
from jaxba.ba.checks import Dropped, prepare, require_gauge
from jaxba.geometry import AbstractLoss, Linear, check_loss

MAX_UNKNOWNS = 6500  # 1000 images with one camera take 5 s and 0.8 GB beside what is loaded
_PROBING = 1e-9  # damping, relative, under which a singular system shows where it is weak
_MAX_INFLATION = 1e13  # of a variance by the other unknowns: beyond it rounding has eaten the answer


@dataclasses.dataclass(frozen=True)
class Covariance:
    """Covariances a priori: of measurements whose sigmas are true. Times `variance_factor` they are a posteriori.

    Zero for what is fixed. A parameter at its bound counts as free.

    - `poses`: tangent steps (w, v) in the camera's frame: rad and metres. `centers`: camera positions, world, m^2.
    - `intrinsics`: of each camera, in its parameters' units. `lever_arm`: camera's frame, m^2. `points`: world, m^2.
    - `border`: joint covariance of the shared unknowns named in `border_names`: all refined intrinsics, then the lever
      arm. Where each image has its own camera, only the lever arm.
    - `variance_factor`: near 1 where the sigmas are right, under any loss; `2 cost / redundancy` under least squares,
      and where a loss is robust the same without the tail, which no sigma describes. NaN without redundancy.
    - `redundancy`: measured components that depend on something free, minus free unknowns.
    - `dropped`: observations and points that took no part.
    """

    poses: Float[np.ndarray, "images 6 6"]
    centers: Float[np.ndarray, "images 3 3"]
    intrinsics: Float[np.ndarray, "cameras parameters parameters"]
    lever_arm: Float[np.ndarray, "3 3"]
    points: Float[np.ndarray, "points 3 3"]
    border: Float[np.ndarray, "border border"]
    border_names: tuple[str, ...]
    variance_factor: float
    redundancy: int
    dropped: Dropped


def covariance(problem: Problem, *, loss: AbstractLoss | None = None) -> Covariance:
    """Return the covariances at the problem's present values; call it on `solution.apply(problem)`.

    - `loss`: as given to `solve`; rows count with the weight that it gives them (least squares if None).

    Raises `JaxbaError` where the problem has no gauge, where something in it is not determined, and beyond
    `MAX_UNKNOWNS` unknowns of images and cameras.

    >>> import jaxba
    >>> survey = jaxba.synthetic.uav_block(8)
    >>> found = jaxba.ba.covariance(survey.problem)
    >>> found.poses.shape, found.points.shape[1:], found.border_names[:2]
    ((8, 6, 6), (3, 3), ('camera 0 fx', 'camera 0 fy'))
    """
    if loss is not None:
        check_loss("covariance: loss", loss)
    prepared = prepare(problem)
    problem = prepared.problem
    require_gauge(problem, "Covariance")
    plan = make_plan(problem)
    _check_size(plan)
    with jax.enable_x64(True), threadpool_limits(1, user_api="blas"):
        system: System = jax.device_put(make_system(problem, plan, _as_arrays(Linear() if loss is None else loss)))
        unknowns: Unknowns = jax.device_put(initial_unknowns(problem, plan))
        num_free = np.array(_num_free(problem))
        found = jax.device_get(marginals(system, plan, unknowns, num_free, np.array(0.0)))
        if not _determined(found):
            damped = marginals(system, plan, unknowns, num_free, np.array(_PROBING))
            weakest = _weakest(jax.device_get(damped), plan, problem)
            raise JaxbaError(
                f"Covariance: the measurements do not determine {weakest}. Hold it fixed or add a prior; an image "
                "needs three points or more that others see, and intrinsics need views from different heights or sides."
            )
    return _in_order(found, plan, problem, prepared.dropped)


def _in_order(found: Marginals, plan: Plan, problem: Problem, dropped: Dropped) -> Covariance:
    """Return the covariances in the problem's order, without padding, zero for what is fixed."""
    shape, free = plan.shape, problem.free
    rank = np.argsort(plan.image_order)
    blocks = np.asarray(found.blocks)[rank]
    poses = blocks[:, :6, :6] * np.asarray(free.poses)[:, None, None]
    rotation = rotation_matrices(problem.poses)
    centers = np.swapaxes(rotation, 1, 2) @ poses[:, 3:, 3:] @ rotation

    names = type(problem.cameras).parameter_names()
    refined = np.flatnonzero(shape.refined)
    num_cameras, num_shared = problem.num_cameras, shape.border - (3 if shape.lever_arm else 0)
    free_intrinsics = np.asarray(free.intrinsics)
    shared_free = np.zeros(0, bool) if shape.own_cameras else free_intrinsics[:, refined].reshape(-1)
    border_free = np.append(shared_free, np.ones(shape.border - num_shared, bool))
    border = np.asarray(found.border) * np.outer(border_free, border_free)
    intrinsics = np.zeros((num_cameras, len(names), len(names)))
    if shape.own_cameras:
        intrinsics[np.ix_(np.asarray(problem.camera_index), refined, refined)] = blocks[:, 6:, 6:]
        intrinsics *= free_intrinsics[:, :, None] & free_intrinsics[:, None]
    else:
        of_cameras = border[:num_shared, :num_shared].reshape(num_cameras, len(refined), num_cameras, len(refined))
        cameras = np.arange(num_cameras)
        intrinsics[np.ix_(cameras, refined, refined)] = of_cameras[cameras, :, cameras]
    return Covariance(
        poses=poses,
        centers=centers,
        intrinsics=intrinsics,
        lever_arm=border[num_shared:, num_shared:] if shape.lever_arm else np.zeros((3, 3)),
        points=np.asarray(found.points)[np.argsort(plan.point_order)],
        border=border,
        border_names=_border_names(plan, problem),
        variance_factor=float(found.variance_factor),
        redundancy=int(found.redundancy),
        dropped=dropped,
    )


def _border_names(plan: Plan, problem: Problem) -> tuple[str, ...]:
    names, shape = type(problem.cameras).parameter_names(), plan.shape
    cameras = 0 if shape.own_cameras else problem.num_cameras
    refined = [n for n, r in zip(names, shape.refined, strict=True) if r]
    shared = [f"camera {c} {n}" for c in range(cameras) for n in refined]
    return (*shared, *(f"lever arm {axis}" for axis in ("xyz" if shape.lever_arm else "")))


def _num_free(problem: Problem) -> int:
    free = problem.free
    blocks = 6 * np.count_nonzero(free.poses) + 3 * np.count_nonzero(free.points) + 3 * int(np.asarray(free.lever_arm))
    return int(blocks + np.count_nonzero(free.intrinsics))


def _check_size(plan: Plan) -> None:
    shape = plan.shape
    size = len(plan.image_order) * shape.block + shape.border
    if size > MAX_UNKNOWNS:
        raise JaxbaError(
            f"Covariance: {size} unknowns of images and cameras, the limit is {MAX_UNKNOWNS} (their inverse is dense). "
            "Take a part of the block, or hold intrinsics fixed that each image has of its own."
        )


def _determined(found: Marginals) -> bool:
    inflation = np.append(np.ravel(found.block_inflation), found.border_inflation)
    return bool(np.isfinite(found.points).all() and np.max(inflation, initial=0.0) < _MAX_INFLATION)


def _weakest(damped: Marginals, plan: Plan, problem: Problem) -> str:
    """Name the unknown whose variance the others inflate most, from a system damped until it has an inverse."""
    of_images = np.asarray(damped.block_inflation)[: len(plan.image_order)]
    of_border = np.asarray(damped.border_inflation)
    if not (np.isfinite(of_images).all() and np.isfinite(of_border).all()):
        return "some of the points"
    if np.max(of_border, initial=0.0) > of_images.max():
        return _border_names(plan, problem)[int(np.argmax(of_border))]
    image, column = np.unravel_index(np.argmax(of_images), of_images.shape)
    label = problem.image_label(int(plan.image_order[image]))
    return f"the {'pose' if column < 6 else 'camera'} of {label}"


def _as_arrays(loss: AbstractLoss) -> AbstractLoss:
    """Losses whose scales are arrays share compiled code."""
    return jax.tree.map(lambda leaf: np.asarray(leaf, np.float64), loss)
