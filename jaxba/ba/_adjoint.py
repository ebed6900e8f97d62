"""Adjoint: derivatives of an optimum by everything that the problem is made of, by the implicit function theorem.

At an optimum x* the gradient of the cost by the free unknowns is zero, g(x*, theta) = 0. As theta changes, so does x*:

    H dx = -(dg/dtheta) dtheta,     H = dg/dx

with H the exact second derivatives (`_hessian.py`), or J^T J, which is what remains of them where residuals are zero.
An intrinsic pressed against its bound moves with the bound, a fixed block with its value. H is factored once, like a
step's normal equations; no iteration of the solver is kept. `jax.grad` transposes the rule, `jax.jvp` runs it as it is,
and a second derivative differentiates it, for which `custom_linear_solve` gets H as a product.

A solver stops where the cost no longer changes, some thousandths of a sigma before the optimum; there the rule would be
off by as much. One Newton step with H, whose error is squared, goes before it. A point with a wrong match may have come
to rest on a saddle, where nothing tells which way it would go: it is held, and a warning says so.
"""

import functools
import warnings
from collections.abc import Callable
from typing import Any, Literal, NamedTuple

import equinox as eqx
import jax
import jax.flatten_util
import jax.numpy as jnp
from jax import Array
from jaxtyping import Float, Int

from jaxba._errors import JaxbaError
from jaxba.ba._compiler import call_compiled
from jaxba.ba._factor import Factored, factor_reduced, smallest_pivot, solve_factored
from jaxba.ba._hessian import hessian
from jaxba.ba._linearise import Linearisation, cost, linearise
from jaxba.ba._refine import refine_points
from jaxba.ba._rows import rows_of
from jaxba.ba._schur import Reduced, back_substitute, eliminate_points, one_for_fixed, reduce_vector
from jaxba.ba._system import System, is_traced
from jaxba.ba._unknowns import Step, Unknowns
from jaxba.geometry import Linear

Adjoint = Literal["implicit", "gauss_newton", "unrolled"]

ON_BOUND = 1e-12
_SETTLED, _MOST_ROUNDS = 1e-10, 3
SINGULAR = 1e-13  # pivot over what it was before anything was eliminated
NOT_A_MINIMUM = (
    "Derivatives: the values reached are no isolated minimum, so they have none. Either nothing fixes the block or a "
    "part of it (jaxba.free_gauge(problem) names the directions: add a position prior or three control points, or fix "
    "two poses; leave out points seen once, as solution.report.problem does), or the solver stopped before it "
    "converged (solution.advice)."
)
_HELD = (
    "Derivatives: {held} of {points} points rest on a saddle instead of in a minimum, as a wrong match makes them, and "
    "count as fixed. Leave wrong matches out first (jaxba.solve_and_reject)."
)


class Found(NamedTuple):
    """Where a solver stopped."""

    unknowns: Unknowns
    status: Int[Array, ""]
    num_steps: Int[Array, ""]


@eqx.filter_custom_jvp
def optimum(
    system: System,
    start: Unknowns,
    *,
    forward: Callable[[System, Unknowns], Found],
    exact: bool,
    require: Callable[[], None],
) -> Found:
    """Return `forward(system, start)`, with the derivatives of an optimum.

    - `exact`: whether H holds the second derivatives, or J^T J alone.
    - `require`: called where derivatives are taken; raises `JaxbaError` where the problem can have none.
    """
    del exact, require
    return forward(system, start)


@optimum.def_jvp
def _optimum_jvp(
    primals: tuple[System, Unknowns],
    tangents: tuple[Any, Any],
    *,
    forward: Callable[[System, Unknowns], Found],
    exact: bool,
    require: Callable[[], None],
) -> tuple[Found, Found]:
    require()
    system, start = primals
    found = optimum(system, start, forward=forward, exact=exact, require=require)
    system_dot, start_dot = (_zeros_for_none(p, t) for p, t in zip(primals, tangents, strict=True))
    try:
        near, equations = _at_the_optimum(*jax.lax.stop_gradient((system, found.unknowns)), exact)
        equations = _require_minimum(equations)
        unknowns = jax.tree.map(lambda a, b: a + jax.lax.stop_gradient(b - a), found.unknowns, near)
        tell_held(jnp.sum(system.free.points[:, 0]), jnp.sum(equations.system.free.points[:, 0]))
        moved = _moved(system, unknowns, equations, system_dot, start_dot)
    except eqx.EquinoxRuntimeError as error:
        raise JaxbaError(NOT_A_MINIMUM) from error
    return found, Found(moved, None, None)  # pyright: ignore[reportArgumentType]


