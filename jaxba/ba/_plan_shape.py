"""Shapes of plans: sizes and choices that the compiled code depends on, and how several problems come to share them.

Compiling costs seconds, so every count is rounded up to one of eight sizes an octave. Small counts, whose padding costs
a millisecond or two, are rounded up to one of two, and tiny ones to one size for all.
"""

import dataclasses
from collections.abc import Sequence
from typing import Literal

import numpy as np

from jaxba.ba._problem import AbstractPrior, Problem


@dataclasses.dataclass(frozen=True)
class PlanShape:
    """A plan's sizes and choices that the compiled code depends on; equal shapes share compiled code.

    Padding is counted in. `make_plan(..., like=plan.shape)` makes a plan of at least these sizes.
    """

    num_images: int
    num_points: int
    num_rows: int
    chunk_runs: int
    num_cameras: int
    refined: tuple[bool, ...]
    """Which of the camera model's parameters are free in any camera."""
    own_cameras: bool
    """Each image has its own camera, eliminated with the pose; else the intrinsics are a shared border."""
    antenna: int
    """Columns of lever arm and common offset of positions in the border, where any of these is free; else 0."""
    any_fixed_pose: bool
    any_fixed_point: bool
    any_bound: bool
    num_pair_runs: int
    num_blocks: int
    linear_solver: Literal["dense", "banded", "cg"]
    panel_images: int
    band_panels: int
    prior_rows: tuple[int, ...]
    """Rows of each prior."""

    @property
    def num_refined(self) -> int:
        return sum(self.refined)

    @property
    def num_shared_cameras(self) -> int:
        """Cameras whose intrinsics stand in the border."""
        return 0 if self.own_cameras or not self.num_refined else self.num_cameras

    @property
    def block(self) -> int:
        """Unknowns eliminated with an image: its pose, and its own camera's refined intrinsics."""
        return 6 + (self.num_refined if self.own_cameras else 0)

    @property
    def border(self) -> int:
        """Shared unknowns: refined intrinsics of all cameras, then lever arm and common offset of positions."""
        return self.num_shared_cameras * self.num_refined + self.antenna


_SMALL, SMALL_IMAGES = 2048, 64  # below, two sizes an octave
_LEAST_PRIOR_ROWS = 16
_LEAST = PlanShape(
    num_images=16, num_points=256, num_rows=1024, chunk_runs=0, num_cameras=0, refined=(), own_cameras=False, antenna=0,
    any_fixed_pose=False, any_fixed_point=False, any_bound=False, num_pair_runs=512, num_blocks=64,
    linear_solver="dense", panel_images=1, band_panels=0, prior_rows=(),
)  # fmt: skip


def bare_shape(problem: Problem, like: PlanShape | None = None) -> PlanShape:
    """Return the shape that says what is free and has the least sizes, or those of `like`."""
    least = _LEAST if like is None else like
    free, free_antenna = problem.free, problem.free_antenna
    refined = np.atleast_1d(np.asarray(free.intrinsics).any(axis=0))
    rows = [max(bucket(num_rows(prior)), _LEAST_PRIOR_ROWS) for prior in problem.priors]
    if len(rows) == len(least.prior_rows):
        rows = [max(own, of_like) for own, of_like in zip(rows, least.prior_rows, strict=True)]
    several = problem.num_cameras > 1 or least.own_cameras
    own_cameras = _own_cameras(problem) and several and not any_bound(problem)
    if least.own_cameras == own_cameras and len(least.refined) == len(refined):
        refined = refined | np.array(least.refined)
    return dataclasses.replace(
        least,
        num_cameras=problem.num_cameras,
        refined=tuple(bool(r) for r in refined),
        own_cameras=own_cameras,
        antenna=len(free_antenna) if free_antenna.any() else 0,
        any_fixed_pose=not np.asarray(free.poses).all() or least.any_fixed_pose,
        any_fixed_point=not np.asarray(free.points).all() or least.any_fixed_point,
        any_bound=any_bound(problem),
        prior_rows=tuple(rows),
    )


def larger(first: PlanShape, second: PlanShape) -> PlanShape:
    """Return the larger of every size of two shapes of the same kind."""
    names = ("num_images", "num_points", "num_rows", "num_cameras", "num_pair_runs", "num_blocks", "band_panels")
    sizes = {name: max(getattr(first, name), getattr(second, name)) for name in names}
    rows = tuple(max(rows) for rows in zip(first.prior_rows, second.prior_rows, strict=True))
    flags = {name: getattr(first, name) or getattr(second, name) for name in ("any_fixed_pose", "any_fixed_point")}
    return dataclasses.replace(second, **sizes, **flags, prior_rows=rows)


def alike(sizes: Sequence[int], least: float) -> list[list[int]]:
    """Return the indices of sizes in groups, the largest first, in which none is below `least` of the largest."""
    groups: list[list[int]] = []
    for number in sorted(range(len(sizes)), key=lambda k: -sizes[k]):
        if not groups or sizes[number] < least * sizes[groups[-1][0]]:
            groups.append([])
        groups[-1].append(number)
    return groups


def num_rows(prior: AbstractPrior) -> int:
    """Return the number of a prior's rows."""
    return next(np.shape(value)[0] for name, value in vars(prior).items() if name != "loss")


def bucket(count: int, *, multiple: int = 1, small: int = _SMALL) -> int:
    """Round up to one of eight sizes an octave (at most 12.5% more), below `small` to one of two, and to a multiple."""
    step = 1 << max(count.bit_length() - (2 if count < small else 4), 0)
    rounded = -(-count // step) * step
    return -(-rounded // multiple) * multiple


def _own_cameras(problem: Problem) -> bool:
    camera_index = np.asarray(problem.camera_index)
    return len(np.unique(camera_index)) == len(camera_index) == problem.num_cameras


def any_bound(problem: Problem) -> bool:
    return bool(np.isfinite(problem.lower).any() or np.isfinite(problem.upper).any())
