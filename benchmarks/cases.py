"""The problems that are timed: two of Bundle Adjustment in the Large, and synthetic UAV blocks with one camera each."""

import dataclasses
from collections.abc import Callable, Sequence
from pathlib import Path

from jaxba.ba import Problem
from jaxba.geometry import AbstractLoss, Huber, Linear
from jaxba.io import read_bal
from jaxba.simulation import uav_block

BAL_FOLDER = Path(__file__).parents[2] / "shared" / "data" / "bal"
_BAL_FILES = {"bal21": "problem-21-11315-pre.txt", "bal49": "problem-49-7776-pre.txt"}


@dataclasses.dataclass(frozen=True)
class Case:
    """A problem, made when it is asked for, and the loss of its observations."""

    name: str
    make: Callable[[], Problem]
    loss: AbstractLoss


def speed_cases(sizes: Sequence[int]) -> dict[str, Case]:
    """Return BAL's two, linear and with Huber, and blocks of these numbers of images, without and with outliers."""
    cases = []
    for name, file in _BAL_FILES.items():
        if (BAL_FOLDER / file).exists():
            cases.append(Case(name, lambda file=file: read_bal(BAL_FOLDER / file), Linear()))
            cases.append(Case(f"{name}_huber", lambda file=file: read_bal(BAL_FOLDER / file), Huber(1.0)))
    for size in sizes:
        cases.append(Case(f"uav{size}", lambda size=size: uav_block(size).problem, Linear()))
        cases.append(
            Case(
                f"uav{size}_outliers",
                lambda size=size: uav_block(size, outlier_fraction=0.02).problem,
                Huber(1.0),
            )
        )
    return {case.name: case for case in cases}
