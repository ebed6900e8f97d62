"""Deal the points of a problem out into parts, each with all observations of its points, and with all images.

Points are dealt along the order of the images, so that few images are seen from two parts; each part gets as many
observations. Every row of every prior goes to one part: those of points to the part of their point, the others to the
first. All parts have one shape, so that they share what is compiled.
"""

import dataclasses
import functools
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Int

from jaxba.ba._plan import ROW_RUN, ImageLayout, LinearSolver, Orders, lay_out_images, make_plan, widened
from jaxba.ba._plan_shape import PlanShape, bare_shape, bucket, larger, num_rows
from jaxba.ba._problem import AbstractPrior, Problem
from jaxba.ba._system import System, arrange, make_system, restore
from jaxba.ba._unknowns import Unknowns
from jaxba.ba.tiles._cut import sub_problem
from jaxba.geometry import AbstractLoss

_SPARE = 1.15  # of the sizes of a part of a series: points, observations and pairs are not dealt out quite evenly


@dataclasses.dataclass(frozen=True)
class Part:
    """A part: its points, in the problem's order, its orders in the solver, and its system."""

    points: Int[np.ndarray, " points"]
    orders: Orders
    system: System

    def take(self, unknowns: Unknowns, dtype: Any) -> Unknowns:
        """Return the part of all unknowns, in the solver's order."""
        own = Unknowns(unknowns.poses, unknowns.intrinsics, unknowns.antenna, unknowns.points[self.points])
        return arrange(own, self.orders, dtype)


class Dealt(NamedTuple):
    """A problem in parts.

    - `joint`: the system of images and border alone, into which the blocks of all parts go.
    """

    parts: tuple[Part, ...]
    joint: System

    def restore(self, of_parts: tuple[Unknowns, ...]) -> Unknowns:
        """Return the unknowns in the problem's own order, without padding."""
        found = [restore(own, part.orders) for own, part in zip(of_parts, self.parts, strict=True)]
        first = found[0]
        points = np.empty((sum(len(part.points) for part in self.parts), 3), first.points.dtype)
        for own, part in zip(found, self.parts, strict=True):
            points[part.points] = own.points
        return Unknowns(first.poses, first.intrinsics, first.antenna, points)


def deal_out(
    problem: Problem,
    loss: AbstractLoss,
    count: int,
    linear_solver: LinearSolver,
    dtype: Any,
    *,
    like: PlanShape | None = None,
) -> Dealt:
    """Return a problem in so many parts.

    - `like`: as in `make_plan`, of a problem in one piece.
    """
    least = bare_shape(problem, like)
    layout = lay_out_images(problem, least, linear_solver, like=like)
    image, point = np.asarray(problem.observations.image_index), np.asarray(problem.observations.point_index)
    part_of_point = _dealt(image, point, layout, problem.num_points, count)
    part_of_row = part_of_point[point]
    of_priors = [_part_of_rows(prior, part_of_point) for prior in problem.priors]
    images, cameras = np.arange(problem.num_images), np.arange(problem.num_cameras)
    points = [np.flatnonzero(part_of_point == number) for number in range(count)]

    def sub(number: int) -> Problem:
        rows = np.flatnonzero(part_of_row == number)
        of_part = [np.flatnonzero(parts == number) for parts in of_priors]
        return sub_problem(problem, rows, images, points[number], cameras, of_part)

    problems = [sub(number) for number in range(count)]
    shape = _of_part(least, layout, 1 if like is None else count)
    plans = [make_plan(part, linear_solver="dense", like=shape, image_order=layout.order) for part in problems]
    common = functools.reduce(larger, (plan.shape for plan in plans))
    plans = [plan if plan.shape == common else widened(plan, common) for plan in plans]
    systems = [make_system(*each, loss, dtype) for each in zip(problems, plans, strict=True)]
    parts = [
        Part(*each) for each in zip(points, (plan.orders() for plan in plans), jax.device_put(systems), strict=True)
    ]
    return Dealt(tuple(parts), jax.device_put(_joint(systems, layout)))


def _dealt(
    image: Int[np.ndarray, " n"], point: Int[np.ndarray, " n"], layout: ImageLayout, num_points: int, count: int
) -> Int[np.ndarray, " points"]:
    """Return the part of each point: along the order of the images, each with as many observations."""
    first_seen = np.full(num_points, len(layout.order), np.int32)
    np.minimum.at(first_seen, point, np.argsort(layout.order).astype(np.int32)[image])
    order = np.argsort(first_seen, kind="stable")
    seen = np.bincount(point, minlength=num_points)[order]
    part = np.empty(num_points, np.int32)
    part[order] = np.minimum((np.cumsum(seen) - seen) * count // max(len(point), 1), count - 1)
    return part


def _part_of_rows(prior: AbstractPrior, part_of_point: Int[np.ndarray, " points"]) -> Int[np.ndarray, " rows"]:
    if hasattr(prior, "point_index"):
        return part_of_point[np.asarray(prior.point_index)]  # pyright: ignore[reportAttributeAccessIssue]
    return np.zeros(num_rows(prior), np.int32)


def _of_part(shape: PlanShape, layout: ImageLayout, count: int) -> PlanShape:
    """Return the least sizes of one of several parts: of one, those that are given."""

    def part(size: int) -> int:
        return bucket(int(size * _SPARE / count)) if count > 1 else size

    return dataclasses.replace(
        shape,
        num_images=layout.num_images,
        num_points=part(shape.num_points),
        num_rows=part(shape.num_rows + ROW_RUN * layout.num_images // 2),
        num_pair_runs=part(shape.num_pair_runs),
        num_blocks=part(shape.num_blocks),
        linear_solver="dense",
        panel_images=1,
        band_panels=0,
    )


def _joint(systems: list[System], layout: ImageLayout) -> System:
    """Return the system without points and observations, with the blocks of all parts side by side."""
    first, shape = systems[0], systems[0].shape
    none, lanes = np.zeros(0, np.int32), np.zeros((0, ROW_RUN), np.int32)
    weight = np.zeros((0, ROW_RUN), np.asarray(first.free.points).dtype)
    observations = dataclasses.replace(
        first.reprojection, xy_px=np.stack([weight, weight]), weight=weight, point_index=lanes, run_image=none
    )
    return dataclasses.replace(
        first,
        reprojection=observations,
        priors=(),
        free=dataclasses.replace(first.free, points=np.zeros((0, 3), weight.dtype)),
        point_image=none,
        pair_first=none.reshape(0, 1, 1),
        pair_second=none.reshape(0, 1, 1),
        pair_block=none,
        block_row=np.concatenate([system.block_row for system in systems]),
        block_column=np.concatenate([system.block_column for system in systems]),
        shape=dataclasses.replace(
            shape,
            num_points=0,
            num_rows=0,
            num_pair_runs=0,
            num_blocks=shape.num_blocks * len(systems),
            linear_solver=layout.linear_solver,
            panel_images=layout.panel_images,
            band_panels=layout.band_panels,
            prior_rows=(),
        ),
    )
