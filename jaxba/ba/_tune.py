"""Tune: learn what an adjustment takes as given, the scale and shape of its loss and its sigmas, from data left out.

    minimise over u:  score(x*(u)),      x*(u) = the optimum with `scale = scale_0 e^u`, `sigma = sigma_0 e^u`, ...

by gradient descent through the solve (`_adjoint.py`). The score is of data that the fit never sees: coordinates of
check points, as mean squared distance, or observations held out, as the mean of s / (s + 9) with s their squared
distance in sigmas from the pixels that the fit predicts. The second is Geman and McClure's loss at three sigmas: wrong
matches are among the held-out, too, and shall not be learned from.

Each step starts from the optimum before it, a few steps of the solver away. Under a loss that levels off, a point with
a wrong match may come to rest where its cost is flat and no minimum: then there is no exact derivative, and that step
goes by the Gauss-Newton one, which is good enough to go down by.
"""

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float, Int
from threadpoolctl import threadpool_limits

from jaxba._errors import JaxbaError
from jaxba.ba._adjoint import Adjoint
from jaxba.ba._plan import Plan, make_plan
from jaxba.ba._problem import AbstractPrior, Observations, Problem
from jaxba.ba._selection import Selection, selected
from jaxba.ba._solution import Solution
from jaxba.ba._solve import solve
from jaxba.ba.checks import prepare, require_gauge
from jaxba.geometry import AbstractLoss, Barron, Linear, check_loss, require_number

_SHAPES = (-4.0, 2.0)  # of Barron's loss: the range that alpha is learned in
_HELD_OUT_SIGMAS = 3.0
_SPREAD = 1.0  # of the starts, in e-folds


@dataclasses.dataclass(frozen=True)
class Tuned:
    """What was learned.

    - `loss`, `problem`: with the learned values; the problem holds what was fitted, and its optimum as start values.
    - `learned`: values by name; of sigmas the factor.
    - `score`: the lowest; `history`: that of every step and start, from the first on.
    - `approximate_steps`: how many went by the Gauss-Newton derivative. `stopped`: why before the last step, or empty.
    """

    loss: AbstractLoss
    problem: Problem
    learned: dict[str, float]
    score: float
    history: Float[np.ndarray, "steps starts"]
    approximate_steps: int = 0
    stopped: str = ""