def tell_held(free: Array, left: Array) -> None:
    """Warn of points that were held, also from inside a jit."""

    def tell(free: Any, left: Any) -> None:
        if left < free:
            text = _HELD.format(held=int(free - left), points=int(free))
            warnings.warn(text, RuntimeWarning, stacklevel=2)

    if is_traced((free, left)):
        jax.debug.callback(tell, free, left)
    else:
        tell(free, left)


def gradient(system: System, unknowns: Unknowns) -> Step:
    """Return the gradient of the cost, by reverse mode; what is fixed counts as well."""
    zero = jax.tree.map(jnp.zeros_like, system.free)
    return jax.grad(lambda step: cost(system, unknowns.retract(step)))(zero)


def polish(system: System, unknowns: Unknowns) -> Unknowns:
    """Return the unknowns after a Newton step; as they are where the cost would rise."""
    if not isinstance(system.loss, Linear):
        unknowns = _call(settled, system, unknowns)
    return _call(_newton, _call(_exact_equations, system, unknowns), unknowns)


def _at_the_optimum(system: System, unknowns: Unknowns, exact: bool) -> tuple[Unknowns, "_Equations"]:
    near = polish(system, unknowns)
    return near, _call(_exact_equations if exact else _gauss_newton_equations, system, near)


def _call(function: Callable[..., Any], *arguments: Any) -> Any:
    """Call a module's function, compiled ahead where its arguments are known, else traced once for all its calls."""
    return _traced_once(function)(*arguments) if is_traced(arguments) else call_compiled(function, *arguments)


@functools.cache
def _traced_once(function: Callable[..., Any]) -> Callable[..., Any]:
    return jax.jit(function)


def settled(system: System, unknowns: Unknowns) -> Unknowns:
    """Return the unknowns with every point in a minimum of its own.

    The solver stops when the whole cost no longer changes; a point with a wrong match may then still be on its way over
    a flat stretch, where its second derivatives are negative, and the block's would have no factor.
    """

    def going(state: tuple[Unknowns, Array, Array, Array]) -> Array:
        _, before, now, rounds = state
        return (before - now > _SETTLED * now) & (rounds < _MOST_ROUNDS)

    def refine(state: tuple[Unknowns, Array, Array, Array]) -> tuple[Unknowns, Array, Array, Array]:
        unknowns, _, now, rounds = state
        refined = refine_points(system, unknowns, unknowns, jnp.array(True))
        return refined.unknowns, now, refined.cost, rounds + 1

    start = cost(system, unknowns)
    return jax.lax.while_loop(going, refine, (unknowns, jnp.full_like(start, jnp.inf), start, jnp.array(0)))[0]


def _newton(equations: "_Equations", unknowns: Unknowns) -> Unknowns:
    system = equations.system
    step = jax.tree.map(jnp.multiply, system.free, equations.solve(equations.model.gradient))
    moved = unknowns.retract(jax.tree.map(jnp.negative, step))
    intrinsics = jnp.clip(moved.intrinsics, system.lower, system.upper)
    intrinsics = jnp.where(system.free.intrinsics > 0, intrinsics, moved.intrinsics)
    moved = eqx.tree_at(lambda u: u.intrinsics, moved, intrinsics)
    before = cost(system, unknowns)
    better = cost(system, moved) <= before + 1e-12 * jnp.abs(before)
    return jax.tree.map(lambda a, b: jnp.where(better, a, b), moved, unknowns)


class _Equations(NamedTuple):
    """H at some unknowns, factored; what a bound holds is fixed in its system. `pivot`: see `smallest_pivot`."""

    system: System
    model: Linearisation
    reduced: Reduced
    factored: Factored
    pivot: Float[Array, ""]
    at_lower: Float[Array, "cameras parameters"]
    at_upper: Float[Array, "cameras parameters"]

    def solve(self, rhs: Step) -> Step:
        """Return H^-1 b."""
        vector = reduce_vector(self.system, self.reduced.points, rhs)
        vector = solve_factored(self.system, self.reduced, self.factored, vector)
        return back_substitute(self.system, self.reduced.points, rhs, vector)


def _exact_equations(system: System, unknowns: Unknowns) -> _Equations:
    return _equations(system, unknowns, True)


def _gauss_newton_equations(system: System, unknowns: Unknowns) -> _Equations:
    return _equations(system, unknowns, False)


def _equations(system: System, unknowns: Unknowns, exact: bool) -> _Equations:
    assemble = hessian if exact else linearise
    at_lower = at_upper = jnp.zeros_like(system.free.intrinsics)
    if system.shape.any_bound:
        slope, free = linearise(system, unknowns).gradient.intrinsics, system.free.intrinsics
        # a step to a bound ends on it but for rounding
        below, above = unknowns.intrinsics - system.lower, system.upper - unknowns.intrinsics
        near = ON_BOUND * (1 + jnp.abs(unknowns.intrinsics))
        at_lower = jnp.where((below <= near) & (slope > 0), free, 0.0)
        at_upper = jnp.where((above <= near) & (slope < 0), free, 0.0)
        system = eqx.tree_at(lambda s: s.free.intrinsics, system, free * (1 - at_lower) * (1 - at_upper))
    model = assemble(system, unknowns)
    if exact:
        system, model = hold_saddles(system, model)
    reduced = eliminate_points(system, model, one_for_fixed(system, jax.tree.map(jnp.zeros_like, system.free)))
    factored = factor_reduced(system, reduced)
    return _Equations(system, model, reduced, factored, smallest_pivot(system, reduced, factored), at_lower, at_upper)


