"""The section of the settings on tiles: what `jaxba partition` cuts the block of a project into.

A run itself adjusts its block whole. So another value is taken, makes no stage stale, and changes no result of a run.
"""

from dataclasses import dataclass

from jaxba.engine._parameters import Parameters, parameter


@dataclass(frozen=True, kw_only=True)
class Tiles(Parameters):
    """How `jaxba partition` cuts a block where its options say nothing else."""

    chunk_size: int = parameter(
        500,
        low=100,
        high=5000,
        help="for jaxba partition (a run solves its block whole): images of its own that a tile has at most; more are "
        "consistent in themselves, and take more memory",
    )
    overlap: int = parameter(
        50,
        low=10,
        high=1500,
        help="for jaxba partition: images that a tile takes over from its neighbours; more tie it better to them, and "
        "are solved twice",
    )
    max_observations: float | None = parameter(
        None,
        low=1e4,
        help="for jaxba partition: observations of a tile's own images, in place of chunk_size; memory goes by them",
    )
    by: str = parameter(
        "space",
        choices=("space", "flight-line"),
        help="for jaxba partition: cut where few images see across, or at the ends of flight lines",
    )