def tune(
    problem: Problem,
    *,
    loss: AbstractLoss,
    learn: Sequence[str] | np.ndarray = ("loss scale",),
    check_points: tuple[Selection, Float[np.ndarray, "n 3"]] | None = None,
    hold_out: float | None = None,
    steps: int = 20,
    learning_rate: float = 0.2,
    optimizer: Any = None,
    starts: int = 1,
    seed: int = 0,
    callback: Callable[[int, Float[np.ndarray, " starts"]], None] | None = None,
) -> Tuned:
    """Learn loss and sigmas by gradient descent through the adjustment, and return the best of all steps.

    - `loss`: with its start values. `learn`: of `loss scale`, `loss shape` (of `Barron`), `pixel sigmas`, and
      `position sigmas` and the like for each prior.
    - `check_points`: indices (or a mask) and true coordinates of points whose coordinates the fit does not know, or
    - `hold_out`: the share of the observations to leave out of the fit, fewer where points would not keep two each.
    - `optimizer`: of optax; `optax.adam(learning_rate)` if None.
    - `starts`: how many descents, from start values spread by a factor of e, side by side. `seed`: of the starts and
      of what is held out.
    - `callback`: called with the number of each step and the scores. Ctrl-C ends with the best so far.

    Needs optax: `pip install 'jaxba[tune]'`.

    Raises `JaxbaError` without it, for names that cannot be learned, and for check points that are control points of
    the fit.

    >>> import jaxba
    >>> survey = jaxba.synthetic.uav_block(8, outlier_fraction=0.1)
    >>> # takes a minute; notebooks/tune_a_robust_scale.py runs the like
    >>> tuned = jaxba.tune(survey.problem, loss=jaxba.Cauchy(10.0), hold_out=0.1, steps=4)  # doctest: +SKIP
    >>> tuned.learned["loss scale"] < 10.0, bool(tuned.history[-1, 0] < tuned.history[0, 0])  # doctest: +SKIP
    (True, True)
    """
    try:
        import optax  # not needed by anything else
    except ImportError as error:
        raise JaxbaError("tune needs optax, which is not installed: pip install 'jaxba[tune]'.") from error
    if (check_points is None) == (hold_out is None):
        raise JaxbaError("tune: give check_points or hold_out, one of them: the data to be judged by.")
    for name, count, least in (("steps", steps, 1.0), ("starts", starts, 1.0), ("seed", seed, 0.0)):
        cure = f"give a whole number, {least:g} or more"
        require_number(f"tune: {name}", count, least, 2.0**31 - 1, cure, whole=True)
    require_number("tune: learning_rate", learning_rate, 1e-12, 1e3, "give a positive number, such as 0.2")
    check_loss("tune: loss", loss)
    learn = [learn] if isinstance(learn, str) else [str(name) for name in learn]
    _check_names(problem, loss, learn)
    problem = prepare(problem).problem
    require_gauge(problem, "Tuning")
    rng = np.random.default_rng(seed)
    if check_points is not None:
        score = _check_point_score(problem, *check_points)
    else:
        problem, score = _held_out_score(problem, float(hold_out or 0.0), rng)
    rule = optax.adam(learning_rate) if optimizer is None else optimizer

    with jax.enable_x64(True), threadpool_limits(1, user_api="blas"):
        plan = make_plan(problem)
        first = solve(problem, loss=loss, plan=plan)
        parameters = np.tile(_given(loss, learn), (starts, 1))
        parameters[1:] += _SPREAD * rng.normal(size=parameters[1:].shape)
        values = jax.tree.map(lambda leaf: np.broadcast_to(leaf, (starts, *np.shape(leaf))), _values(first))
        evaluate = _evaluation(problem, loss, learn, plan, score)
        approximate = _evaluation(problem, loss, learn, plan, score, "gauss_newton")
        state = rule.init(jnp.asarray(parameters))
        history, best, stopped, approximate_steps = [], (np.inf, parameters[0], _start(values, 0)), "", 0
        try:
            for step in range(steps + 1):
                try:
                    (scores, values), gradient = evaluate(parameters, values)
                except (JaxbaError, eqx.EquinoxRuntimeError):  # some point lies where its loss has levelled off
                    (scores, values), gradient = approximate(parameters, values)
                    approximate_steps += 1
                scores = np.asarray(scores)
                history.append(scores)
                leader = int(np.nanargmin(scores)) if np.isfinite(scores).any() else 0
                if scores[leader] < best[0]:
                    best = float(scores[leader]), parameters[leader], _start(values, leader)
                if callback is not None:
                    callback(step, scores)
                change, state = rule.update(jnp.nan_to_num(gradient), state, jnp.asarray(parameters))
                parameters = np.asarray(optax.apply_updates(jnp.asarray(parameters), change))
        except KeyboardInterrupt:
            stopped = "interrupted"
        except (JaxbaError, eqx.EquinoxRuntimeError) as error:
            if not history:
                raise
            stopped = str(error)
        if not history or not np.isfinite(best[0]):
            why = stopped or "every score was not finite"
            raise JaxbaError(
                f"tune: no score was reached ({why}). See that jaxba.solve converges with this loss, or start from a "
                "wider scale."
            )
    tuned_problem, tuned_loss = _apply(problem, loss, learn, best[1], np)
    tuned_problem = eqx.tree_at(_values, tuned_problem, tuple(jax.device_get(best[2])))
    tuned_loss = jax.tree.map(float, tuned_loss)
    learned = {name: float(value) for name, value in _physical(learn, best[1], loss, np).items()}
    return Tuned(tuned_loss, tuned_problem, learned, best[0], np.array(history), approximate_steps, stopped)


