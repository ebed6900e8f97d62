"""`SchurLevenbergMarquardt` and `SchurDogleg`: optimistix least-squares solvers for bundle adjustment.

Both minimise `residuals(unknowns, system)` with a `System` as `args`: they take derivatives block by block from the
system itself, never a Jacobian of the whole function, so `optimistix.least_squares(residuals, solver, unknowns,
args=system)` is how they run under `jit`, `vmap` and differentiation. `jaxba.solve` calls the same `init`, `step` and
`terminate` one step at a time.

A step is kept when the cost falls by at least `_MIN_RATIO` of what the quadratic model promised. A step that puts a
point behind a camera or makes anything infinite has infinite cost, so it is refused and the next one is shorter.
"""

import abc
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jax import Array
from jaxtyping import Bool, Float, Int, PyTree

from jaxba._errors import JaxbaError
from jaxba.ba._factor import solve_reduced
from jaxba.ba._lengths import (
    all_squared_in_sigmas,
    damping_scale,
    norm_of,
    scaled_norm_of,
    slope_along,
    squared_in_sigmas,
    sum_all,
)
from jaxba.ba._linearise import Linearisation, cost, curvature, linearise
from jaxba.ba._refine import move_points, refine_points
from jaxba.ba._schur import ReducedVector, back_substitute, eliminate_points, one_for_fixed, reduce_vector, to_reduced
from jaxba.ba._system import System, is_traced
from jaxba.ba._unknowns import Step, Unknowns
from jaxba.geometry import require_number

_MIN_RATIO = 1e-3
# Where the model foretells a decrease this exactly, damping may fall much faster than by Ceres's third: 100 images are
# within 0.1% of the optimum after 2 steps instead of 3 and at it after 4 instead of 7. Looser is worse on BAL's
# problems.
_EXACT, _EXACT_SHRINK = 0.02, 0.03
_BEND, _BEND_BELOW = 0.5, 0.1  # use half a robust loss's curvature once steps change the cost by less than a tenth
_MAX_DAMPING = 1e16

RUNNING, FTOL, XTOL, GTOL, STUCK, NOT_FINITE = range(6)
"""Values of `State.status`: still going, one of three convergence tests met, no step found, bad start."""


class State(eqx.Module):
    """State of either solver; `trust` is the damping (Levenberg-Marquardt) or the radius (dogleg)."""

    trust: Float[Array, ""]
    bend: Float[Array, ""]
    factor: Float[Array, ""]
    cost: Float[Array, ""]
    change: Float[Array, ""]
    gradient_norm: Float[Array, ""]
    step_norm: Float[Array, ""]
    linear_iterations: Int[Array, ""]
    points_held: Int[Array, ""]
    accepted: Bool[Array, ""]
    status: Int[Array, ""]
    num_steps: Int[Array, ""]


class Proposal(NamedTuple):
    """A step, the number of linear iterations it took, and how many times as long it would be with full trust."""

    step: Step
    linear_iterations: Int[Array, ""]
    shortened: Float[Array, ""]


class Tried(NamedTuple):
    """What a step would do, as far as it takes to judge it.

    - `cost`: after it. `promised`: by which the quadratic model says the cost falls.
    - `gradient_norm`: largest entry of the gradient before it, without what presses an intrinsic against its bound.
    - `shortened`: how many times as long the step would be with full trust.
    - `in_sigmas`, `all_in_sigmas`: length of the step and of all unknowns, see `_lengths.py`; `norm`, `scaled_norm`
      too.
    """

    cost: Float[Array, ""]
    promised: Float[Array, ""]
    gradient_norm: Float[Array, ""]
    shortened: Float[Array, ""]
    in_sigmas: Float[Array, ""]
    all_in_sigmas: Float[Array, ""]
    norm: Float[Array, ""]
    scaled_norm: Float[Array, ""]
    linear_iterations: Int[Array, ""]
    points_held: Int[Array, ""]


def require_tolerance(label: str, value: Any) -> None:
    """Raise `JaxbaError` for a tolerance that is negative or not finite."""
    require_number(label, value, 0.0, np.finfo(float).max, "give 0 (never stop for it) or a small positive number")


