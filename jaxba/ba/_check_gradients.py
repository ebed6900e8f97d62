"""Check gradients: derivatives of a solve beside central differences of solves, for every kind of input.

Along a random direction d of one kind of input, with a step h that moves all unknowns together by 0.05 sigma,

    difference = (x*(theta + h d) - x*(theta - h d)) / 2h, extrapolated from shorter steps,

where each x* is solved anew and brought to the last digits by Newton steps. Errors are norms over all unknowns in
units of `1 / sqrt(diag(J^T J))`, relative to the difference's own: metres and radians do not mix. Reverse mode is held
against forward mode by `<w, dx> = <grad, d>` for a random w.
"""

import dataclasses
import functools
import itertools
from collections.abc import Callable, Iterator
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation
from threadpoolctl import threadpool_limits

from jaxba._errors import JaxbaError
from jaxba.ba._adjoint import Adjoint
from jaxba.ba._linearise import linearise
from jaxba.ba._plan import Plan, make_plan
from jaxba.ba._problem import AbstractPrior, Problem
from jaxba.ba._solution import Solution
from jaxba.ba._solve import solve
from jaxba.ba._system import initial_unknowns, make_system
from jaxba.ba._traced import solve_to_the_last_digits
from jaxba.ba.checks import prepare, require_gauge
from jaxba.ba.groups import ScaleBarPrior
from jaxba.geometry import AbstractLoss, Linear, require_number

_MOVES, _LARGEST_STEP = 0.05, 5e-3  # sigmas of all unknowns together; of the input's sigma
_SHARES = (1.0, 1 / 4, 1 / 16)  # of that step
# near enough for the Newton steps of `solve_to_the_last_digits`, which double the digits; nearer takes twice the steps
_TIGHT: dict[str, Any] = {"ftol": 0.0, "xtol": 1e-10, "gtol": 0.0, "max_nfev": 100}
_TINY = float(np.finfo(float).tiny)
_SIZE_M, _SIZE_PX, _SIZE_RAD, _SIZE_SHAPE = 0.01, 1.0, 1e-3, 1e-3  # of a direction, for what has no sigma of its own


@dataclasses.dataclass(frozen=True)
class GradientRow:
    """One kind of input.

    - `size`: how many numbers it is. `moved`: the optimum's derivative along the direction, in sigmas.
    - `error`: relative, of the derivative of the unknowns and of the cost. `reverse_error`: of reverse mode.
    - `gauss_newton_error`: relative, with J^T J in place of the second derivatives.
    """

    name: str
    size: int
    moved: float
    error: float
    reverse_error: float
    gauss_newton_error: float


@dataclasses.dataclass(frozen=True)
class GradientCheck:
    """A row for each kind of input, and the tolerance they are held to."""

    rows: tuple[GradientRow, ...]
    tolerance: float

    @property
    def passed(self) -> bool:
        """Whether the errors of all rows, in both modes, are within the tolerance."""
        return all(max(row.error, row.reverse_error) <= self.tolerance for row in self.rows)

    def table(self) -> str:
        """Return the rows as text, one a line."""
        width = max(len(row.name) for row in self.rows)
        heads = f"{'numbers':>9}  {'moves (sigma)':>13}  {'error':>8}  {'reverse':>8}  {'Gauss-Newton':>12}"
        lines = [f"{'input':{width}}  {heads}"]
        for row in self.rows:
            over = "" if max(row.error, row.reverse_error) <= self.tolerance else f"  over {self.tolerance:.0e}"
            lines.append(
                f"{row.name:{width}}  {row.size:9d}  {row.moved:13.3g}  {row.error:8.1e}  {row.reverse_error:8.1e}  "
                f"{row.gauss_newton_error:12.1e}{over}"
            )
        return "\n".join(lines)


@dataclasses.dataclass(frozen=True)
class _Input:
    """A leaf of (problem, loss), and the size of a step of each of its numbers; `alike` rows in turn change as one."""

    where: Callable[[tuple[Problem, AbstractLoss]], Any]
    scale: Float[np.ndarray, "..."]
    alike: int = 1


