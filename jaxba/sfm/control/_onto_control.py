"""A block brought onto its control points, once these have been tested against it.

The block as photos and positions make it says where its control points lie. That is compared with the survey and
explained (`_explained.py`) before a surveyed coordinate may pull. Then the block is solved with what has stood
the test, and tested again there: by the Jacobians of the block where control holds it, what photos and positions alone
say of the points is

    m = v + C S^-1 w v + d

to first order, v being adjusted minus surveyed, C how far the points give way where no control holds them (the inverse
of the normal equations with the losses' curvature), S the covariance of the survey with the weights w that the loss
left (0 where a coordinate was set aside), d what positions have in common. It goes on
until the tests say the same twice: a block that had to be turned or bent far by its control is judged where it lies.
"""

import dataclasses
import logging
from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jaxba._errors import JaxbaError
from jaxba.ba import AbstractPrior, ControlPointPrior, PositionPrior, Problem, propagate
from jaxba.geometry import Similarity
from jaxba.scene import Block, Control, Reference
from jaxba.sfm._measured import common_std, flights_of, median_offset
from jaxba.sfm._rounds import Solved
from jaxba.sfm._spread import spread, weighed
from jaxba.sfm.control._control import CONTROL_LOSS, Standing, after_tests
from jaxba.sfm.control._explained import Explained, explain
from jaxba.sfm.control._misclosure import Misclosure
from jaxba.sfm.control._start import transformed
from jaxba.sfm.control._statistics import Tested, control_statistics

_log = logging.getLogger(__name__)

_MOST = 5  # solves on control
_ALREADY_FREE_M = 1e-4


@dataclasses.dataclass(frozen=True, eq=False)
class OnControl:
    """What came of the tests of control.

    - `explained`: what is wrong. `tested`: statistics of every point of `Control`. `standing`: of the last solve.
    - `is_settled`: the tests said the same twice. `why_not`: why there were none, where there were none.
    """

    explained: Explained
    tested: Tested
    standing: Standing
    is_settled: bool
    why_not: str | None = None


def onto_control(
    solved: Solved,
    std_px: float,
    reference: Reference,
    control: Control,
    max_memory: float | str | None,
    solve: Callable[[Block, Standing], Solved],
) -> tuple[Solved, OnControl | None]:
    """Return the block solved with what stands of control, and what the tests said; None where control has no part.

    - `solved`: by photos and positions. `solve`: solves a block with control as it is told.
    """
    if solved.control is None:
        return solved, None
    common_std_m = common_std(solved.block, reference)
    moves_m = np.zeros(3) if common_std_m is None else common_std_m
    if flights_of(solved.block, reference) is not None:
        # offsets of flights are free in the block already; a shift of all of them beside is a mistake to be looked for
        moves_m = np.where(np.isfinite(median_offset(solved.block, reference)), _ALREADY_FREE_M, 0.0)
    none = Explained(control.num_points)
    found, standing, why_not = none, None, None
    for count in range(_MOST + 1):
        try:
            given = _misclosure(solved, std_px, control, standing, moves_m, max_memory)
            why_not = None
        except JaxbaError as error:
            given, why_not = None, str(error)
        last, found = found, none if given is None else explain(given)
        settled = standing is not None and (given is None or found.same_as(last))
        if settled or count == _MOST:
            break
        result = None if given is None else control_statistics(given, found)
        shift_m = np.zeros(3) if result is None else result.shift_m
        standing = after_tests(control, found.wrong, found.scale, common_std_m, shift_m, found.is_shifted)
        by = Similarity(scale=1.0, rotation=np.eye(3), shift=solved.common_m - shift_m)
        _log.info("control: %d coordinates set aside", int(found.wrong.sum()))
        solved = solve(transformed(solved.block, by), standing)
    assert standing is not None
    result = Tested.nothing(control.num_points) if given is None else control_statistics(given, found)
    return solved, OnControl(found, result, standing, settled, why_not)


