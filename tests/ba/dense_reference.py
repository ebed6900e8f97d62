"""The dense reference that the solver is held to, and the solver driven by hand.

`Dense` writes a problem as one function of one flat tangent vector, from `camera.project`, `Pose.transform`,
`Pose.retract` and the priors' `residual` alone: nothing of the solver's order, padding, blocks or derivatives.
Everything that follows from it (Jacobian, normal equations, scipy's optimum) is dense. One program serves all problems
of the same sizes, whatever of them is free and whatever their losses.
"""

import dataclasses
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import scipy.optimize
from jax import Array
from quick_jit import quick_jit
from scipy.spatial.transform import Rotation

from jaxba.ba import Problem, Step, Unknowns
from jaxba.ba._descend import descend
from jaxba.ba._plan import LinearSolver, Plan, make_plan
from jaxba.ba._solvers import AbstractSchurSolver, State
from jaxba.ba._system import System, initial_unknowns, make_system, restore
from jaxba.geometry import AbstractLoss, Linear, Pose


def start_of(problem: Problem) -> Unknowns:
    """Return a problem's start values in its own order."""
    parameters = np.stack([getattr(problem.cameras, name) for name in problem.cameras.parameter_names()], axis=-1)
    return Unknowns(problem.poses, parameters, problem.antenna, problem.points)


def solver_view(
    problem: Problem, loss: AbstractLoss | None = None, linear_solver: LinearSolver = "auto"
) -> tuple[Plan, System, Unknowns]:
    """Return (plan, system, start) of a problem, the arrays on the device."""
    plan = make_plan(problem, linear_solver=linear_solver)
    system, start = make_system(problem, plan, Linear() if loss is None else loss), initial_unknowns(problem, plan)
    return plan, jax.device_put(system), jax.device_put(start)


def in_own_order(step: Step, problem: Problem, plan: Plan) -> Step:
    """Return a step of the solver in the problem's order, without padding."""
    poses = np.zeros((problem.num_images, 6))
    poses[plan.image_order] = step.poses[: problem.num_images]
    points = np.zeros((problem.num_points, 3))
    points[plan.point_order] = step.points[: problem.num_points]
    intrinsics = np.asarray(step.intrinsics)
    if plan.shape.own_cameras:
        cameras = np.asarray(problem.camera_index)[plan.image_order]
        intrinsics = intrinsics[: problem.num_images][np.argsort(cameras)]
    return Step(poses, intrinsics, np.asarray(step.antenna), points)


class Minimum(NamedTuple):
    """What the solver found, and the plan that brings it into the problem's order."""

    unknowns: Unknowns
    state: State
    plan: Plan


def minimise(
    problem: Problem, loss: AbstractLoss, solver: AbstractSchurSolver, linear_solver: LinearSolver = "auto"
) -> Minimum:
    """Run the solver step by step from the problem's start values, at most 300 steps."""
    plan, system, unknowns = solver_view(problem, loss, linear_solver)
    reached = descend(solver, unknowns, system, 300)
    return Minimum(restore(jax.device_get(reached.unknowns), plan), jax.device_get(reached.state), plan)


class Group(NamedTuple):
    """Rows of one residual group: residuals (rows, components), Jacobian (rows, components, free unknowns)."""

    residual: np.ndarray
    jacobian: np.ndarray
    loss: AbstractLoss


