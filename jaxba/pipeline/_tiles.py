"""The section of the settings on tiles: what a run solves a large block in, and `jaxba partition` cuts one into.

A run's tiles make up the block again: its answer is that of one piece but for rounding. So they have no overlap.
"""

from dataclasses import dataclass

from jaxba.engine._parameters import Parameters, parameter


@dataclass(frozen=True, kw_only=True)
class Tiles(Parameters):
    """How a run cuts a block, and `jaxba partition` where its options say nothing else."""

    chunk_size: int = parameter(
        500,
        low=100,
        high=5000,
        help="images of its own that a tile has at most; a run solves a block of more images in tiles, to the same "
        "answer in less memory",
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
