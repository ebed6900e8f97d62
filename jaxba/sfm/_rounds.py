"""One round of the adjustment: the problem of a block with what was measured beside it, solved.

`Settings` are those of all rounds. Rounds in one piece share one shape, so that the first compiles for all; a large
block is solved in tiles, to the same answer, in as much memory as it is given (`Tiling`).
"""

import contextlib
import dataclasses
import logging
import math
import time
from collections.abc import Callable, Sequence
from concurrent.futures import Executor
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from jaxba.ba import HistoryStep, PlanShape, Problem, Solution, reprojection_errors, solve, solve_tiled
from jaxba.geometry import CAMERAS, LOSSES, AbstractLoss, Linear
from jaxba.scene import Block, Control, Photo, Reference, ScaleBars, Tracks
from jaxba.sfm._measured import position_scale
from jaxba.sfm._points import track_rows
from jaxba.sfm._problem import to_problem, with_solution
from jaxba.sfm.control._bar_ends import add_bars
from jaxba.sfm.control._control import ControlPart, Standing, before_control, control_part

_log = logging.getLogger(__name__)

_TRUSTING_ROUNDS = 2
_TELL_EVERY_S = 1.0


@dataclasses.dataclass(frozen=True, kw_only=True)
class Settings:
    """What may be set of the adjustment in rounds; see the adjust stage's parameters, and its inputs for `held`."""

    loss: str = "huber"
    f_scale: float = 1.0
    max_nfev: int = 500
    ftol: float = 1e-8
    xtol: float = 1e-8
    track_threshold: float = 2.0
    mad_factor: float = 2.5
    edge_median_limit: float = 3.0
    min_angle_rad: float = 0.026
    max_rounds: int = 5
    complete_radius: float = 4.0
    held: tuple[str, ...] = ()


@dataclasses.dataclass(frozen=True, kw_only=True)
class Tiling:
    """When a block is solved in tiles, and in how much memory; it changes the answer by rounding alone.

    - `chunk_size`: a block of more images is solved in tiles, at least as many as it has chunks of this size.
    - `max_observations`: a block of more is solved in tiles as well. `max_memory`: as in `solve_tiled`.
    - `folder`: in which solves in tiles keep where they stand, and what does not fit in memory: rounds that were broken
      off go through it again, to the same bytes as without a break.
    - `crew`: opens executors that work on tiles in place of this process, and see the folder, with the bytes that each
      may keep; None where none do.
    """

    chunk_size: int = 500
    max_observations: int = 1_000_000  # 2.1 GB in one piece, and slower there
    max_memory: float | str | None = None
    folder: Path | None = None
    crew: Callable[[], AbstractContextManager[tuple[Sequence[Executor], float] | None]] = contextlib.nullcontext

    def applies(self, block: Block, tracks: Tracks) -> bool:
        """Return whether the block is solved in tiles."""
        return block.num_images > self.chunk_size or tracks.num_observations > self.max_observations


@dataclasses.dataclass(frozen=True)
class Solved:
    """What a round made: see `Adjusted` for the fields."""

    block: Block
    error_px: Float[np.ndarray, " observations"]
    problem: Problem
    loss: AbstractLoss
    solution: Solution
    position_scale: Float[np.ndarray, "3"]
    common_m: Float[np.ndarray, "3"]
    control: ControlPart | None