class Dense:
    """A problem around its start values, as functions of the tangent vector of everything that is free.

    - `size`: free unknowns, in the order poses, intrinsics, antenna, points.
    - `lower`, `upper`: bounds of the tangent vector.
    """

    def __init__(self, problem: Problem, loss: AbstractLoss | None = None):
        self.losses = (Linear() if loss is None else loss, *(p.loss for p in problem.priors))
        start, free = start_of(problem), problem.free
        self._masks = (
            np.repeat(free.poses[:, None], 6, axis=1),
            np.asarray(free.intrinsics),
            problem.free_antenna,
            np.repeat(free.points[:, None], 3, axis=1),
        )
        self._place = np.flatnonzero(np.concatenate([mask.ravel() for mask in self._masks]))
        self.size = len(self._place)
        self.lower = self._bound(-np.inf, problem.lower - start.intrinsics)
        self.upper = self._bound(np.inf, problem.upper - start.intrinsics)
        priors = tuple(dataclasses.replace(prior, loss=Linear()) for prior in problem.priors)
        self._values = jax.tree.map(np.asarray, (start, dataclasses.replace(problem, priors=priors)))
        self._last: tuple[np.ndarray, list[Group]] | None = None

    def _bound(self, default: float, intrinsics: Array) -> np.ndarray:
        poses, _, antenna, points = (np.full(mask.shape, default) for mask in self._masks)
        return self.flat(Step(poses, intrinsics, antenna, points))

    def flat(self, step: Step) -> np.ndarray:
        """Return the free entries of a step in the problem's order."""
        leaves = step.poses, step.intrinsics, step.antenna, step.points
        return np.concatenate([np.asarray(leaf)[mask] for leaf, mask in zip(leaves, self._masks, strict=True)])

    def tangent(self, unknowns: Unknowns) -> np.ndarray:
        """Return the tangent vector that leads to unknowns in the problem's order."""
        start = self._values[0]
        turn = _scipy(unknowns.poses) * _scipy(start.poses).inv()
        moved = np.array(unknowns.poses.translation) - turn.apply(np.array(start.poses.translation))
        return self.flat(
            Step(
                np.concatenate([turn.as_rotvec(), moved], axis=1),
                unknowns.intrinsics - start.intrinsics,
                unknowns.antenna - start.antenna,
                unknowns.points - start.points,
            )
        )

    def groups(self, vector: np.ndarray | None = None) -> list[Group]:
        """Return residuals and Jacobians of every group, by `jax.jacfwd` of the whole."""
        vector = np.zeros(self.size) if vector is None else vector
        if self._last is None or not np.array_equal(self._last[0], vector):  # scipy asks for values, then derivatives
            full = np.zeros(sum(mask.size for mask in self._masks))
            full[self._place] = vector
            jacobians, residuals = jax.device_get(_derivatives(full, *self._values))
            rows = zip(residuals, jacobians, self.losses, strict=True)
            self._last = vector.copy(), [Group(r, j[:, :, self._place], loss) for r, j, loss in rows]
        return self._last[1]

    def cost(self, vector: np.ndarray) -> float:
        """Return half the sum of losses."""
        return sum(float(np.sum(_rho(loss, r)[0])) for r, _, loss in self.groups(vector)) / 2

    def square_rooted(self, vector: np.ndarray) -> np.ndarray:
        """Return residuals whose plain squares sum to twice the robust cost, `sqrt(rho(s) / s) r` with `s = |r|^2`."""
        return np.concatenate([(_root(_rho(loss, r)[0], r)[:, None] * r).ravel() for r, _, loss in self.groups(vector)])

    def square_rooted_jacobian(self, vector: np.ndarray) -> np.ndarray:
        """Return the Jacobian of `square_rooted`."""
        jacobians = []
        for r, jacobian, loss in self.groups(vector):
            rho, slope = _rho(loss, r)
            squared, root = np.maximum(np.sum(r**2, axis=1), _TINY), _root(rho, r)
            root_slope = (slope - rho / squared) / squared / (2 * root)
            along = np.einsum("rc,rcn->rn", r, jacobian)
            jacobian = root[:, None, None] * jacobian + 2 * (root_slope[:, None] * r)[:, :, None] * along[:, None]
            jacobians.append(jacobian.reshape(-1, self.size))
        return np.concatenate(jacobians)

    def scipy_optimum(self, start: np.ndarray | None = None) -> np.ndarray:
        """Return the optimum that scipy finds: MINPACK's Levenberg-Marquardt, or dogbox where there are bounds."""
        bounded = np.isfinite(self.lower).any() or np.isfinite(self.upper).any()
        result = scipy.optimize.least_squares(
            self.square_rooted,
            np.zeros(self.size) if start is None else start,
            jac=self.square_rooted_jacobian,
            bounds=(self.lower, self.upper),
            method="dogbox" if bounded else "lm",
            x_scale="jac",
            ftol=1e-15,
            xtol=1e-15,
            gtol=1e-15,
            max_nfev=500,
        )
        return result.x


_TINY = 1e-300


def _scipy(poses: Pose) -> Rotation:
    return Rotation.from_quat(np.array(poses.quaternion), scalar_first=True)


def _root(rho: np.ndarray, residual: np.ndarray) -> np.ndarray:
    squared = np.sum(residual**2, axis=1)
    return np.sqrt(np.where(squared > 0, rho / np.maximum(squared, _TINY), 1.0))


def _rho(loss: AbstractLoss, residual: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return rho and its slope at every row."""
    return loss_derivatives(loss, np.sum(residual**2, axis=1))[:2]


_LOSS_ROWS = 4096


def loss_derivatives(loss: AbstractLoss, squared: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return rho, its slope and its curvature of squared norms, at most `_LOSS_ROWS` of them."""
    padded = np.zeros(_LOSS_ROWS)
    padded[: len(squared)] = squared
    rho, slope, curvature = jax.device_get(_loss_derivatives(jax.tree.map(np.asarray, loss), padded))
    return rho[: len(squared)], slope[: len(squared)], curvature[: len(squared)]


_loss_derivatives = quick_jit(lambda loss, squared: loss.derivatives(squared))


def _moved(full: Array, start: Unknowns) -> Unknowns:
    sizes = start.poses.translation.shape[0] * 6, start.intrinsics.size, start.antenna.size, start.points.size
    poses, intrinsics, antenna, points = jnp.split(full, np.cumsum(sizes)[:-1])
    return Unknowns(
        start.poses.retract(poses.reshape(-1, 6)),
        start.intrinsics + intrinsics.reshape(start.intrinsics.shape),
        start.antenna + antenna,
        start.points + points.reshape(-1, 3),
    )


def _residuals(full: Array, start: Unknowns, problem: Problem) -> tuple[tuple, tuple]:
    """Return the residuals of every group, (rows, components), twice: to differentiate, and to keep."""
    unknowns, seen = _moved(full, start), problem.observations
    pose = Pose(unknowns.poses.quaternion[seen.image_index], unknowns.poses.translation[seen.image_index])
    camera = type(problem.cameras).from_parameters(unknowns.intrinsics[problem.camera_index[seen.image_index]])
    pixel = camera.project(pose.transform(unknowns.points[seen.point_index]))
    residuals = ((pixel - seen.xy_px) / seen.std_px[:, None], *(p.residual(unknowns).T for p in problem.priors))
    return residuals, residuals


# the problem is an argument, not a constant: one compilation serves all problems of the same shapes
_derivatives = quick_jit(jax.jacfwd(_residuals, has_aux=True))