def require_stops(label: str, *, max_nfev: int, ftol: float, xtol: float, gtol: float) -> int:
    """Return `max_nfev` as a number; raise `JaxbaError` for what is no limit or tolerance of a solve."""
    if is_traced((ftol, xtol, gtol, max_nfev)):
        raise JaxbaError(f"{label}: ftol, xtol, gtol or max_nfev is traced, as arguments of jit are; give numbers.")
    cure = "give a whole number of steps, 1 or more"
    require_number(f"{label}: max_nfev", max_nfev, 1.0, 2.0**31 - 1, cure, whole=True)
    for name, value in (("ftol", ftol), ("xtol", xtol), ("gtol", gtol)):
        require_tolerance(f"{label}: {name}", value)
    return int(max_nfev)


def take_numbers(solver: "AbstractSchurSolver", dtype: Any) -> tuple["AbstractSchurSolver", "AbstractSchurSolver"]:
    """Return the solver's numbers as arrays, and the solver without them; `eqx.combine` puts the two together.

    As arguments of a program they may change without its being compiled anew.
    """
    numbers, rest = eqx.partition(solver, lambda leaf: isinstance(leaf, float))
    return jax.tree.map(lambda number: np.asarray(number, dtype), numbers), rest


def residuals(unknowns: Unknowns, system: System) -> tuple[Float[Array, "components *rows"], ...]:
    """Return every group's robust residuals `sqrt(rho(s) / s) r`, `s = |r|^2`: their squares sum to twice the cost."""

    def robust(residual: Array, loss: Callable[[Array], Array]) -> Array:
        squared = jnp.sum(residual**2, axis=0)
        positive = squared > 0
        safe = jnp.where(positive, squared, 1.0)
        return residual * jnp.where(positive, jnp.sqrt(loss(safe) / safe), 1.0)

    reprojection = robust(system.reprojection.residual(unknowns)[0], system.loss)
    return (reprojection, *(robust(prior.residual(unknowns), prior.loss) for prior in system.priors))