def _check_names(problem: Problem, loss: AbstractLoss, learn: Sequence[str]) -> None:
    known = [] if isinstance(loss, Linear) else ["loss scale"]
    known += ["loss shape"] if isinstance(loss, Barron) else []
    known += ["pixel sigmas", *(f"{prior.name} sigmas" for prior in problem.priors)]
    for name in learn:
        if name not in known:
            raise JaxbaError(f"tune: learn={name!r}: this problem and loss have {', '.join(known)}.")
    if not learn or len(set(learn)) != len(learn):
        raise JaxbaError(f"tune: learn={tuple(learn)}: name one or more of {', '.join(known)}, each once.")


def _given(loss: AbstractLoss, learn: Sequence[str]) -> list[float]:
    """Return the start value of each parameter: logarithms of factors; of the shape, the logit of its place."""
    given = [0.0] * len(learn)
    if isinstance(loss, Barron) and "loss shape" in learn:
        low, high = _SHAPES
        share = min(max((float(loss.alpha) - low) / (high - low), 1e-3), 1 - 1e-3)
        given[list(learn).index("loss shape")] = float(np.log(share / (1 - share)))
    return given


def _physical(learn: Sequence[str], parameters: Any, loss: AbstractLoss, xp: Any) -> dict[str, Any]:
    """Return scale, shape and factors from the parameters."""
    low, high = _SHAPES
    found = {}
    for name, value in zip(learn, parameters, strict=True):
        if name == "loss shape":
            found[name] = low + (high - low) / (1 + xp.exp(-value))
        else:
            found[name] = (loss.f_scale if name == "loss scale" else 1.0) * xp.exp(value)
    return found


def _apply(
    problem: Problem, loss: AbstractLoss, learn: Sequence[str], parameters: Any, xp: Any
) -> tuple[Problem, AbstractLoss]:
    """Return problem and loss with the parameters' values."""
    found = _physical(learn, parameters, loss, xp)
    changed = {"f_scale": found.get("loss scale"), "alpha": found.get("loss shape")}
    loss = dataclasses.replace(loss, **{name: value for name, value in changed.items() if value is not None})
    if "pixel sigmas" in found:
        std_px = problem.observations.std_px * found["pixel sigmas"]
        problem = eqx.tree_at(lambda p: p.observations.std_px, problem, std_px)
    priors = [_scaled(prior, found.get(f"{prior.name} sigmas", 1.0)) for prior in problem.priors]
    return dataclasses.replace(problem, priors=tuple(priors)), loss


def _scaled(prior: AbstractPrior, factor: Any) -> AbstractPrior:
    names = [field.name for field in dataclasses.fields(prior) if field.name.startswith("std")]
    return dataclasses.replace(prior, **{name: getattr(prior, name) * factor for name in names})


def _evaluation(
    problem: Problem,
    loss: AbstractLoss,
    learn: Sequence[str],
    plan: Plan,
    score: Callable[[Any], Float[Array, ""]],
    adjoint: Adjoint = "implicit",
) -> Callable[[Any, Any], Any]:
    """Return the function from parameters and start values, a row a start, to ((scores, optima), gradients)."""

    def one(parameters: Any, values: Any) -> tuple[Array, Any]:
        of_problem, of_loss = _apply(problem, loss, learn, parameters, jnp)
        values = jax.lax.stop_gradient(values)
        of_problem = eqx.tree_at(_values, of_problem, values)
        found = solve(of_problem, loss=of_loss, plan=plan, adjoint=adjoint)
        return score(_values(found)), jax.lax.stop_gradient(_values(found))

    of_one = jax.value_and_grad(one, has_aux=True)

    def evaluate(parameters: Any, values: Any) -> Any:
        # outside of jit and vmap, the steps are those of an ordinary solve, and its programs serve every start
        rows = [of_one(of_start, _start(values, start)) for start, of_start in enumerate(parameters)]
        return jax.tree.map(lambda *leaves: np.stack(leaves), *rows)

    return evaluate


