"""What `solve` returns: the adjusted unknowns, how the solver got there and what it left out."""

import dataclasses
import functools
from collections.abc import Sequence

import equinox as eqx
import numpy as np
from jax import Array
from jaxtyping import Float, Int

from jaxba._errors import JaxbaError
from jaxba.ba._factor import CG_MAX_STEPS
from jaxba.ba._problem import Problem
from jaxba.ba._solvers import FTOL, GTOL, NOT_FINITE, RUNNING, STUCK, XTOL
from jaxba.ba._tables import DataFrame, control_table, images_table, observations_table, pairs_table, points_table
from jaxba.ba._unknowns import Unknowns
from jaxba.ba.checks import Dropped, free_gauge, implausible_cameras
from jaxba.geometry import AbstractCamera, Pose

RESULTS = {
    RUNNING: "max_nfev",
    FTOL: "ftol",
    XTOL: "xtol",
    GTOL: "gtol",
    STUCK: "stuck",
    NOT_FINITE: "not_finite",
}
"""Names of a solution's status."""

_NOTHING, _GAIN = 1e-12, 1e-8  # shares of the cost: a fall that is rounding, a gain not worth a step
_ZERO = 1e-16  # of the cost at the start: where pixels are exact, the rest is rounding

_ADVICE = {
    "ftol": "Converged: the cost no longer changes (ftol).",
    "xtol": "Converged: the unknowns no longer change (xtol).",
    "gtol": "Converged: the gradient is zero (gtol).",
    "max_nfev": "Not converged after max_nfev steps. Continue with more, or, if the cost is still high, look at "
    "the input: wrong focal length, wrong matches under a loss that is not robust.",
    "stuck": "Not converged: no step lowers the cost. Look for points at infinity or images with few points; a robust "
    "loss, priors or fixed intrinsics make such problems better posed.",
    "rounding": "Converged: the optimum is reached to rounding, and no step lowers the cost further. ftol, xtol or "
    "gtol ask for more digits than there are.",
    "not_finite": "Not started: the cost at the start values is not finite. Some point may lie in a camera's plane.",
    "interrupted": "Interrupted: these are the values reached so far.",
    "cg_unconverged": "Not converged: conjugate gradients gave up before they found the last step, whose length says "
    "nothing then. Solve in tiles (jaxba.solve_tiled, or --tiled), where steps are exact at any size.",
}


@dataclasses.dataclass(frozen=True)
class HistoryStep:
    """One step tried: when it ended (seconds, compile time left out), the cost after it, and how the step came about.

    - `change`: by which the cost fell. `gradient`: largest entry of the gradient before the step. `step`: its length.
    - `trust`: damping (Levenberg-Marquardt) or radius (dogleg) for the next step.
    - `points_held`: points that the step would have put behind a camera or nowhere; they stayed where they were.
    """

    step: int
    seconds: float
    cost: float
    accepted: bool
    change: float = 0.0
    gradient: float = 0.0
    step_norm: float = 0.0
    trust: float = 0.0
    linear_iterations: int = 0
    points_held: int = 0


@dataclasses.dataclass(frozen=True, eq=False)
class Report:
    """What a solve on the host tells beside its numbers.

    - `history`: the start and every step tried.
    - `dropped`: what was left out of the problem, with reasons; `dropped.summary()` says it in words.
    - `seconds_setup`: checks and structure; `seconds_compile`; `seconds_solve`: the steps.
    - `linear_solver`: how the reduced system was solved.
    """

    history: tuple[HistoryStep, ...]
    dropped: Dropped
    seconds_setup: float
    seconds_compile: float
    seconds_solve: float
    linear_solver: str
    interrupted: bool
    problem: Problem
    """What was solved: the given problem without what was left out."""

    @functools.cached_property
    def free_gauge(self) -> tuple[str, ...]:
        """Directions that nothing fixes; empty if the problem is fully determined."""
        return free_gauge(self.problem)


