"""scipy's trust-region reflective least squares on the same problem, with a sparse exact Jacobian.

scipy applies a loss to every component alone, so it is handed residuals that carry the loss already: with
s = |r|^2 of one observation and e = r sqrt(rho(s) / s), half the sum of |e|^2 is the robust cost, and

    de = g dr + 2 g' r (r . dr),   g = sqrt(rho / s),   g' = dg/ds = (rho' s - rho) / (2 g s^2)

The unknowns of an image are a rotation vector w from its start attitude and its translation t, both added to by scipy:
R = exp(w) R0. With the derivatives by a step (d, v) on the left of the pose, d = J_l(w) dw and v = dt + [t]_x d.
"""

import time
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy
from numpy.typing import ArrayLike
from scipy.optimize import least_squares
from scipy.sparse import csr_array, vstack

from benchmarks.record import HistoryRow, Record, Values
from jaxba.ba import Problem, Unknowns
from jaxba.ba.groups import Reprojection
from jaxba.geometry import (
    AbstractLoss,
    Pose,
    hat,
    quaternion_conjugate,
    quaternion_exp,
    quaternion_log,
    quaternion_multiply,
    so3_left_jacobian_inverse,
)


def solve_with_scipy(
    problem: Problem, loss: AbstractLoss, *, time_limit_s: float = 60.0, max_nfev: int = 200, ftol: float = 1e-8
) -> Record:
    """Solve a problem with `least_squares(method="trf", tr_solver="lsmr", x_scale="jac")`.

    It is stopped at the first evaluation after `time_limit_s` seconds; the record then holds the best values so far.
    """
    with jax.enable_x64(True):
        return _solve(problem, loss, time_limit_s, max_nfev, ftol)


class _TimeUp(Exception):
    pass


def _solve(problem: Problem, loss: AbstractLoss, time_limit_s: float, max_nfev: int, ftol: float) -> Record:
    unknowns_of, x0, free = _vector(problem)
    evaluate = _evaluator(problem, loss, unknowns_of, free)
    start = time.perf_counter()
    residuals, _ = evaluate(x0)  # compiles
    compile_s = time.perf_counter() - start

    history: list[HistoryRow] = []
    best = (0.5 * float(residuals @ residuals), x0[free])
    start = time.perf_counter()
    last: dict[bytes, tuple[np.ndarray, csr_array]] = {}

    def at(x: np.ndarray) -> tuple[np.ndarray, csr_array]:
        key = x.tobytes()
        if key not in last:
            last.clear()
            full = x0.copy()
            full[free] = x
            last[key] = evaluate(full)
        return last[key]

    def fun(x: np.ndarray) -> np.ndarray:
        nonlocal best
        seconds = time.perf_counter() - start
        if seconds > time_limit_s and history:
            raise _TimeUp
        residuals = at(x)[0]
        cost = 0.5 * float(residuals @ residuals)
        accepted = not history or cost < best[0]
        history.append(
            {"step": len(history), "seconds": time.perf_counter() - start, "cost": cost, "accepted": accepted}
        )
        if accepted:
            best = cost, x.copy()
        return residuals

    jac: Any = lambda x: at(x)[1]  # noqa: E731  scipy's annotation knows names only
    bounds = tuple(_bounds(problem, *side)[free] for side in ((problem.lower, -np.inf), (problem.upper, np.inf)))
    try:
        result = least_squares(
            fun, x0[free], jac=jac, bounds=bounds, method="trf", tr_solver="lsmr", x_scale="jac",
            ftol=ftol, xtol=1e-12, gtol=1e-12, max_nfev=max_nfev,
        )  # fmt: skip
        termination = result.message
    except _TimeUp:
        termination = f"Stopped after {time_limit_s:g} s."
    seconds_total = time.perf_counter() - start
    final = x0.copy()
    final[free] = best[1]
    unknowns = unknowns_of(final)
    return Record(
        solver=f"scipy {scipy.__version__} trf",
        initial_cost=history[0]["cost"],
        final_cost=best[0],
        history=history,
        seconds_preprocess=0.0,
        seconds_compile=compile_s,
        seconds_total=seconds_total,
        termination=termination,
        num_iterations=len(history) - 1,
        values=Values(
            np.array(unknowns.poses.quaternion),
            np.array(unknowns.poses.translation),
            np.array(unknowns.intrinsics),
            np.array(unknowns.points),
        ),
    )