class AbstractSchurSolver(optx.AbstractLeastSquaresSolver[Unknowns, Any, Any, State]):
    """What both solvers share: linearise, propose, keep or refuse, and when to stop.

    - `rtol`, `atol`: `ftol` and `gtol` in scipy's words; `xtol` is a field of its own.
    - `initial_trust`: damping or radius to start with.
    """

    rtol: eqx.AbstractVar[float]
    atol: eqx.AbstractVar[float]
    xtol: eqx.AbstractVar[float]
    norm: eqx.AbstractVar[Callable[[PyTree], Float[Array, ""]]]
    initial_trust: eqx.AbstractVar[float]

    def __check_init__(self) -> None:
        for name in ("rtol", "atol", "xtol"):
            require_tolerance(f"{type(self).__name__}: {name}", getattr(self, name))
        cure = "give a positive number"
        require_number(f"{type(self).__name__}: initial_trust", self.initial_trust, 1e-16, _MAX_DAMPING, cure)

    @abc.abstractmethod
    def propose(self, system: System, unknowns: Unknowns, model: Linearisation, trust: Float[Array, ""]) -> Proposal:
        """Return a step from the quadratic model under the present trust."""

    @abc.abstractmethod
    def adapt(self, state: State, ratio: Float[Array, ""], scaled_norm: Float[Array, ""]) -> tuple[Array, Array]:
        """Return the next trust and factor, given actual over promised decrease and the length of the step tried."""

    def init(
        self, fn: Any, y: Unknowns, args: System, options: Any, f_struct: Any, aux_struct: Any, tags: frozenset[object]
    ) -> State:
        del fn, options, f_struct, aux_struct, tags
        return self.state_of(cost(args, y))

    def state_of(self, start: Float[Array, ""]) -> State:
        """Return the state before the first step, from the cost at the start values."""
        zero = jnp.zeros_like(start)
        return State(
            trust=zero + self.initial_trust,
            bend=zero,
            factor=zero + 2,
            cost=start,
            change=zero,
            gradient_norm=zero + jnp.inf,
            step_norm=zero + jnp.inf,
            linear_iterations=jnp.array(0),
            points_held=jnp.array(0),
            accepted=jnp.array(True),
            status=jnp.where(jnp.isfinite(start), RUNNING, NOT_FINITE),
            num_steps=jnp.array(0),
        )

    def step(
        self, fn: Any, y: Unknowns, args: System, options: Any, state: State, tags: frozenset[object]
    ) -> tuple[Unknowns, State, Any]:
        del fn, options, tags
        system = args
        model = linearise(system, y, state.bend)
        step, linear_iterations, shortened = self.propose(system, y, model, state.trust)
        step = within_bounds(system, y, step)
        moved = eqx.tree_at(lambda u: u.points, y.retract(step), move_points(system, y, step.points))
        trial, cost_of_trial, points_held = refine_points(system, moved, y, state.bend > 0)
        tried = Tried(
            cost=cost_of_trial,
            promised=-slope_along(model.gradient, step) - curvature(system, model, step) / 2,
            gradient_norm=projected_gradient_norm(system.lower, system.upper, y.intrinsics, model.gradient),
            shortened=shortened,
            in_sigmas=jnp.sqrt(squared_in_sigmas(model, step)),
            all_in_sigmas=jnp.sqrt(all_squared_in_sigmas(system, y, model)),
            norm=norm_of(step),
            scaled_norm=scaled_norm_of(step, model.diagonal),
            linear_iterations=linear_iterations,
            points_held=points_held,
        )
        # a derivative through the steps takes their lengths, which depend on the values in jumps, as they are
        new_state = jax.lax.stop_gradient(self.judge(state, tried))
        new = jax.tree.map(lambda a, b: jnp.where(new_state.accepted, a, b), trial, y)
        return new, new_state, None

    def judge(self, state: State, tried: Tried) -> State:
        """Return the state after a step was tried; whether it is kept stands there."""
        finite = jnp.isfinite(tried.promised) & jnp.isfinite(tried.cost)
        change = jnp.where(finite, state.cost - tried.cost, -jnp.inf)
        ratio = jnp.where(finite & (tried.promised > 0), change / tried.promised, -1.0)
        at_optimum = tried.gradient_norm <= self.atol
        accepted = (ratio > _MIN_RATIO) & ~at_optimum
        trust, factor = self.adapt(state, ratio, tried.scaled_norm)

        # what little trust leaves of a step says nothing about the way to the optimum
        nothing = self.rtol * state.cost
        small = finite & (tried.shortened * tried.promised <= nothing) & (jnp.abs(change) <= nothing)
        turn = tried.shortened * tried.in_sigmas
        short = finite & (turn <= self.xtol * (self.xtol + tried.all_in_sigmas))
        status = jnp.where(self._exhausted(trust), STUCK, RUNNING)
        status = jnp.where(short, XTOL, status)
        status = jnp.where(small, FTOL, status)
        status = jnp.where(at_optimum, GTOL, status)
        return State(
            trust=trust,
            bend=jnp.where(accepted, jnp.where(change < _BEND_BELOW * state.cost, _BEND, state.bend), 0.0),
            factor=factor,
            cost=jnp.where(accepted, tried.cost, state.cost),
            change=jnp.where(accepted, change, 0.0),
            gradient_norm=tried.gradient_norm,
            step_norm=tried.norm,
            linear_iterations=tried.linear_iterations,
            points_held=tried.points_held,
            accepted=accepted,
            status=status,
            num_steps=state.num_steps + 1,
        )

    def terminate(
        self, fn: Any, y: Unknowns, args: System, options: Any, state: State, tags: frozenset[object]
    ) -> tuple[Bool[Array, ""], optx.RESULTS]:
        del fn, y, args, options, tags
        failed = (state.status == STUCK) | (state.status == NOT_FINITE)
        result = optx.RESULTS.where(failed, optx.RESULTS.nonlinear_divergence, optx.RESULTS.successful)
        return state.status != RUNNING, result

    def postprocess(
        self,
        fn: Any,
        y: Unknowns,
        aux: Any,
        args: System,
        options: Any,
        state: State,
        tags: frozenset[object],
        result: optx.RESULTS,
    ) -> tuple[Unknowns, Any, dict[str, Any]]:
        del fn, args, options, tags, result
        return y, aux, {"cost": state.cost, "status": state.status, "num_steps": state.num_steps}

    @abc.abstractmethod
    def _exhausted(self, trust: Float[Array, ""]) -> Bool[Array, ""]:
        """Whether trust has shrunk so far that no step can be found."""


