"""System: a problem in the solver's own order and padded shapes, the one argument of every compiled function.

`structured` finds what can be solved, and its plan; `make_system` moves values from the problem into the layout of the
plan; `initial_unknowns` and `restore` move unknowns in and out. On the host this is numpy, so nothing compiles for a
shape that is not a bucket's; with tracers it is jax.
"""

import dataclasses
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.core import Tracer
from jaxtyping import Float, Int
from scipy.spatial.transform import Rotation

from jaxba.ba._plan import ROW_RUN, LinearSolver, Orders, Plan, make_plan
from jaxba.ba._plan_shape import PlanShape
from jaxba.ba._problem import AbstractPrior, Problem
from jaxba.ba._projection import camera_centers
from jaxba.ba._unknowns import Step, Unknowns
from jaxba.ba.checks import Prepared, prepare
from jaxba.ba.groups import Reprojection
from jaxba.geometry import AbstractLoss, Linear, Pose


class System(eqx.Module):
    """A bundle adjustment problem ready to be solved.

    - `free`: 1 where an unknown may change, 0 where it is fixed or padding.
    - `lower`, `upper`: bounds on the intrinsics.
    - `point_image`, `pair_*`, `block_*`: see `Plan`.
    """

    reprojection: Reprojection
    loss: AbstractLoss
    priors: tuple[AbstractPrior, ...]
    free: Step
    lower: Float[Array | np.ndarray, "cameras parameters"]
    upper: Float[Array | np.ndarray, "cameras parameters"]
    point_image: Int[Array | np.ndarray, " points"]
    pair_first: Int[Array | np.ndarray, "chunks pair_chunk pair_run"]
    pair_second: Int[Array | np.ndarray, "chunks pair_chunk pair_run"]
    pair_block: Int[Array | np.ndarray, " pair_runs"]
    block_row: Int[Array | np.ndarray, " blocks"]
    block_column: Int[Array | np.ndarray, " blocks"]
    shape: PlanShape = eqx.field(static=True)


def structured(problem: Problem, plan: Plan | PlanShape | None, linear_solver: LinearSolver) -> tuple[Prepared, Plan]:
    """Return what can be solved of a problem whose values are known, and its plan.

    A plan that was given stands unless something was left out. Then its shape gives the least sizes of a new one, as
    a shape alone does.
    Raises `JaxbaError` as `prepare` does.
    """
    prepared = prepare(problem)
    if not isinstance(plan, Plan) or prepared.dropped.any():
        like = plan.shape if isinstance(plan, Plan) else plan
        plan = make_plan(prepared.problem, linear_solver=linear_solver, like=like)
    return prepared, plan


def centred(problem: Problem) -> tuple[Problem, Float[np.ndarray, "3"]]:
    """Return the problem in coordinates about the middle of its cameras, and where that lies, in whole metres.

    The coordinates stay where the middle is no further from the origin than the block is wide. Far from it, float64
    holds a position of 4.6e6 m to 1e-9 m, and the noise of that in the cost hides the last steps to the optimum.
    """
    rotation = Rotation.from_quat(np.array(problem.poses.quaternion, float), scalar_first=True)
    centers = camera_centers(problem.poses)
    origin = np.round(np.median(centers, axis=0))
    if np.abs(origin).max() <= np.ptp(centers, axis=0).max() or any(p.in_world is None for p in problem.priors):
        return problem, np.zeros(3)

    def moved(prior: AbstractPrior) -> AbstractPrior:
        return dataclasses.replace(prior, **{name: getattr(prior, name) - origin for name in prior.in_world or ()})

    poses = Pose(problem.poses.quaternion, problem.poses.translation + rotation.apply(origin))
    near = poses, problem.points - origin, tuple(moved(prior) for prior in problem.priors)
    return eqx.tree_at(lambda p: (p.poses, p.points, p.priors), problem, near), origin