def check_gradients(
    problem: Problem,
    *,
    loss: AbstractLoss | None = None,
    tolerance: float = 1e-5,
    seed: int = 0,
    progress: Callable[[GradientRow], None] | None = None,
) -> GradientCheck:
    """Compare derivatives of `solve` with central differences, for every kind of input that the problem has.

    Pixels and their sigmas, scale and shape of the losses, what priors measured and their sigmas, fixed poses, points,
    intrinsics and lever arm, and bounds that are active at the optimum. What an adjustment leaves out is left out.

    - `tolerance`: relative, of a row that passes. `progress`: called with each row when it is done.

    Raises `JaxbaError` as `solve` does, and where the problem has no gauge: then it has no derivative.

    >>> import jaxba
    >>> survey = jaxba.synthetic.uav_block(4)
    >>> problem = survey.problem.fix(intrinsics=True)
    >>> # takes a minute; notebooks/check_the_gradients.py runs the like
    >>> checked = jaxba.check_gradients(problem, loss=jaxba.Cauchy(2.0))  # doctest: +SKIP
    >>> checked.passed, checked.rows[0].name  # doctest: +SKIP
    (True, 'pixels')
    """
    cure = "give a positive number, e.g. 1e-5"
    require_number("check_gradients: tolerance", tolerance, np.finfo(float).tiny, np.finfo(float).max, cure)
    loss = Linear() if loss is None else loss
    problem = prepare(problem).problem
    require_gauge(problem, "Derivatives")
    with jax.enable_x64(True), threadpool_limits(1, user_api="blas"):
        solution = solve(problem, loss=loss)
        if not solution.converged:
            raise JaxbaError(f"Gradient check: the solve has no optimum to look at. {solution.advice}")
        problem = solution.apply(problem)
        plan = make_plan(problem)
        rng, found = np.random.default_rng(seed), []
        for row in _rows(problem, loss, plan, rng):
            found.append(row)
            if progress is not None:
                progress(row)
    return GradientCheck(tuple(found), tolerance)