def _vector(problem: Problem) -> tuple[Callable[[np.ndarray], Unknowns], np.ndarray, np.ndarray]:
    """Return how to read a vector, the start vector, and the indices of what is free in it.

    Order: poses (w, t), intrinsics, lever arm, points.
    """
    start = Values.of(problem)
    n, points = problem.num_images, problem.num_points
    sizes = np.cumsum([6 * n, start.intrinsics.size, 3])
    poses = np.concatenate([np.zeros((n, 3)), start.translation], axis=1)
    x0 = np.concatenate([poses.ravel(), start.intrinsics.ravel(), np.asarray(problem.lever_arm), start.points.ravel()])

    def unknowns_of(x: np.ndarray) -> Unknowns:
        pose, intrinsics, lever_arm, point = np.split(x, sizes)
        pose = pose.reshape(n, 6)
        quaternion = quaternion_multiply(quaternion_exp(jnp.asarray(pose[:, :3])), jnp.asarray(start.quaternion))
        return Unknowns(
            Pose(quaternion, jnp.asarray(pose[:, 3:])),
            jnp.asarray(intrinsics.reshape(start.intrinsics.shape)),
            jnp.asarray(lever_arm),
            jnp.asarray(point.reshape(points, 3)),
        )

    free = problem.free
    mask = np.concatenate(
        [
            np.repeat(free.poses, 6),
            np.ravel(free.intrinsics),
            np.repeat(free.lever_arm, 3),
            np.repeat(free.points, 3),
        ]
    )
    return unknowns_of, x0, np.flatnonzero(mask)


def _bounds(problem: Problem, side: ArrayLike, infinite: float) -> np.ndarray:
    before, after = np.full(6 * problem.num_images, infinite), np.full(3 + 3 * problem.num_points, infinite)
    return np.concatenate([before, np.ravel(np.asarray(side)), after])


