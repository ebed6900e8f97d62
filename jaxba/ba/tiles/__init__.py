"""Tiles: a block cut into parts, its exact adjustment part by part in bounded memory."""

from jaxba.ba.tiles._solve_tiled import solve_tiled

__all__ = ["solve_tiled"]