@dataclasses.dataclass(frozen=True)
class Rounds:
    """What all rounds share; `anchor` is the block at the start."""

    anchor: Block
    reference: Reference
    photos: Sequence[Photo]
    settings: Settings
    control: Control
    tiling: Tiling

    def solve(
        self,
        block: Block,
        std_px: float,
        free: Sequence[str],
        mark_used: Bool[np.ndarray, " marks"],
        shape: PlanShape | None,
        *,
        max_nfev: int,
        ftol: float,
        number: int,
        standing: Standing | None = None,
        bars: tuple[ScaleBars, Bool[np.ndarray, " bars"]] | None = None,
    ) -> Solved:
        """Solve a block; `free` are the camera's parameters that may change, `shape` is that of all rounds.

        - `mark_used`: of all marks of control. `number`: of the round, from 1.
        - `standing`: of control and positions; None where control does not hold the block. `bars`: all, and which of
          them hold it.
        """
        settings = self.settings
        loss = self.loss(std_px)
        scale, let_go = position_scale(block, self.reference), 1.0
        if standing is None:
            standing = before_control(block, self.reference, self.control)
        control = control_part(block, self.control, mark_used, standing.std_m)
        common = None if control is None else standing.common
        if number <= _TRUSTING_ROUNDS and max_nfev < settings.max_nfev:
            # how positions scatter about a block whose camera is not yet right tells nothing of them
            let_go = float(np.max(scale / np.minimum(scale, 1.0)))
            scale = np.minimum(scale, 1.0)
        held = [name for name in CAMERAS[block.camera_model].parameter_names() if name not in free]

        def problem_of(block: Block, control: ControlPart | None) -> Problem:
            problem = to_problem(
                block,
                self.reference,
                self.photos,
                anchor=self.anchor,
                std_px=std_px,
                position_scale=scale,
                let_go=let_go,
                held=held,
                control=control,
                common=common,
            )
            return problem if bars is None else add_bars(problem, block, *bars, self.control, control)

        problem = problem_of(block, control)
        stops: dict[str, Any] = {"max_nfev": max_nfev, "ftol": ftol, "xtol": settings.xtol}
        if shape is None:
            tiles: dict[str, Any] = {
                "num_tiles": math.ceil(block.num_images / self.tiling.chunk_size),
                "max_memory": self.tiling.max_memory,
                "folder": self.tiling.folder,
                "checkpoint": self.tiling.folder,
            }
            told = _Told(number)
            with self.tiling.crew() as crew:
                if crew is not None:
                    tiles |= {"executors": crew[0], "executor_memory": crew[1]}
                solution = solve_tiled(problem, loss=loss, callback=told.step, on_tile=told.tile, **tiles, **stops)
        else:
            solution = solve(problem, loss=loss, plan=shape, **stops)
        if solution.result == "interrupted":
            raise KeyboardInterrupt  # the solver hands on what it reached; rounds go on from an optimum alone
        num_points, num_own = block.num_points, block.num_observations
        block = with_solution(block, solution)
        if control is not None:
            of_control = slice(num_points, num_points + len(control.rows))
            control = dataclasses.replace(control, start_m=np.asarray(solution.points)[of_control])
        problem = solution.apply(problem)
        error_px = reprojection_errors(problem)
        fits = np.isfinite(error_px)
        if solution.report is not None:
            fits &= ~solution.report.dropped.observations
        if not fits[:num_own].all():
            block = with_observations(block, fits[:num_own])
            problem = problem_of(block, control)
            offset_m = np.array(solution.position_offset)
            offset_m[len(offset_m) - problem.num_bar_ends :] = 0.0  # counted from where the ends lie now
            problem = dataclasses.replace(problem, position_offset=offset_m)
            error_px = reprojection_errors(problem)
        error_px = error_px[: block.num_observations]
        common_m = np.zeros(3) if common is None else np.asarray(solution.position_offset)[0]
        return Solved(block, error_px, problem, loss, solution, scale, common_m, control)

    def whole(self, block: Block, tracks: Tracks) -> Problem | None:
        """Return the problem of the block with every observation that may ever join it, to tell shapes by.

        None for a block that is solved in tiles.
        """
        if self.tiling.applies(block, tracks):
            return None
        row, image_row, of_track, index = track_rows(block, tracks)
        full = dataclasses.replace(
            block,
            points_m=np.zeros((len(index), 3)),
            track_index=index,
            rgb=tracks.rgb[index],
            observation_image=image_row,
            observation_point=of_track,
            observation_xy_px=tracks.xy_px[row],
        )
        control = control_part(block, self.control, np.ones(len(self.control.mark_point), bool))
        common = None if control is None else before_control(block, self.reference, self.control).common
        return to_problem(full, self.reference, self.photos, anchor=self.anchor, control=control, common=common)

    def loss(self, std_px: float) -> AbstractLoss:
        """Return the loss of reprojections of a sigma."""
        model = LOSSES[self.settings.loss]
        return Linear() if model is Linear else model(f_scale=self.settings.f_scale / std_px)  # type: ignore[call-arg]


class _Told:
    """Logs where a solve in tiles is, and how long a step still takes if it takes as long as the last one."""

    def __init__(self, number: int) -> None:
        self.round, self.num_steps = number, 0
        self.begun_s, self.last_s, self.told_s = time.monotonic(), math.nan, -math.inf

    def tile(self, done: int, total: int) -> None:
        """Log how much of a step is done; its tiles are worked on twice, up the tree and down."""
        now_s = time.monotonic()
        if now_s - self.told_s < _TELL_EVERY_S:
            return
        self.told_s = now_s
        left_s = self.last_s * (1 - done / total)
        left = f", {left_s:.0f} s left of this step" if left_s >= 1 else ""
        share = 100 * done / total
        _log.info("round %d, step %d, %.0f%% of %d tiles%s", self.round, self.num_steps + 1, share, total // 2, left)

    def step(self, step: HistoryStep) -> None:
        """Log that a step has ended."""
        now_s = time.monotonic()
        self.num_steps, self.begun_s, self.last_s = step.step, now_s, now_s - self.begun_s
        _log.info("round %d, step %d, %.0f s", self.round, step.step, step.seconds)


def without_images(block: Block, gone: Bool[np.ndarray, " images"]) -> Block:
    """Return the block without some images, without their observations, and without points left with fewer than two."""
    keep = ~gone
    number = np.cumsum(keep) - 1
    seen = keep[block.observation_image]
    block = with_observations(block, seen)
    return dataclasses.replace(
        block,
        image_index=block.image_index[keep],
        quaternion=block.quaternion[keep],
        translation_m=block.translation_m[keep],
        camera_index=block.camera_index[keep],
        observation_image=number[block.observation_image],
    )


def with_observations(block: Block, keep: Bool[np.ndarray, " observations"]) -> Block:
    """Return the block with some of its observations, and the points that two or more of these see."""
    keep = keep & (np.bincount(block.observation_point[keep], minlength=block.num_points)[block.observation_point] >= 2)
    seen = np.bincount(block.observation_point[keep], minlength=block.num_points) > 0
    number = np.cumsum(seen) - 1
    return dataclasses.replace(
        block,
        points_m=block.points_m[seen],
        track_index=block.track_index[seen],
        rgb=block.rgb[seen],
        observation_image=block.observation_image[keep],
        observation_point=number[block.observation_point[keep]],
        observation_xy_px=block.observation_xy_px[keep],
    )