class SchurLevenbergMarquardt(AbstractSchurSolver):
    """Levenberg-Marquardt on the Schur complement, damped by `trust * diag(J^T J)` (Marquardt 1963)."""

    rtol: float = 1e-8
    atol: float = 1e-10
    xtol: float = 1e-8
    norm: Callable[[PyTree], Float[Array, ""]] = optx.max_norm
    initial_trust: float = 1e-4

    def propose(self, system: System, unknowns: Unknowns, model: Linearisation, trust: Float[Array, ""]) -> Proposal:
        return _damped_step(system, unknowns, model, trust)

    def adapt(self, state: State, ratio: Float[Array, ""], scaled_norm: Float[Array, ""]) -> tuple[Array, Array]:
        del scaled_norm
        good = ratio > _MIN_RATIO
        shrink = jnp.maximum(1 / 3, 1 - (2 * ratio - 1) ** 3)
        shrink = jnp.where(jnp.abs(ratio - 1) < _EXACT, _EXACT_SHRINK, shrink)
        trust = jnp.where(good, state.trust * shrink, state.trust * state.factor)
        return jnp.maximum(trust, 1e-16), jnp.where(good, 2.0, state.factor * 2)

    def _exhausted(self, trust: Float[Array, ""]) -> Bool[Array, ""]:
        return trust > _MAX_DAMPING


class SchurDogleg(AbstractSchurSolver):
    """Powell's dogleg: steepest descent to Gauss-Newton step, within a radius in units of `sqrt(diag(J^T J))`."""

    rtol: float = 1e-8
    atol: float = 1e-10
    xtol: float = 1e-8
    norm: Callable[[PyTree], Float[Array, ""]] = optx.max_norm
    initial_trust: float = 1e4

    def propose(self, system: System, unknowns: Unknowns, model: Linearisation, trust: Float[Array, ""]) -> Proposal:
        newton, linear_iterations, _ = _damped_step(system, unknowns, model, jnp.asarray(1e-10, trust.dtype))
        finite = jnp.isfinite(norm_of(newton))
        scale = damping_scale(model.diagonal)
        descent = jax.tree.map(lambda g, d, free: -free * g / d, model.gradient, scale, system.free)
        descent = within_bounds(system, unknowns, descent)
        bent = curvature(system, model, descent)
        length = jnp.where(bent > 0, -slope_along(model.gradient, descent) / bent, 1.0)
        cauchy = jax.tree.map(lambda d: length * d, descent)
        cauchy_norm = scaled_norm_of(cauchy, model.diagonal)
        cauchy = jax.tree.map(lambda c: c * jnp.minimum(1.0, trust / cauchy_norm), cauchy)
        newton = jax.tree.map(lambda n, c: jnp.where(finite, n, c), newton, cauchy)
        # the largest t in [0, 1] with |cauchy + t (newton - cauchy)| <= radius
        leg = jax.tree.map(jnp.subtract, newton, cauchy)

        def inner(a: Step, b: Step) -> Float[Array, ""]:
            return sum_all(jax.tree.map(lambda x, y, d: jnp.sum(x * y * d), a, b, scale))

        a, b, c = inner(leg, leg), inner(cauchy, leg), inner(cauchy, cauchy) - trust**2
        root = jnp.sqrt(jnp.maximum(b**2 - a * c, 0.0))
        t = jnp.where(a > 0, -jnp.minimum(c, 0.0) / jnp.maximum(b + root, jnp.finfo(a.dtype).tiny), 1.0)
        t = jnp.clip(t, 0.0, 1.0)
        step = jax.tree.map(lambda c, d: c + t * d, cauchy, leg)
        full, length = scaled_norm_of(newton, model.diagonal), scaled_norm_of(step, model.diagonal)
        return Proposal(step, linear_iterations, jnp.where(length > 0, jnp.maximum(full / length, 1.0), 1.0))

    def adapt(self, state: State, ratio: Float[Array, ""], scaled_norm: Float[Array, ""]) -> tuple[Array, Array]:
        good = ratio > _MIN_RATIO
        grown = jnp.where(ratio > 0.75, jnp.maximum(state.trust, 3 * scaled_norm), state.trust)
        shrunk = 0.5 * jnp.minimum(state.trust, scaled_norm)
        return jnp.where(ratio < 0.25, jnp.where(good, 0.5 * state.trust, shrunk), grown), state.factor

    def _exhausted(self, trust: Float[Array, ""]) -> Bool[Array, ""]:
        return trust < 1 / _MAX_DAMPING