def _misclosure(
    solved: Solved,
    std_px: float,
    control: Control,
    standing: Standing | None,
    moves_m: Float[np.ndarray, "3"],
    max_memory: float | str | None,
) -> Misclosure:
    """Return what photos and positions say of the control points, linearised at a solution.

    - `standing`: of that solution; None where control did not hold it. `moves_m`: see `Misclosure.common_std_m`.
    """
    part = solved.control
    assert part is not None
    block, rows = solved.block, part.rows
    shown = spread(block, solved.error_px, std_px, solved.loss)

    def of_points(*, yielding: bool) -> Float[np.ndarray, "points 3 points 3"]:
        times = shown.yielding if yielding else shown.scatter
        problem = without_control(weighed(solved.problem, times, block.num_observations, yielding=yielding))
        loss = dataclasses.replace(solved.loss, f_scale=solved.loss.f_scale / times)
        numbers = jnp.arange(len(rows)) + block.num_points
        free = propagate(lambda p: p.points[numbers], problem, loss=loss, max_memory=max_memory)
        return free.covariance.reshape(len(rows), 3, len(rows), 3)

    covariance = of_points(yielding=False)
    off = np.full((control.num_points, 3), np.nan)
    off[rows] = np.where(np.isfinite(part.xyz_m), part.start_m - part.xyz_m, np.nan)
    off[~np.isfinite(control.std_m)] = np.nan
    if standing is not None:
        held = standing.std_m[rows]
        over = np.nan_to_num(off[rows]) / held
        with jax.enable_x64(True):
            left = np.asarray(CONTROL_LOSS.derivatives(jnp.asarray(np.sum(over**2, axis=1)))[1])
        pulls = left[:, None] * over / held
        off[rows] += np.einsum("iajb,jb->ia", of_points(yielding=True), pulls) + np.where(
            moves_m > 0, solved.common_m, 0.0
        )
    else:
        covariance = covariance + _bent(covariance, part.start_m)
    whole = np.zeros((control.num_points, 3, control.num_points, 3))
    whole[rows[:, None], :, rows] = covariance.transpose(0, 2, 1, 3)
    return Misclosure(off, control.xyz_m, control.std_m, whole, moves_m)


def without_control(problem: Problem) -> Problem:
    """Return the problem with its control points' survey of no weight, and an offset of all positions as it is."""

    def weightless(prior: AbstractPrior) -> AbstractPrior:
        if not isinstance(prior, ControlPointPrior):
            return prior
        return dataclasses.replace(prior, std_m=np.full(prior.std_m.shape, np.inf))

    problem = dataclasses.replace(problem, priors=tuple(map(weightless, problem.priors)))
    position = problem.prior("position")
    if isinstance(position, PositionPrior) and position.offset_weights is not None:
        return problem  # those of flights bend the block, and are known from it
    return eqx.tree_at(lambda p: p.free.position_offset, problem, np.array(False))


def _bent(
    covariance_m2: Float[np.ndarray, "points 3 points 3"], xyz_m: Float[np.ndarray, "points 3"]
) -> Float[np.ndarray, "points 3 points 3"]:
    """Return the variance of what is not linear in a block that may still turn: its sway squared over twice its size.

    A block turned by an angle t moves its points by t times their distance, and by t^2 / 2 of it beside that.
    """
    count = len(xyz_m)
    middle = np.eye(count) - 1 / count
    sway_m2 = float(np.einsum("ij,jaka,ki->", middle, covariance_m2, middle)) / count
    size_m2 = float(np.mean(np.sum((xyz_m - xyz_m.mean(axis=0)) ** 2, axis=1)))
    std_m = sway_m2 / (2 * np.sqrt(size_m2)) if size_m2 > 0 else 0.0
    return (std_m**2 * np.eye(3 * count)).reshape(count, 3, count, 3)