def make_system(problem: Problem, plan: Plan, loss: AbstractLoss, dtype: Any = np.float64) -> System:
    """Return the system of a problem under a plan made from the same indices."""
    xp = _namespace((problem, loss, plan))
    shape, observations = plan.shape, problem.observations
    seen = plan.row_observation >= 0
    source = xp.where(seen, plan.row_observation, 0)
    weight = xp.where(seen, 1 / xp.asarray(observations.std_px, dtype)[source], 0.0)
    camera_of_image = _camera_of_image(xp, problem, plan)
    runs = (-1, ROW_RUN)
    reprojection = Reprojection(
        xy_px=xp.asarray(observations.xy_px, dtype)[source].T.reshape(2, *runs),
        weight=weight.reshape(runs),
        point_index=plan.row_point.reshape(runs),
        run_image=plan.row_image[::ROW_RUN],
        camera_index=camera_of_image,
        model=type(problem.cameras),
        refined=shape.refined,
    )
    free = Step(
        poses=_padded(xp, problem.free.poses, plan.image_order, shape.num_images, 0.0, dtype)[:, None]
        * xp.ones((1, 6), dtype),
        intrinsics=_padded(xp, problem.free.intrinsics, plan.camera_order, shape.num_cameras, 0.0, dtype),
        antenna=xp.asarray(problem.free_antenna, dtype),
        points=_padded(xp, problem.free.points, plan.point_order, shape.num_points, 0.0, dtype)[:, None]
        * xp.ones((1, 3), dtype),
    )
    return System(
        reprojection=reprojection,
        loss=_as_arrays(xp, loss, dtype),
        priors=tuple(_reordered(xp, *each, plan, dtype) for each in zip(problem.priors, shape.prior_rows, strict=True)),
        free=free,
        lower=_padded(xp, problem.lower, plan.camera_order, shape.num_cameras, -np.inf, dtype),
        upper=_padded(xp, problem.upper, plan.camera_order, shape.num_cameras, np.inf, dtype),
        point_image=plan.point_image,
        pair_first=plan.pair_first,
        pair_second=plan.pair_second,
        pair_block=plan.pair_block,
        block_row=plan.block_row,
        block_column=plan.block_column,
        shape=shape,
    )


def initial_unknowns(problem: Problem, plan: Plan, dtype: Any = np.float64) -> Unknowns:
    """Return the problem's start values in the solver's order."""
    xp = _namespace((problem, plan))
    names = type(problem.cameras).parameter_names()
    parameters = xp.stack([xp.asarray(getattr(problem.cameras, name), dtype) for name in names], axis=-1)
    return arrange(Unknowns(problem.poses, parameters, problem.antenna, problem.points), plan, dtype)


def own_unknowns(problem: Problem) -> Unknowns:
    """Return a problem's start values in its own order, as numpy arrays of their own."""
    names = type(problem.cameras).parameter_names()
    intrinsics = np.stack([np.asarray(getattr(problem.cameras, name), float) for name in names], axis=-1)
    poses = Pose(np.array(problem.poses.quaternion, float), np.array(problem.poses.translation, float))
    return Unknowns(poses, intrinsics, np.array(problem.antenna, float), np.array(problem.points, float))


def arrange(unknowns: Unknowns, plan: Orders, dtype: Any = np.float64) -> Unknowns:
    """Return unknowns in the problem's order in the solver's, with padding."""
    xp = _namespace((unknowns, plan))
    shape = plan.shape
    quaternion = _padded(xp, unknowns.poses.quaternion, plan.image_order, shape.num_images, 0.0, dtype)
    quaternion = xp.concatenate(
        [quaternion[: len(plan.image_order)], _identity(shape.num_images - len(plan.image_order))]
    )
    return Unknowns(
        poses=Pose(
            xp.asarray(quaternion, dtype),
            _padded(xp, unknowns.poses.translation, plan.image_order, shape.num_images, 0.0, dtype),
        ),
        intrinsics=_padded(xp, unknowns.intrinsics, plan.camera_order, shape.num_cameras, None, dtype),
        antenna=xp.asarray(unknowns.antenna, dtype),
        points=_padded(xp, unknowns.points, plan.point_order, shape.num_points, 1.0, dtype),
    )


