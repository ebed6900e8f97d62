"""Tiles: many problems at once, and one block cut into parts: exact adjustment part by part in bounded memory."""

from jaxba.ba.tiles._batch import solve_batch
from jaxba.ba.tiles._partition import BlockTile, Partition, partition
from jaxba.ba.tiles._solve_tiled import solve_tiled

__all__ = ["BlockTile", "Partition", "partition", "solve_batch", "solve_tiled"]
