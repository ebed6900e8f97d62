"""Covariance: marginal covariances of poses, intrinsics, lever arm and points at a problem's present values.

With the points eliminated, S = [A B; B^T C] is the reduced system without damping (`_schur.py`), over images and the
border of shared unknowns. Its inverse holds the covariances of both,

    S^-1 = [A^-1 + F G^-1 F^T   -F G^-1]       F = A^-1 B       G = C - B^T F
           [ .                    G^-1 ]

and each point's follows from its own observations: with V = L L^T and Z_i as in `_schur.py`,

    cov_x = V^-1 + V^-1 W^T S^-1 W V^-1 = L^-T (I + sum over pairs of observations i, j of  Z_i S^-1_ij Z_j^T) L^-1

in which the border counts as one more block. Poses are tangent steps (w in rad, v in metres) in the camera's frame.

Cost: A^-1 is dense. 500 images with 33k points take 0.9 s on two cores, and 0.3 GB beside what is loaded; points are
summed in pieces of `_CHUNK` pairs.
"""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float
from threadpoolctl import threadpool_limits

from jaxba._errors import JaxbaError
from jaxba.ba._check import Dropped, prepare
from jaxba.ba._factor import factor_solve, factorise
from jaxba.ba._gauge import require_gauge
from jaxba.ba._linearise import Linearisation, linearise
from jaxba.ba._plan import Plan, make_plan
from jaxba.ba._problem import Problem
from jaxba.ba._projection import rotation_matrices
from jaxba.ba._rows import Unknowns
from jaxba.ba._schur import Reduced, eliminate_points
from jaxba.ba._system import System, initial_unknowns, make_system
from jaxba.geometry import AbstractLoss, Linear

MAX_UNKNOWNS = 6000  # A^-1 and its copies take 1.2 GB there
_CHUNK = 4096
_COLUMNS = 384  # of A^-1 solved for at a time: keeps one dense matrix in memory, not four
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
    - `variance_factor`: `2 cost / redundancy`, near 1 where the sigmas are right; NaN without redundancy.
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
    prepared = prepare(problem)
    problem = prepared.problem
    require_gauge(problem, "Covariance")
    plan = make_plan(problem)
    _check_size(plan)
    with jax.enable_x64(True), threadpool_limits(1, user_api="blas"):
        system: System = jax.device_put(make_system(problem, plan, _as_arrays(Linear() if loss is None else loss)))
        unknowns: Unknowns = jax.device_put(initial_unknowns(problem, plan))
        marginals = jax.device_get(_marginals(system, plan, unknowns, np.float64(0.0)))
        if not _determined(marginals):
            damped = _marginals(system, plan, unknowns, np.float64(_PROBING))
            weakest = _weakest(jax.device_get(damped), plan, problem)
            raise JaxbaError(
                f"Covariance: the measurements do not determine {weakest}. Hold it fixed or add a prior; an image "
                "needs three points or more that others see, and intrinsics need views from different heights or sides."
            )
    return _in_order(marginals, plan, problem, prepared.dropped)


class _Marginals(eqx.Module):
    """Covariances in the solver's order, padding included."""

    blocks: Float[Array, "images block block"]
    border: Float[Array, "border border"]
    points: Float[Array, "points 3 3"]
    block_inflation: Float[Array, "images block"]
    border_inflation: Float[Array, " border"]
    double_cost: Float[Array, ""]
    num_rows: Float[Array, ""]


@eqx.filter_jit
def _marginals(system: System, plan: Plan, unknowns: Unknowns, damping: Float[Array, ""]) -> _Marginals:
    model = linearise(system, unknowns)
    reduced = eliminate_points(system, model, jax.tree.map(lambda d: damping * d, model.diagonal))
    inverse, cross, corner = _inverse(system, reduced)
    images = jnp.arange(system.shape.num_images)
    blocks = inverse[images, :, images]
    diagonal = jnp.diagonal(reduced.diagonal, axis1=1, axis2=2)
    double_cost, num_rows = _sum_of_losses(system, plan, unknowns, model)
    return _Marginals(
        blocks=blocks,
        border=corner,
        points=_point_covariances(system, plan, reduced, inverse, cross, corner),
        block_inflation=jnp.diagonal(blocks, axis1=1, axis2=2) * diagonal,
        border_inflation=jnp.diagonal(corner) * jnp.diagonal(reduced.corner),
        double_cost=double_cost,
        num_rows=num_rows,
    )