def restore(unknowns: Unknowns, plan: Orders) -> Unknowns:
    """Return the unknowns in the problem's own order, without padding."""
    xp = _namespace((unknowns, plan))
    image_rank, point_rank = xp.argsort(plan.image_order), xp.argsort(plan.point_order)
    camera_rank = xp.argsort(plan.camera_order)
    return Unknowns(
        poses=Pose(
            xp.asarray(unknowns.poses.quaternion)[image_rank], xp.asarray(unknowns.poses.translation)[image_rank]
        ),
        intrinsics=xp.asarray(unknowns.intrinsics)[camera_rank],
        antenna=xp.asarray(unknowns.antenna),
        points=xp.asarray(unknowns.points)[point_rank],
    )


def from_centred(unknowns: Unknowns, origin: Float[np.ndarray, "3"]) -> Unknowns:
    """Return unknowns that count from `origin` in coordinates of the world."""
    if not origin.any():
        return unknowns
    rotation = Rotation.from_quat(np.array(unknowns.poses.quaternion, float), scalar_first=True)
    translation = unknowns.poses.translation - rotation.apply(origin)
    world = Pose(unknowns.poses.quaternion, translation), unknowns.points + origin
    return eqx.tree_at(lambda u: (u.poses, u.points), unknowns, world)


def without_losses(system: System) -> System:
    """Return the system as least squares."""
    linear = tuple(dataclasses.replace(prior, loss=Linear()) for prior in system.priors)
    return dataclasses.replace(system, loss=Linear(), priors=linear)


def has_sigmas(prior: AbstractPrior) -> bool:
    """Return whether a prior can be filled up with rows that weigh nothing."""
    return any(field.name.startswith("std") for field in dataclasses.fields(prior))


def is_traced(tree: Any) -> bool:
    """Whether any leaf is a tracer of jax's."""
    return any(isinstance(leaf, Tracer) for leaf in jax.tree.leaves(tree))


def _namespace(tree: Any) -> Any:
    """numpy for concrete values, jax.numpy where anything is traced."""
    return jnp if is_traced(tree) else np


def _as_arrays(xp: Any, loss: AbstractLoss, dtype: Any) -> AbstractLoss:
    """Scales as arrays, so that another scale is not another program to compile."""
    return jax.tree.map(lambda leaf: xp.asarray(leaf, dtype), loss)


def _identity(count: int) -> Float[np.ndarray, "count 4"]:
    quaternion = np.zeros((count, 4))
    quaternion[:, 0] = 1
    return quaternion


def _camera_of_image(xp: Any, problem: Problem, plan: Plan) -> Any:
    if plan.shape.own_cameras:
        return np.arange(plan.shape.num_images, dtype=np.int32)
    return _padded(xp, problem.camera_index, plan.image_order, plan.shape.num_images, 0.0, np.int32)


def _padded(xp: Any, values: Any, order: Array | np.ndarray, count: int, fill: float | None, dtype: Any) -> Any:
    """Reorder along the first axis and pad to `count`, with a value or with copies of the first entry."""
    ordered = xp.asarray(values, dtype)[order]
    missing = count - len(order)
    tail_shape = (missing, *ordered.shape[1:])
    tail = xp.broadcast_to(ordered[:1], tail_shape) if fill is None else xp.full(tail_shape, fill, dtype)
    return xp.concatenate([ordered, tail]) if missing else ordered


def _reordered(xp: Any, prior: AbstractPrior, rows: int, plan: Plan, dtype: Any) -> AbstractPrior:
    """Return a prior with its indices in the solver's order; if it has sigmas, filled up with rows of infinite ones."""
    ranks = {
        "image_index": xp.argsort(plan.image_order),
        "point_index": xp.argsort(plan.point_order),
        "camera_index": xp.argsort(plan.camera_order),
    }
    padded = has_sigmas(prior)
    changed: dict[str, Any] = {}
    for field in dataclasses.fields(prior):
        value = getattr(prior, field.name)
        if field.name == "loss":
            changed["loss"] = _as_arrays(xp, value, dtype)
            continue
        if value is None:
            continue
        is_index = field.name.endswith("_index")
        of = np.int32 if is_index else dtype
        value = xp.asarray(ranks[field.name], of)[value] if field.name in ranks else xp.asarray(value, of)
        count = value.shape[0]
        fill = np.inf if field.name.startswith("std") else None if count else 0.0 if is_index else 1.0
        changed[field.name] = _padded(xp, value, np.arange(count), rows if padded else count, fill, of)
    return dataclasses.replace(prior, **changed)