def _require_minimum(equations: _Equations) -> _Equations:
    """Return the equations; raise where H is singular, also from inside a jit.

    It stands outside of what is compiled for the values that are known: jax keeps no program that calls back.
    """
    singular = ~(equations.pivot > SINGULAR)
    if is_traced(singular):
        return eqx.error_if(equations, singular, NOT_A_MINIMUM)
    if singular:
        raise JaxbaError(NOT_A_MINIMUM)
    return equations


def hold_saddles(system: System, model: Linearisation) -> tuple[System, Linearisation]:
    """Hold points whose own second derivatives are not positive definite."""
    v = model.point_products
    minors = [v[:, 0, 0], v[:, 0, 0] * v[:, 1, 1] - v[:, 0, 1] ** 2, jnp.linalg.det(v)]
    minimum = functools.reduce(jnp.logical_and, [minor > 0 for minor in minors])
    stands = jnp.where(minimum | (system.free.points[:, 0] == 0), 1.0, 0.0)
    of_rows = rows_of(stands, system.reprojection.point_index).reshape(-1)
    system = eqx.tree_at(lambda s: s.free.points, system, system.free.points * stands[:, None])
    held = (
        model.w * of_rows[:, None, None],
        model.point_products * stands[:, None, None],
        model.point_shared * stands[:, None, None],
        model.gradient.points * stands[:, None],
    )
    return system, eqx.tree_at(lambda m: (m.w, m.point_products, m.point_shared, m.gradient.points), model, held)


@eqx.filter_jit
def _moved(system: System, unknowns: Unknowns, equations: _Equations, system_dot: Any, start_dot: Unknowns) -> Unknowns:
    """Return the tangent of the optimum; `equations` only solve, what is differentiated anew are the first two."""
    bounds_dot = [
        jnp.where(jnp.isfinite(bound), dot, 0.0)
        for bound, dot in ((system.lower, system_dot.lower), (system.upper, system_dot.upper))
    ]
    free = equations.system.free
    intrinsics_dot = jnp.where(equations.at_upper > 0, bounds_dot[1], start_dot.intrinsics)
    intrinsics_dot = jnp.where(equations.at_lower > 0, bounds_dot[0], intrinsics_dot)
    held_dot = Unknowns(
        poses=jax.tree.map(lambda dot: jnp.where(free.poses[:, :1] > 0, 0.0, dot), start_dot.poses),
        intrinsics=jnp.where(free.intrinsics > 0, 0.0, intrinsics_dot),
        antenna=jnp.where(free.antenna > 0, 0.0, start_dot.antenna),
        points=jnp.where(free.points > 0, 0.0, start_dot.points),
    )
    slope, pull = eqx.filter_jvp(gradient, (system, unknowns), (system_dot, held_dot))
    pull = _zeros_for_none(slope, pull)  # of what nothing depends on
    zero, flat = jax.tree.map(jnp.zeros_like, free), jax.flatten_util.ravel_pytree
    unflatten = flat(zero)[1]

    def masked(step: Step) -> Step:
        return jax.tree.map(jnp.multiply, free, step)

    def solve(_: Any, rhs: Array) -> Array:
        return flat(equations.solve(unflatten(rhs)))[0]

    def product(flat_step: Array) -> Array:
        step = unflatten(flat_step)
        through = jax.jvp(lambda s: gradient(system, unknowns.retract(s)), (zero,), (masked(step),))[1]
        return flat(jax.tree.map(lambda f, h, s: f * h + (1 - f) * s, free, through, step))[0]

    # one vector: jax cannot transpose the solve where a part of the right-hand side is known to be zero
    solved = jax.lax.custom_linear_solve(product, -flat(masked(pull))[0], solve, symmetric=True)
    stepped = jax.jvp(unknowns.retract, (zero,), (masked(unflatten(solved)),))[1]
    return jax.tree.map(jnp.add, stepped, held_dot)


def _zeros_for_none(primal: Any, tangent: Any) -> Any:
    """Return the tangent with zeros where there is none for an inexact array."""

    def fill(p: Any, t: Any) -> Any:
        return jnp.zeros_like(p) if t is None and eqx.is_inexact_array(p) else t

    return jax.tree.map(fill, primal, tangent, is_leaf=lambda leaf: leaf is None)