def _inverse(system: System, reduced: Reduced) -> tuple[Array, Array, Array]:
    """Return S^-1: (images block images block), (images block border), (border border)."""
    shape = system.shape
    size = shape.num_images * shape.block
    factor = factorise(system, reduced)
    through, corner = _border(system, reduced, factor)
    cross = -jnp.einsum("mbg,gh->mbh", through, corner)

    def piece(carry: None, column: Array) -> tuple[None, Array]:
        identity = (jnp.arange(size)[:, None] == column).astype(cross.dtype)
        solved, _ = factor_solve(system, reduced, factor, identity.reshape(shape.num_images, shape.block, _COLUMNS))
        solved = solved.reshape(size, _COLUMNS)
        if shape.border:
            own = jnp.take(through.reshape(size, shape.border), column, axis=0, mode="clip")
            solved -= cross.reshape(size, shape.border) @ own.T
        return carry, solved.T

    _, inverse = jax.lax.scan(piece, None, jnp.arange(size + -size % _COLUMNS).reshape(-1, _COLUMNS))
    inverse = inverse.reshape(-1, size)[:size]
    return inverse.reshape(shape.num_images, shape.block, shape.num_images, shape.block), cross, corner


def _border(system: System, reduced: Reduced, factor: tuple[Array, ...]) -> tuple[Array, Array]:
    """Return F and G^-1."""
    if not system.shape.border:
        return reduced.border, reduced.corner
    through, _ = factor_solve(system, reduced, factor, reduced.border)
    corner = reduced.corner - jnp.einsum("mbg,mbh->gh", reduced.border, through)
    scale = 1 / jnp.sqrt(jnp.diagonal(corner))
    root = jnp.linalg.cholesky((corner + corner.T) / 2 * scale[:, None] * scale)
    half = jax.scipy.linalg.solve_triangular(root, jnp.diag(scale), lower=True)
    return through, half.T @ half


def _point_covariances(
    system: System, plan: Plan, reduced: Reduced, inverse: Array, cross: Array, corner: Array
) -> Float[Array, "points 3 3"]:
    shape = system.shape
    point, image = jnp.asarray(plan.row_point), jnp.asarray(plan.row_image)
    z, z_shared = reduced.z, reduced.z_shared
    num_shared = z_shared.shape[-1]
    cross, corner = cross[:, :, :num_shared], corner[:num_shared, :num_shared]  # no observation sees the lever arm

    def pieces(rows: Array) -> Array:
        last = shape.num_rows - 1  # padding, of weight zero
        return jnp.pad(rows.reshape(-1), (0, -rows.size % _CHUNK), constant_values=last).reshape(-1, _CHUNK)

    def add_pairs(total: Array, pair: tuple[Array, Array]) -> tuple[Array, None]:
        first, second = pair
        between = inverse[image[first], :, image[second]]
        product = jnp.einsum("nij,njk,nlk->nil", z[first], between, z[second])
        return total.at[point[first]].add(product), None

    def add_border(total: Array, rows: Array) -> tuple[Array, None]:
        return total.at[point[rows]].add(jnp.einsum("nij,njk->nik", z[rows], cross[image[rows]])), None

    every = pieces(jnp.arange(shape.num_rows, dtype=jnp.int32))
    total = jnp.zeros((shape.num_points, 3, 3), z.dtype)
    if shape.num_blocks:
        pairs = (pieces(jnp.asarray(plan.pair_first)), pieces(jnp.asarray(plan.pair_second)))
        total, _ = jax.lax.scan(add_pairs, total, pairs)
    total, _ = jax.lax.scan(add_pairs, total + jnp.swapaxes(total, 1, 2), (every, every))
    if num_shared:
        through, _ = jax.lax.scan(add_border, jnp.zeros_like(z_shared), every)
        mixed = jnp.einsum("nik,njk->nij", through, z_shared)
        total += mixed + jnp.swapaxes(mixed, 1, 2)
        total += jnp.einsum("nik,kl,njl->nij", z_shared, corner, z_shared)
    root = _lower_triangle(reduced.point_root)
    covariances = jnp.einsum("nki,nkl,nlj->nij", root, jnp.eye(3, dtype=z.dtype) + total, root)
    return covariances * system.free.points[:, :1, None]