def _evaluator(
    problem: Problem, loss: AbstractLoss, unknowns_of: Callable[[np.ndarray], Unknowns], free: np.ndarray
) -> Callable[[np.ndarray], tuple[np.ndarray, csr_array]]:
    observations = problem.observations
    image, point = np.asarray(observations.image_index), np.asarray(observations.point_index)
    reprojection = Reprojection(  # runs of one lane: a run an observation
        xy_px=jnp.asarray(observations.xy_px).T[:, :, None],
        weight=1 / jnp.asarray(observations.std_px)[:, None],
        point_index=jnp.asarray(point)[:, None],
        run_image=jnp.asarray(image),
        camera_index=jnp.asarray(problem.camera_index),
        model=type(problem.cameras),
        refined=tuple(bool(column.any()) for column in np.asarray(problem.free.intrinsics).T),
    )
    pixel_rows = eqx.filter_jit(reprojection.rows)
    priors = [(prior.loss, eqx.filter_jit(prior.rows)) for prior in problem.priors]
    start_quaternion = jnp.asarray(problem.poses.quaternion)
    num_parameters = problem.lower.shape[1]
    refined = np.flatnonzero(reprojection.refined)
    first = np.cumsum([0, 6 * problem.num_images, problem.lower.size, 3])
    width = first[3] + 3 * problem.num_points
    camera = np.asarray(problem.camera_index)[image]

    def place(start: int, stride: int, index: np.ndarray, within: np.ndarray) -> np.ndarray:
        return start + stride * np.asarray(index)[:, None] + within

    def pixels(unknowns: Unknowns, chain: np.ndarray) -> tuple[np.ndarray, list[np.ndarray], list[np.ndarray]]:
        rows = np.asarray(pixel_rows(unknowns))[..., 0].swapaxes(0, 1)  # (2, rows, columns)
        pose, intrinsics, residual, by_point = np.split(rows, [6, 6 + len(refined), 7 + len(refined)], axis=2)
        columns = [
            place(first[0], 6, image, np.arange(6)),
            place(first[1], num_parameters, camera, refined),
            place(first[3], 3, point, np.arange(3)),
        ]
        return residual[..., 0], columns, [np.einsum("cni,nij->cnj", pose, chain[image]), intrinsics, by_point]

    def of_prior(rows: Any, chain: np.ndarray) -> tuple[np.ndarray, list[np.ndarray], list[np.ndarray]]:
        columns, blocks = [], []
        if rows.pose is not None:
            columns.append(place(first[0], 6, rows.pose.index, np.arange(6)))
            blocks.append(np.einsum("cin,nij->cnj", rows.pose.jacobian, chain[rows.pose.index]))
        if rows.intrinsics is not None:
            columns.append(place(first[1], num_parameters, rows.intrinsics.index, np.arange(num_parameters)))
            blocks.append(np.swapaxes(rows.intrinsics.jacobian, 1, 2))
        if rows.antenna is not None:
            columns.append(np.broadcast_to(first[2] + np.arange(3), (rows.residual.shape[1], 3)))
            blocks.append(np.swapaxes(rows.antenna, 1, 2))
        if rows.point is not None:
            columns.append(place(first[3], 3, rows.point.index, np.arange(3)))
            blocks.append(np.swapaxes(rows.point.jacobian, 1, 2))
        return rows.residual, columns, blocks

    def evaluate(x: np.ndarray) -> tuple[np.ndarray, csr_array]:
        unknowns = unknowns_of(x)
        chain = np.asarray(_chain(unknowns, start_quaternion))
        groups = [(loss, pixels(unknowns, chain))]
        groups += [(of, of_prior(jax.tree.map(np.asarray, rows(unknowns)), chain)) for of, rows in priors]
        residuals, jacobians = [], []
        for group_loss, (residual, columns, blocks) in groups:
            r, jacobian = _with_loss(group_loss, residual, np.concatenate(blocks, axis=2))
            column = np.broadcast_to(np.concatenate(columns, axis=1), jacobian.shape)
            row_end = np.arange(r.size + 1) * jacobian.shape[2]
            residuals.append(r.ravel())
            jacobians.append(csr_array((jacobian.ravel(), column.ravel(), row_end), shape=(r.size, width)))
        return np.concatenate(residuals), csr_array(vstack(jacobians))[:, free]

    return evaluate


def _with_loss(loss: AbstractLoss, residual: np.ndarray, jacobian: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return residuals whose squares sum to rho, (components, rows), and their derivatives, (components, rows, n)."""
    s = np.sum(residual**2, axis=0)
    safe = np.maximum(s, 1e-12)  # below, rho(s) = s to rounding and g = 1
    value, slope, _ = (np.asarray(a) for a in loss.derivatives(jnp.asarray(safe)))
    g = np.sqrt(value / safe)
    g_slope = (slope * safe - value) / (2 * g * safe**2)
    along = np.einsum("cn,cnj->nj", residual, jacobian)
    return g * residual, g[:, None] * jacobian + (2 * g_slope * residual)[:, :, None] * along


@jax.jit
def _chain(unknowns: Unknowns, start_quaternion: jax.Array) -> jax.Array:
    """Return d(step on the left) / d(w, t) of each image, (images, 6, 6)."""
    back = quaternion_conjugate(start_quaternion)
    turn = quaternion_log(quaternion_multiply(jnp.asarray(unknowns.poses.quaternion), back))
    left = jnp.linalg.inv(so3_left_jacobian_inverse(turn))
    identity = jnp.broadcast_to(jnp.eye(3), left.shape)
    top = jnp.concatenate([left, jnp.zeros_like(left)], axis=2)
    bottom = jnp.concatenate([hat(jnp.asarray(unknowns.poses.translation)) @ left, identity], axis=2)
    return jnp.concatenate([top, bottom], axis=1)