class Solution(eqx.Module):
    """Adjusted unknowns, in the problem's own order.

    - `initial_cost`, `final_cost`: half the sum of losses over all groups.
    - `initial_plain_cost`, `plain_cost`: the same without the losses.
    - `status`: why the solver stopped; `result` names it.
    - `report`: None for a solve inside `jit`, `vmap` or a derivative.
    """

    poses: Pose
    cameras: AbstractCamera
    points: Float[Array | np.ndarray, "points 3"]
    lever_arm: Float[Array | np.ndarray, "3"]
    initial_cost: Float[Array | np.ndarray, ""]
    final_cost: Float[Array | np.ndarray, ""]
    initial_plain_cost: Float[Array | np.ndarray, ""]
    plain_cost: Float[Array | np.ndarray, ""]
    status: Int[Array | np.ndarray, ""]
    num_steps: Int[Array | np.ndarray, ""]
    report: Report | None = eqx.field(static=True, default=None)
    position_offset: Float[Array | np.ndarray, "offsets 3"] = eqx.field(default_factory=lambda: np.zeros((0, 3)))

    @staticmethod
    def of(
        problem: Problem,
        values: Unknowns,
        costs: Sequence[Float[Array | np.ndarray, ""]],
        status: Int[Array | np.ndarray, ""],
        num_steps: Int[Array | np.ndarray, ""],
        report: Report | None = None,
    ) -> "Solution":
        """Return the solution of these values, in the problem's order; `costs` are the four, in the fields' order."""
        return Solution(
            values.poses,
            type(problem.cameras).from_parameters(values.intrinsics),
            values.points,
            values.lever_arm,
            *costs,
            status=status,
            num_steps=num_steps,
            report=report,
            position_offset=values.position_offset,
        )

    @property
    def result(self) -> str:
        """One of ftol, xtol, gtol, rounding (converged), max_nfev, stuck, not_finite, interrupted, cg_unconverged.

        A solve inside `jit`, `vmap` or a derivative does not tell `rounding` from `stuck`, nor `cg_unconverged`.
        """
        if self.report is not None and self.report.interrupted:
            return "interrupted"
        result = RESULTS[int(self.status)]
        if result != "gtol" and self.report is not None and self.report.history[-1].linear_iterations >= CG_MAX_STEPS:
            return "cg_unconverged"
        return "rounding" if result == "stuck" and self._is_at_rounding() else result

    @property
    def converged(self) -> bool:
        """Whether one of the convergence tests was met."""
        return self.result in ("ftol", "xtol", "gtol", "rounding")

    def _is_at_rounding(self) -> bool:
        """Whether even the longest of the steps refused since the cost last fell could have gained next to nothing.

        A step gains at most gradient times length. Where the solver is stuck for another reason, the first steps
        refused are long, and grow short by damping alone.
        """
        history = () if self.report is None else self.report.history
        cost = max(float(self.final_cost), _ZERO * float(self.initial_cost))
        least = _NOTHING * cost
        fell = max((i for i, step in enumerate(history) if step.accepted and step.change > least), default=0)
        refused = [step for step in history[fell + 1 :] if not step.accepted]
        return bool(refused) and max(step.gradient * step.step_norm for step in refused) <= _GAIN * cost

    @property
    def advice(self) -> str:
        """Why the solver stopped, and what to do; also where a camera became what no lens can be."""
        found = self.implausible_cameras
        more = f" (and {len(found) - 1} more)" if len(found) > 1 else ""
        return f"{_ADVICE[self.result]} Not to be used as it is: {found[0]}{more}." if found else _ADVICE[self.result]

    @property
    def implausible_cameras(self) -> list[str]:
        """Sentences on cameras that the solver took where no lens can be, such as to a negative focal length.

        Empty for a solve inside `jit`, `vmap` or a derivative.
        """
        return [] if self.report is None else implausible_cameras(self.apply(self.report.problem), few=0.0)

    def observations_frame(self) -> DataFrame:
        """Return the table of observations: pixels, sigmas and residuals. Columns of all tables: `ba/_tables.py`."""
        return observations_table(self._adjusted("observations_frame"), None)

    def images_frame(self) -> DataFrame:
        """Return the table of images; with sigmas it is that of `jaxba.statistics`."""
        return images_table(self._adjusted("images_frame"), None)

    def points_frame(self) -> DataFrame:
        """Return the table of points; with sigmas it is that of `jaxba.statistics`."""
        return points_table(self._adjusted("points_frame"), None)

    def control_frame(self) -> DataFrame:
        """Return the table of control points: sigmas, and adjusted minus surveyed; NaN of what was not surveyed."""
        return control_table(self._adjusted("control_frame"))

    def pairs_frame(self) -> DataFrame:
        """Return the table of pairs of images that have points in common."""
        return pairs_table(self._adjusted("pairs_frame"))

    def _adjusted(self, asks: str) -> Problem:
        """Return what was solved, with the solution's values."""
        if self.report is None:
            raise JaxbaError(
                f"{asks}: a solution from inside jit, vmap or a derivative does not hold its problem; take the tables "
                "of jaxba.statistics(solution.apply(problem))."
            )
        return self.apply(self.report.problem)

    def apply(self, problem: Problem) -> Problem:
        """Return the problem with the solution's values as start values."""

        def unknowns(p: Problem) -> tuple[object, ...]:
            return p.poses, p.cameras, p.points, p.lever_arm, p.position_offset

        values = self.poses, self.cameras, self.points, self.lever_arm, self.position_offset
        return eqx.tree_at(unknowns, problem, values)