def _rows(problem: Problem, loss: AbstractLoss, plan: Plan, rng: np.random.Generator) -> Iterator[GradientRow]:
    """Check one input after the other; all of them are arguments of what is differentiated, which so compiles once."""
    inputs, weights = _inputs(problem, loss), _weights(problem, loss, plan)
    values = {name: np.asarray(an_input.where((problem, loss)), float) for name, an_input in inputs.items()}

    def changed(values: dict[str, Any]) -> tuple[Problem, AbstractLoss]:
        return eqx.tree_at(
            lambda t: [i.where(t) for i in inputs.values()], (problem, loss), [values[n] for n in inputs]
        )

    def outputs(values: dict[str, Any], adjoint: Adjoint = "implicit") -> tuple[Any, Any]:
        of_problem, of_loss = changed(values)
        found = solve(of_problem, loss=of_loss, plan=plan, adjoint=adjoint, **_TIGHT)
        return _values(found), found.final_cost

    (optimum, _), push = jax.linearize(outputs, values)
    _, approximately = jax.linearize(functools.partial(outputs, adjoint="gauss_newton"), values)
    cotangent = rng.normal(size=weights.shape) * weights
    pull = jax.linear_transpose(push, values)
    gradient = pull((_pull_back(problem, cotangent, optimum), jnp.zeros(())))[0]
    for name, an_input in inputs.items():
        shape = values[name].shape
        along = rng.normal(size=(*(shape[:1] and (shape[0] // an_input.alike,)), *shape[1:]))
        along = np.repeat(along, an_input.alike, axis=0) * an_input.scale if shape else along * an_input.scale
        direction = {n: along if n == name else np.zeros_like(v) for n, v in values.items()}
        dot, cost_dot = push(direction)
        found, approximate = (_tangent(problem, jax.device_get(d)) for d in (dot, approximately(direction)[0]))
        step = min(_LARGEST_STEP, _MOVES / max(float(np.linalg.norm(weights * found)), _TINY))
        differences = []
        for share in _SHARES:
            minus, plus = (
                solve_to_the_last_digits(*changed({**values, name: values[name] + signed * along}), plan, **_TIGHT)
                for signed in (-step * share, step * share)
            )
            change = jax.tree.map(lambda a, b: b - a, *(jax.device_get(_values(s)) for s in (minus, plus)))
            both = np.append(weights * _tangent(problem, change), float(plus.final_cost) - float(minus.final_cost))
            differences.append(both / (2 * step * share))
        difference, cost_difference = _best(differences)
        size = max(float(np.linalg.norm(difference)), _TINY)
        error = float(np.linalg.norm(weights * found - difference)) / size
        # over short steps the cost's difference is exact to some 1e-11 of the cost: there is nothing smaller to compare
        cost_size = max(abs(cost_difference), 1e-5 * float(plus.final_cost))
        reverse_error = abs(float(cotangent @ found) - float(np.vdot(gradient[name], along)))
        yield GradientRow(
            name=name,
            size=int(np.count_nonzero(np.broadcast_to(an_input.scale, along.shape))),
            moved=size,
            error=max(error, abs(float(cost_dot) - cost_difference) / cost_size),
            reverse_error=reverse_error / max(float(np.linalg.norm(cotangent * found)), _TINY),
            gauss_newton_error=float(np.linalg.norm(weights * approximate - difference)) / size,
        )


def _best(differences: list[Float[np.ndarray, " n"]]) -> tuple[Float[np.ndarray, " unknowns"], float]:
    """Return the extrapolation of two neighbours, `(16 D(h/4) - D(h)) / 15`, nearest to them (Ridders 1982).

    Long steps cross the corners of a Huber loss, short ones drown in rounding; which is worse differs between inputs.
    """
    candidates = []
    for longer, shorter in itertools.pairwise(differences):
        extrapolated = (16 * shorter - longer) / 15
        candidates.append((float(np.linalg.norm((extrapolated - shorter)[:-1])), extrapolated))
    best = min(candidates, key=lambda candidate: candidate[0])[1]
    return best[:-1], float(best[-1])


def _inputs(problem: Problem, loss: AbstractLoss) -> dict[str, _Input]:
    """Return every kind of input that the problem has, by name."""
    seen, free = problem.observations, problem.free
    std_px = np.asarray(seen.std_px, float)
    found = {
        "pixels": _Input(lambda t: t[0].observations.xy_px, np.repeat(std_px[:, None], 2, axis=1)),
        "pixel sigmas": _Input(lambda t: t[0].observations.std_px, std_px),
    }
    if not isinstance(loss, Linear):
        for field in dataclasses.fields(loss):
            name = "scale" if field.name == "f_scale" else "shape" if field.name == "alpha" else field.name
            found[f"loss {name}"] = _Input(
                lambda t, field=field: getattr(t[1], field.name), np.asarray(abs(getattr(loss, field.name)) + 0.1)
            )
    for i, prior in enumerate(problem.priors):
        sigmas = [f.name for f in dataclasses.fields(prior) if f.name.startswith("std")]
        for field in dataclasses.fields(prior):
            value = getattr(prior, field.name)
            if value is None:
                continue
            if field.name == "loss":
                if not isinstance(value, Linear):
                    found[f"{prior.name} loss scale"] = _Input(
                        lambda t, i=i: t[0].priors[i].loss.f_scale, np.asarray(float(value.f_scale))
                    )
            elif not (field.name.endswith("_index") or _is_only_counted_from(prior, field.name)):
                std = np.asarray(getattr(prior, sigmas[0]), float)
                scale = np.where(np.isfinite(std), std, 0.0)
                if scale.shape != np.shape(value):
                    rows = scale.max(axis=1).reshape(-1, *(1,) * (np.ndim(value) - 1))
                    scale = np.broadcast_to(rows, np.shape(value))
                found[f"{prior.name} {field.name}"] = _Input(
                    lambda t, i=i, field=field: getattr(t[0].priors[i], field.name),
                    scale,
                    alike=2 if isinstance(prior, ScaleBarPrior) else 1,
                )
    fixed_poses, fixed_points = ~np.asarray(free.poses)[:, None], ~np.asarray(free.points)[:, None]
    seen_points = np.zeros((problem.num_points, 1), bool)
    seen_points[np.asarray(seen.point_index)] = True
    if fixed_poses.any():
        found["fixed poses, rotation"] = _Input(lambda t: t[0].poses.quaternion, fixed_poses * np.full(4, _SIZE_RAD))
        found["fixed poses, translation"] = _Input(lambda t: t[0].poses.translation, fixed_poses * np.full(3, _SIZE_M))
    if (fixed_points & seen_points).any():
        found["fixed points"] = _Input(lambda t: t[0].points, (fixed_points & seen_points) * np.full(3, _SIZE_M))
    if not free.lever_arm and problem.prior("position") is not None:
        found["fixed lever arm"] = _Input(lambda t: t[0].lever_arm, np.full(3, _SIZE_M))
    if len(problem.position_offset) and not free.position_offset and problem.prior("position") is not None:
        found["fixed position offset"] = _Input(
            lambda t: t[0].position_offset, np.full(problem.position_offset.shape, _SIZE_M)
        )
    names, free_intrinsics = type(problem.cameras).parameter_names(), np.asarray(free.intrinsics)
    values = np.stack([np.asarray(getattr(problem.cameras, name), float) for name in names], axis=-1)
    sizes = np.array([_SIZE_PX if name in ("f", "fx", "fy", "cx", "cy") else _SIZE_SHAPE for name in names])
    for column, name in enumerate(names):
        if not free_intrinsics[:, column].all():
            found[f"fixed {name}"] = _Input(
                lambda t, name=name: getattr(t[0].cameras, name), ~free_intrinsics[:, column] * sizes[column]
            )
    for side, bound in (("lower", problem.lower), ("upper", problem.upper)):
        active = free_intrinsics & (values == np.asarray(bound))
        if active.any():
            found[f"active {side} bounds"] = _Input(lambda t, side=side: getattr(t[0], side), active * sizes)
    return found


def _is_only_counted_from(prior: AbstractPrior, field: str) -> bool:
    """Whether a field is no measurement: the coordinates that the ends of scale bars are counted from."""
    return isinstance(prior, ScaleBarPrior) and field in (prior.in_world or ())


def _values(solution: Solution) -> tuple[Any, ...]:
    cameras = solution.cameras
    fields = [getattr(cameras, name) for name in cameras.parameter_names()]
    antenna = solution.lever_arm, solution.position_offset
    return solution.poses.quaternion, solution.poses.translation, fields, *antenna, solution.points


def _tangent(problem: Problem, dot: tuple[Any, ...]) -> Float[np.ndarray, " unknowns"]:
    """Return derivatives of the values as those along tangent steps, in one vector: `w = 2 vec(dq q*)`."""
    quaternion, translation, fields, *rest = dot
    w = np.einsum("nij,nj->ni", _turn(problem), quaternion)
    v = translation - np.cross(w, np.asarray(problem.poses.translation))
    return np.concatenate([np.ravel(a) for a in (w, v, np.stack(fields, axis=-1), *rest)])


def _pull_back(problem: Problem, cotangent: Float[np.ndarray, " unknowns"], like: tuple[Any, ...]) -> tuple[Any, ...]:
    """Return the transpose of `_tangent`."""
    images, cameras, names = problem.num_images, problem.num_cameras, type(problem.cameras).parameter_names()
    sizes = np.cumsum([3 * images, 3 * images, cameras * len(names), 3, problem.position_offset.size])
    w, v, intrinsics, lever_arm, offset, points = np.split(cotangent, sizes)
    w, v = w.reshape(-1, 3), v.reshape(-1, 3)
    w = w - np.cross(np.asarray(problem.poses.translation), v)
    fields = list(intrinsics.reshape(cameras, -1).T)
    pulled = (np.einsum("nij,ni->nj", _turn(problem), w), v, fields, lever_arm, offset, points)
    return jax.tree.map(lambda a, b: jnp.asarray(a, b.dtype).reshape(b.shape), pulled, like)


def _turn(problem: Problem) -> Float[np.ndarray, "images 3 4"]:
    """The matrix from dq to w of each image."""
    q = Rotation.from_quat(np.asarray(problem.poses.quaternion, float), scalar_first=True).as_quat(scalar_first=True)
    q *= np.sign(np.sum(q * np.asarray(problem.poses.quaternion), axis=1, keepdims=True))
    a, b, c, d = q.T
    rows = [[-b, a, -d, c], [-c, d, a, -b], [-d, -c, b, a]]
    return 2 * np.moveaxis(np.array(rows), 2, 0)


def _weights(problem: Problem, loss: AbstractLoss, plan: Plan) -> Float[np.ndarray, " unknowns"]:
    """Return `sqrt(diag(J^T J))` in the problem's order, zero for what is fixed."""
    system, unknowns = make_system(problem, plan, loss), initial_unknowns(problem, plan)
    diagonal = jax.device_get(eqx.filter_jit(lambda s, u: linearise(s, u).diagonal)(system, unknowns))
    image, camera, point = (np.argsort(o) for o in (plan.image_order, plan.camera_order, plan.point_order))
    poses = diagonal.poses[image]
    parts = (poses[:, :3], poses[:, 3:], diagonal.intrinsics[camera], diagonal.antenna, diagonal.points[point])
    return np.sqrt(np.concatenate([np.ravel(part) for part in parts]))