def _lower_triangle(root: Float[Array, "points 6"]) -> Float[Array, "points 3 3"]:
    """L^-1 as matrices, from (xx, yx, yy, zx, zy, zz)."""
    rows, columns = np.tril_indices(3)
    return jnp.zeros((root.shape[0], 3, 3), root.dtype).at[:, rows, columns].set(root)


def _sum_of_losses(system: System, plan: Plan, unknowns: Unknowns, model: Linearisation) -> tuple[Array, Array]:
    """Return twice the cost of the components that depend on something free, and their number."""
    group, free = system.reprojection, system.free
    of_image = free.poses[:, 0] + jnp.sum(free.intrinsics[jnp.asarray(group.camera_index)], axis=1)
    anything = of_image[jnp.asarray(plan.row_image)] + free.points[jnp.asarray(plan.row_point), 0]
    depends = (anything > 0) & (jnp.asarray(plan.row_observation) >= 0)
    squared = jnp.sum(group.residual(unknowns)[0].reshape(2, -1) ** 2, axis=0)
    total, number = jnp.sum(system.loss(jnp.where(depends, squared, 0.0))), 2 * jnp.sum(depends)
    for prior, rows in zip(system.priors, model.prior_rows, strict=True):
        residual = prior.residual(unknowns)
        depends = jnp.zeros(residual.shape, bool)
        for derivative in (rows.pose, rows.intrinsics, rows.lever_arm, rows.point):
            if derivative is not None:
                depends |= jnp.any(derivative != 0, axis=1)
        total += jnp.sum(prior.loss(jnp.sum(jnp.where(depends, residual, 0.0) ** 2, axis=0)))
        number += jnp.sum(depends)
    return total, number


def _in_order(marginals: _Marginals, plan: Plan, problem: Problem, dropped: Dropped) -> Covariance:
    """Return the covariances in the problem's order, without padding, zero for what is fixed."""
    shape, free = plan.shape, problem.free
    rank = np.argsort(plan.image_order)
    blocks = np.asarray(marginals.blocks)[rank]
    poses = blocks[:, :6, :6] * np.asarray(free.poses)[:, None, None]
    rotation = rotation_matrices(problem.poses)
    centers = np.swapaxes(rotation, 1, 2) @ poses[:, 3:, 3:] @ rotation

    names = type(problem.cameras).parameter_names()
    refined = np.flatnonzero(shape.refined)
    num_cameras, num_shared = problem.num_cameras, shape.border - (3 if shape.lever_arm else 0)
    free_intrinsics = np.asarray(free.intrinsics)
    shared_free = np.zeros(0, bool) if shape.own_cameras else free_intrinsics[:, refined].reshape(-1)
    border_free = np.append(shared_free, np.ones(shape.border - num_shared, bool))
    border = np.asarray(marginals.border) * np.outer(border_free, border_free)
    intrinsics = np.zeros((num_cameras, len(names), len(names)))
    if shape.own_cameras:
        intrinsics[np.ix_(np.asarray(problem.camera_index), refined, refined)] = blocks[:, 6:, 6:]
        intrinsics *= free_intrinsics[:, :, None] & free_intrinsics[:, None]
    else:
        of_cameras = border[:num_shared, :num_shared].reshape(num_cameras, len(refined), num_cameras, len(refined))
        cameras = np.arange(num_cameras)
        intrinsics[np.ix_(cameras, refined, refined)] = of_cameras[cameras, :, cameras]
    redundancy = int(marginals.num_rows) - _num_free(problem)
    return Covariance(
        poses=poses,
        centers=centers,
        intrinsics=intrinsics,
        lever_arm=border[num_shared:, num_shared:] if shape.lever_arm else np.zeros((3, 3)),
        points=np.asarray(marginals.points)[np.argsort(plan.point_order)],
        border=border,
        border_names=_border_names(plan, problem),
        variance_factor=float(marginals.double_cost) / redundancy if redundancy > 0 else np.nan,
        redundancy=redundancy,
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


def _determined(marginals: _Marginals) -> bool:
    inflation = np.append(np.ravel(marginals.block_inflation), marginals.border_inflation)
    return bool(np.isfinite(marginals.points).all() and np.max(inflation, initial=0.0) < _MAX_INFLATION)


def _weakest(damped: _Marginals, plan: Plan, problem: Problem) -> str:
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
