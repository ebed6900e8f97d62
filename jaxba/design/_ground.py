"""The ground under a block: heights on a grid, between which they are linear."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.scipy.ndimage import map_coordinates
from jaxtyping import Float

from jaxba.simulation import Terrain

_CELLS = 48  # of the longer side


class Ground(eqx.Module):
    """- `low_m`: east and north of the first cell. `step_m`: between cells. `height_m`: rows go north."""

    low_m: Float[Array | np.ndarray, "2"]
    step_m: Float[Array | np.ndarray, ""]
    height_m: Float[Array | np.ndarray, "rows columns"]

    def at(self, plan_m: Float[Array | np.ndarray, "n 2"]) -> Float[Array, "n 3"]:
        """Return east, north, up of places; beyond the grid its rim goes on level."""
        column, row = ((jnp.asarray(plan_m) - self.low_m) / self.step_m).T
        height = map_coordinates(jnp.asarray(self.height_m), [row, column], order=1, mode="nearest")
        return jnp.column_stack([plan_m, height])


def ground_of_terrain(terrain: Terrain, low_m: Float[np.ndarray, "2"], high_m: Float[np.ndarray, "2"]) -> Ground:
    """Return the ground of a terrain between two corners."""
    places, shape, step = _cells(low_m, high_m)
    return Ground(low_m, np.array(step), terrain(places).reshape(shape))


def ground_of_points(points_m: Float[np.ndarray, "points 3"]) -> Ground:
    """Return the ground that points lie on: the median height of the nearest ones to each cell."""
    from scipy.spatial import KDTree

    plan = points_m[:, :2]
    low, high = np.quantile(plan, 0.005, axis=0), np.quantile(plan, 0.995, axis=0)
    places, shape, step = _cells(low, high)
    _, near = KDTree(plan).query(places, k=min(9, len(plan)))
    height = np.median(points_m[near.reshape(len(places), -1), 2], axis=1)
    return Ground(low, np.array(step), height.reshape(shape))


def _cells(
    low: Float[np.ndarray, "2"], high: Float[np.ndarray, "2"]
) -> tuple[Float[np.ndarray, "cells 2"], tuple[int, int], float]:
    """Return the places of cells, row by row northwards, how many rows and columns, and the step."""
    step = float(max(np.max(high - low), 1e-3)) / (_CELLS - 1)
    columns, rows = (np.ceil((high - low) / step).astype(int) + 1).tolist()
    north, east = np.mgrid[0:rows, 0:columns]
    return low + step * np.column_stack([east.ravel(), north.ravel()]), (rows, columns), step