def _damped_step(system: System, unknowns: Unknowns, model: Linearisation, damping: Float[Array, ""]) -> Proposal:
    """Return the minimiser of the model plus `damping * d^T D d / 2`, the border within its bounds.

    D is the diagonal of J^T J for all but the points, and their own 3x3 blocks for these: axes of the world are not the
    ones in which a point is known, and along the ray of a far point the diagonal would outweigh what its images tell.
    """
    scaled = jax.tree.map(lambda d: damping * d, damping_scale(model.diagonal))
    damped, of_points = damped_points(model, damping)
    scaled = one_for_fixed(system, eqx.tree_at(lambda s: s.points, scaled, of_points))
    reduced = eliminate_points(system, damped, scaled)
    rhs = jax.tree.map(lambda g: -g, model.gradient)
    lower, upper = step_bounds(system, unknowns)
    solved = solve_reduced(system, reduced, reduce_vector(system, reduced.points, rhs), lower, upper)
    return Proposal(back_substitute(system, reduced.points, rhs, solved.vector), solved.iterations, 1 + damping)


def damped_points(
    model: Linearisation, damping: Float[Array, ""]
) -> tuple[Linearisation, Float[Array | np.ndarray, "points 3"]]:
    """Return the equations with the points' blocks damped, and a one on the diagonal of each that nothing sees."""
    damped = eqx.tree_at(lambda m: m.point_products, model, (1 + damping) * model.point_products)
    return damped, jnp.where(model.diagonal.points > 0, 0.0, 1.0)


def step_bounds(system: System, unknowns: Unknowns) -> tuple[Array | None, Array | None]:
    """Bounds of the border's step; None where nothing is bounded."""
    if not system.shape.any_bound:
        return None, None
    infinite = jnp.full(unknowns.antenna.shape, jnp.inf, unknowns.points.dtype)

    def border(bound: Array | np.ndarray, antenna: Array) -> Array:
        like = Step(
            jnp.zeros((system.shape.num_images, 6), bound.dtype),
            bound - unknowns.intrinsics,
            antenna,
            unknowns.points,
        )
        vector: ReducedVector = to_reduced(system, like)
        return vector.border

    return border(system.lower, -infinite), border(system.upper, infinite)


def within_bounds(system: System, unknowns: Unknowns, step: Step) -> Step:
    """Return a step that takes no intrinsic beyond its bounds."""
    if not system.shape.any_bound:
        return step
    moved = jnp.clip(unknowns.intrinsics + step.intrinsics, system.lower, system.upper)
    intrinsics = jnp.where(system.free.intrinsics > 0, moved - unknowns.intrinsics, 0.0)
    return eqx.tree_at(lambda s: s.intrinsics, step, intrinsics)


def projected_gradient_norm(
    lower: Float[Array | np.ndarray, "cameras parameters"],
    upper: Float[Array | np.ndarray, "cameras parameters"],
    intrinsics: Float[Array | np.ndarray, "cameras parameters"],
    gradient: Step,
) -> Float[Array, ""]:
    """Largest entry of the gradient, without what presses an intrinsic against its bound."""
    of_intrinsics = gradient.intrinsics
    pressed = ((intrinsics <= lower) & (of_intrinsics > 0)) | ((intrinsics >= upper) & (of_intrinsics < 0))
    projected = eqx.tree_at(lambda g: g.intrinsics, gradient, jnp.where(pressed, 0.0, of_intrinsics))
    return jnp.max(jnp.stack([jnp.max(jnp.abs(leaf), initial=0.0) for leaf in jax.tree.leaves(projected)]))
