"""Scale bars of a block: the points at their ends, put into an adjustment problem.

The ends are points of their own, with their marks as observations; the end that a control point stands at is that
point.
"""

import dataclasses
from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxba.ba import Free, Observations, Problem, with_scale_bars
from jaxba.scene import Block, Control, ScaleBars
from jaxba.sfm.control._control import ControlPart, agreeing_marks, image_rows, intersect, mark_std


@dataclasses.dataclass(frozen=True, eq=False)
class BarEnds:
    """The ends of bars as a block has them.

    - `bars`: with the sigma of marks. `mark_used`: of theirs. `point_m`: of each end, NaN where it has no place.
    - `variance_m2`: of each, by its marks alone.
    """

    bars: ScaleBars
    mark_used: Bool[np.ndarray, " marks"]
    point_m: Float[np.ndarray, "ends 3"]
    variance_m2: Float[np.ndarray, "ends 3"]

    @staticmethod
    def of(block: Block, bars: ScaleBars, control: Control) -> "BarEnds":
        """Return the ends, their marks weighed as those of control are; by how they scatter where there is none."""
        ends, use = bars.ends, agreeing_marks(block, bars.ends)
        std_px = control.mark_std_px if control.num_points else mark_std(block, ends, use)
        ends = dataclasses.replace(ends, mark_std_px=std_px)
        use = agreeing_marks(block, ends) & (image_rows(block, ends) >= 0)
        found = intersect(block, ends, use)
        return BarEnds(dataclasses.replace(bars, ends=ends), use, found.point_m, found.variance_m2)

    @property
    def has_place(self) -> Bool[np.ndarray, " bars"]:
        """Whether both ends of a bar have one."""
        return np.isfinite(self.distance_m)

    @property
    def distance_m(self) -> Float[np.ndarray, " bars"]:
        return np.linalg.norm(self.point_m[self.bars.first] - self.point_m[self.bars.second], axis=1)

    def in_problem(
        self, problem: Problem, block: Block, use: Bool[np.ndarray, " bars"], known: Sequence[tuple[str, int]] = ()
    ) -> tuple[Problem, Int[np.ndarray, "used 2"]]:
        """Return a problem with the ends of some bars as further points, and the points of these bars.

        - `known`: labels of points that the problem has, and their numbers.
        """
        bars, number = self.bars, np.full(self.bars.ends.num_points, -1)
        of_label = dict(known)
        wanted = np.unique(np.concatenate([bars.first[use], bars.second[use]]))
        for end in wanted:
            number[end] = of_label.get(bars.ends.names[end], -1)
        new = wanted[number[wanted] < 0]
        number[new] = problem.num_points + np.arange(len(new))
        marks = np.flatnonzero(self.mark_used & np.isin(bars.ends.mark_point, new))
        seen, free = problem.observations, problem.free
        std = np.full(len(marks), bars.ends.mark_std_px)
        image = image_rows(block, bars.ends)[marks]
        observations = Observations(
            np.concatenate([seen.xy_px, bars.ends.mark_xy_px[marks]]),
            np.concatenate([seen.std_px, std]),
            np.concatenate([seen.image_index, image]).astype(np.int32),
            np.concatenate([seen.point_index, number[bars.ends.mark_point[marks]]]).astype(np.int32),
        )
        points = np.concatenate([np.asarray(free.points), np.ones(len(new), bool)])
        problem = dataclasses.replace(
            problem,
            points=np.concatenate([problem.points, self.point_m[new]]),
            observations=observations,
            free=Free(free.poses, points, free.intrinsics, free.lever_arm, free.position_offset),
        )
        return problem, np.stack([number[bars.first[use]], number[bars.second[use]]], axis=1)


def add_bars(
    problem: Problem,
    block: Block,
    bars: ScaleBars,
    use: Bool[np.ndarray, " bars"],
    control: Control,
    part: ControlPart | None,
) -> Problem:
    """Return the problem of a block with some of its scale bars; `part`: the control points that it has."""
    if not use.any():
        return problem
    rows = () if part is None else part.rows
    known = [(control.names[row], block.num_points + k) for k, row in enumerate(rows)]
    problem, points = BarEnds.of(block, bars, control).in_problem(problem, block, use, known)
    return with_scale_bars(problem, points[:, 0], points[:, 1], bars.length_m[use], bars.std_m[use])