def _values(of: Problem | Solution) -> tuple[Any, ...]:
    """Return all that an adjustment may change."""
    return of.poses, of.cameras, of.points, of.lever_arm, of.position_offset


def _start(values: Any, start: int) -> Any:
    return jax.tree.map(lambda leaf: leaf[start], values)


class _CheckPointScore(eqx.Module):
    """Mean squared distance of check points, of `_values`."""

    index: Int[np.ndarray, " n"]
    xyz: Float[np.ndarray, "n 3"]

    @eqx.filter_jit
    def __call__(self, values: Any) -> Float[Array, ""]:
        _, _, points, *_ = values
        return jnp.mean(jnp.sum((jnp.asarray(points)[self.index] - self.xyz) ** 2, axis=1))


class _HeldOutScore(eqx.Module):
    """Mean robust error of observations, of `_values`; `camera`: of each."""

    left_out: Observations
    camera: Int[np.ndarray, " n"]

    @eqx.filter_jit
    def __call__(self, values: Any) -> Float[Array, ""]:
        seen = self.left_out
        poses, cameras, points, *_ = values
        poses = jax.tree.map(lambda leaf: jnp.asarray(leaf)[seen.image_index], poses)
        cameras = jax.tree.map(lambda leaf: jnp.asarray(leaf)[self.camera], cameras)
        pixel = cameras.project(poses.transform(jnp.asarray(points)[seen.point_index]))
        squared = jnp.sum((pixel - seen.xy_px) ** 2, axis=1) / seen.std_px**2
        return jnp.mean(squared / (squared + _HELD_OUT_SIGMAS**2))


def _check_point_score(problem: Problem, index: Selection, xyz: Float[np.ndarray, "n 3"]) -> _CheckPointScore:
    chosen = selected("tune: check_points", index, problem.num_points, "points")
    index, xyz = np.asarray(index), np.asarray(xyz, float)
    index = np.flatnonzero(chosen) if index.dtype == bool else index.reshape(-1)
    if len(index) == 0 or xyz.shape != (len(index), 3):
        raise JaxbaError(
            f"tune: check_points of {index.shape} indices and {xyz.shape} coordinates; give one index below "
            f"{problem.num_points} and x, y, z for each."
        )
    control = problem.prior("control")
    if control is not None:
        both = np.intersect1d(index, np.asarray(control.point_index))  # pyright: ignore[reportAttributeAccessIssue]
        if len(both):
            raise JaxbaError(
                f"tune: point {both[0]} is a check point and a control point of the fit; what judges must not be "
                "fitted."
            )

    return _CheckPointScore(index, xyz)


def _held_out_score(problem: Problem, share: float, rng: np.random.Generator) -> tuple[Problem, _HeldOutScore]:
    """Return the problem without the observations held out, and their score."""
    if not 0 < share < 1:
        raise JaxbaError(f"tune: hold_out={share:g}: give a share of the observations, such as 0.1.")
    seen = problem.observations
    image, point = np.asarray(seen.image_index), np.asarray(seen.point_index)
    order = rng.permutation(len(point))
    # the n-th observation of its point, in random order: all but two of each may be left out
    by_point = order[np.argsort(point[order], kind="stable")]
    starts = np.flatnonzero(np.diff(point[by_point], prepend=-1))
    rank = np.arange(len(by_point)) - np.repeat(starts, np.diff(starts, append=len(by_point)))
    may = by_point[rank >= 2]
    out = np.sort(rng.permutation(may)[: round(share * len(point))])
    if not len(out):
        raise JaxbaError("tune: no point is seen three times, so no observation can be held out; use check_points.")
    kept = np.setdiff1d(np.arange(len(point)), out)

    def part(index: Int[np.ndarray, " n"]) -> Observations:
        return Observations(np.asarray(seen.xy_px)[index], np.asarray(seen.std_px)[index], image[index], point[index])

    left_out = part(out)
    camera = np.asarray(problem.camera_index)[left_out.image_index]

    return dataclasses.replace(problem, observations=part(kept)), _HeldOutScore(left_out, camera)
