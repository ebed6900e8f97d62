"""What one solver did with one problem, in the same terms for every solver.

Costs are half the sum of squares with the robust losses applied, each solver's own figure; `benchmarks.cost` computes
them again from the values that the solver returned, in the same way for all.
"""

import dataclasses
from typing import TypedDict

import jax
import numpy as np

from jaxba.ba import Problem


class HistoryRow(TypedDict):
    """State after one step; `seconds` count from the first step on, preprocessing and compile left out."""

    step: int
    seconds: float
    cost: float
    accepted: bool


@dataclasses.dataclass(frozen=True)
class Values:
    """Values of all unknowns: quaternions `cam_from_world` scalar first, metres, pixels; one row an item."""

    quaternion: np.ndarray
    translation: np.ndarray
    intrinsics: np.ndarray
    points: np.ndarray

    @staticmethod
    def of(problem: Problem) -> "Values":
        """Return copies of a problem's values in float64."""
        with jax.enable_x64(True):
            intrinsics = np.array(problem.cameras.parameters, float)
        return Values(
            np.array(problem.poses.quaternion, float),
            np.array(problem.poses.translation, float),
            intrinsics,
            np.array(problem.points, float),
        )


@dataclasses.dataclass(frozen=True)
class Record:
    """One solve.

    - `seconds_preprocess`: analysis of the problem's structure, once a solve, before the first step.
    - `seconds_total`: preprocessing, steps and postprocessing; building the problem and compiling left out.
    """

    solver: str
    initial_cost: float
    final_cost: float
    history: list[HistoryRow]
    seconds_preprocess: float
    seconds_compile: float
    seconds_total: float
    termination: str
    num_iterations: int
    values: Values

    def seconds_to(self, cost: float) -> float:
        """Return the seconds until an accepted step brings at most this cost, preprocessing included, or infinity."""
        reached = [row["seconds"] for row in self.history if row["accepted"] and row["cost"] <= cost]
        return self.seconds_preprocess + reached[0] if reached else float("inf")
