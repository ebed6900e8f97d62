"""The joint covariance of all poses and intrinsics: what a block knows of places that it has not measured.

`Covariance` has the blocks of single images; how errors of different images go together, which is what the bending of a
block is, stands between them. Here the reduced system is inverted as a whole, so that it is for blocks of up to some
thousand images: n unknowns take 8 n^2 bytes and 2/3 n^3 flops.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float
from scipy.linalg import lapack

from jaxba._errors import JaxbaError
from jaxba.ba._compiler import call_compiled
from jaxba.ba._linearise import linearise
from jaxba.ba._plan import Plan
from jaxba.ba._problem import Problem
from jaxba.ba._schur import eliminate_points, one_for_fixed
from jaxba.ba._solvers import damped_points
from jaxba.ba._system import System, initial_unknowns, make_system, structured
from jaxba.ba._unknowns import Step, Unknowns
from jaxba.ba.checks import require_gauge
from jaxba.geometry import AbstractLoss, Linear, check_loss

_MOST = 20_000  # unknowns: 3.2 GB


def camera_covariance(problem: Problem, *, loss: AbstractLoss | None = None) -> Float[np.ndarray, "unknowns unknowns"]:
    """Return the joint covariance, a priori, of all poses and intrinsics at the problem's present values.

    Rows and columns are the tangent steps (w, v) of each image, rad and metres in the camera's frame as
    `Pose.retract` takes them, then the parameters of each camera, camera by camera; zero for what is fixed.

    - `loss`: as given to `solve`; rows count with the weight that it gives them (least squares if None).

    Raises `JaxbaError` where the problem has no gauge, something is not determined, or the block is too large.

    >>> import jaxba
    >>> problem = jaxba.synthetic.uav_block(8).problem
    >>> jaxba.ba.camera_covariance(problem).shape  # 8 poses, and the 9 parameters of one camera
    (57, 57)
    """
    loss = Linear() if loss is None else loss
    check_loss("camera_covariance: loss", loss)
    size = 6 * problem.num_images + np.size(problem.free.intrinsics)
    if size > _MOST:
        raise JaxbaError(
            f"camera_covariance: {problem.num_images} images have {size} unknowns, over {_MOST}; jaxba.covariance has "
            "the blocks of single images of a block of any size, and jaxba.partition cuts it into smaller ones."
        )
    prepared, plan = structured(problem, None, "dense")
    problem = prepared.problem
    require_gauge(problem, "camera_covariance")
    with jax.enable_x64(True):
        system = make_system(problem, plan, loss)
        parts = [np.asarray(part) for part in call_compiled(_reduced, system, initial_unknowns(problem, plan))]
    return _in_order(_inverse(_dense(system, *parts)), plan, problem)


def _reduced(system: System, unknowns: Unknowns) -> tuple[Array, Array, Array, Array]:
    """Return the blocks of the reduced system: on the diagonal, below it, the border, the corner."""
    damped, of_points = damped_points(linearise(system, unknowns), jnp.zeros(()))
    zero = jax.tree.map(jnp.zeros_like, system.free)
    damping = Step(zero.poses, zero.intrinsics, zero.antenna, of_points)
    found = eliminate_points(system, damped, one_for_fixed(system, damping))
    return found.diagonal, found.off_diagonal, found.border, found.corner


def _dense(
    system: System, diagonal: np.ndarray, below: np.ndarray, border: np.ndarray, corner: np.ndarray
) -> Float[np.ndarray, "n n"]:
    """Return the reduced system, its lower triangle filled; the border comes last."""
    num_images, block = diagonal.shape[:2]
    of_images = num_images * block
    size = of_images + len(corner)
    matrix = np.zeros((size, size))
    blocks = matrix[:of_images, :of_images].reshape(num_images, block, num_images, block)
    images = np.arange(num_images)
    blocks[images, :, images] = diagonal
    rows, columns = np.asarray(system.block_row), np.asarray(system.block_column)
    for row, column, part in zip(rows, columns, below, strict=True):  # padding adds zeros to some of them
        blocks[row, :, column] += part
    matrix[of_images:, :of_images] = border.reshape(of_images, -1).T
    matrix[of_images:, of_images:] = corner
    return matrix


def _inverse(matrix: Float[np.ndarray, "n n"]) -> Float[np.ndarray, "n n"]:
    """Return the inverse of a matrix whose lower triangle is filled, scaled to a diagonal of ones."""
    scale = np.diagonal(matrix).copy()
    if np.all(scale > 0):
        scale = 1 / np.sqrt(scale)
        potrf, potri = lapack.get_lapack_funcs(("potrf", "potri"), (matrix,))
        root, failed = potrf(matrix * scale[:, None] * scale, lower=1, overwrite_a=1)
        if not failed:
            inverse, failed = potri(root, lower=1, overwrite_c=1)
            if not failed:
                inverse = np.tril(inverse)
                return (inverse + np.tril(inverse, -1).T) * scale[:, None] * scale
    raise JaxbaError(
        "camera_covariance: the measurements do not determine all unknowns; jaxba.covariance(problem) names one."
    )


def _in_order(
    inverse: Float[np.ndarray, "n n"], plan: Plan, problem: Problem
) -> Float[np.ndarray, "unknowns unknowns"]:
    """Return the rows and columns of poses and intrinsics in the problem's order, zero for what is fixed."""
    shape = plan.shape
    refined = np.flatnonzero(shape.refined)
    free_poses = np.repeat(np.asarray(problem.free.poses), 6)
    free_intrinsics = np.asarray(problem.free.intrinsics).reshape(-1)
    image_rank = np.argsort(plan.image_order)
    source = np.full(len(free_poses) + len(free_intrinsics), -1)
    source[: len(free_poses)] = (image_rank[:, None] * shape.block + np.arange(6)).reshape(-1)
    of_cameras = source[len(free_poses) :].reshape(problem.free.intrinsics.shape)
    if shape.own_cameras:
        of_cameras[np.ix_(np.asarray(problem.camera_index), refined)] = (
            image_rank[:, None] * shape.block + 6 + np.arange(len(refined))
        )
    else:
        first, rank = shape.num_images * shape.block, np.argsort(plan.camera_order)
        of_cameras[:, refined] = first + rank[:, None] * len(refined) + np.arange(len(refined))
    known = np.flatnonzero((source >= 0) & np.append(free_poses, free_intrinsics))
    matrix = np.zeros((len(source),) * 2)
    matrix[np.ix_(known, known)] = inverse[np.ix_(source[known], source[known])]
    return matrix
