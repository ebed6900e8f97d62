"""A block as an instrument: how well it would place any spot of the ground, before a pixel is measured."""

import functools
from dataclasses import dataclass

import jax
import numpy as np
from jax import Array
from jaxtyping import Float

from jaxba.ba import Problem, camera_covariance, fast_jit
from jaxba.design._ground import Ground
from jaxba.design._photos import Photos
from jaxba.design._views import Views, views_of
from jaxba.geometry import AbstractLoss

_GRID = 9  # spots along each side of the area


@dataclass(frozen=True, eq=False)
class Network:
    """A block with its adjustment problem, which stands at its solution.

    - `area_m`: corners of what is to be mapped. `mark_std_px`: sigma of a mark in a photo.
    - `loss`: of the problem's observations; None for least squares.
    """

    photos: Photos
    ground: Ground
    problem: Problem
    area_m: Float[np.ndarray, "corners 2"]
    mark_std_px: float
    loss: AbstractLoss | None = None

    @functools.cached_property
    def covariance(self) -> Float[np.ndarray, "unknowns unknowns"]:
        """Joint covariance of poses and intrinsics; `JaxbaError` where nothing determines them."""
        return camera_covariance(self.problem, loss=self.loss)

    @functools.cached_property
    def views(self) -> Views:
        return views_of(self.photos)

    @functools.cached_property
    def spots(self) -> "Spots":
        """Spots over the area: a grid, and its corners."""
        return self.at(spots_in(self.area_m, _GRID))

    def at(self, plan_m: Float[np.ndarray, "spots 2"]) -> "Spots":
        """Return places of the ground, and how errors of the block reach them."""
        with jax.enable_x64(True):
            xyz_m, across, inverse, rays = (np.asarray(part) for part in _at(self.views, self.ground, plan_m))
        moved = across.reshape(-1, across.shape[2])
        joint = moved @ self.covariance @ moved.T
        return Spots(xyz_m, rays, moved, joint, self.mark_std_px**2 * inverse)

    @property
    def focal_std_px(self) -> float:
        """Largest sigma of a focal length, pixels; zero where all are fixed."""
        first = 6 * self.photos.num
        variance = np.diagonal(self.covariance)[first:].reshape(np.shape(self.views.intrinsics))
        names = self.photos.cameras.parameter_names()
        return float(np.sqrt(variance[:, [n in ("f", "fx", "fy") for n in names]].max()))

    @functools.cached_property
    def position_std_m(self) -> Float[np.ndarray, "images 3"]:
        """Sigmas of the cameras' positions, east, north, up."""
        steps = 6 * np.arange(self.photos.num)[:, None] + np.arange(3, 6)
        rotation = self.photos.cam_from_world
        of_steps = self.covariance[steps[:, :, None], steps[:, None]]
        return np.sqrt(np.einsum("nji,njk,nki->ni", rotation, of_steps, rotation))


@dataclass(frozen=True, eq=False)
class Spots:
    """Places of the ground, as a block would have them from marks in all photos that show them.

    - `xyz_m`: true places. `rays`: photos that show each, those at their edges in part.
    - `across`: what poses and intrinsics do to each coordinate, as `camera_covariance` orders them.
    - `joint_m2`: covariance of all of them that errors of the block cause, east, north, up of each in turn.
    - `noise_m2`: what errors of its own marks add to each.
    """

    xyz_m: Float[np.ndarray, "spots 3"]
    rays: Float[np.ndarray, " spots"]
    across: Float[np.ndarray, "coordinates unknowns"]
    joint_m2: Float[np.ndarray, "coordinates coordinates"]
    noise_m2: Float[np.ndarray, "spots 3 3"]

    @property
    def std_m(self) -> Float[np.ndarray, "spots 3"]:
        """Sigmas, east, north, up."""
        noise = np.diagonal(self.noise_m2, axis1=1, axis2=2)
        return np.sqrt(np.diagonal(self.joint_m2).reshape(-1, 3) + noise)


def spots_in(area_m: Float[np.ndarray, "corners 2"], count: int) -> Float[np.ndarray, "spots 2"]:
    """Return spots of a grid over an area that lie in it, `count` along the longer side, and its corners.

    >>> square = np.array([[0.0, 0.0], [4.0, 0.0], [4.0, 4.0], [0.0, 4.0]])
    >>> len(spots_in(square, 3))
    9
    """
    import shapely

    low, high = area_m.min(axis=0), area_m.max(axis=0)
    step = float(np.max(high - low)) / (count - 1)
    counts = np.maximum(np.round((high - low) / step).astype(int) + 1, 2)
    grid = np.stack(np.meshgrid(*(np.linspace(a, b, n) for a, b, n in zip(low, high, counts, strict=True))), axis=-1)
    places = grid.reshape(-1, 2)
    area = shapely.Polygon(area_m)
    inside = places[shapely.distance(area, shapely.points(places)) < 1e-6 * step]
    own = [c for c in area_m if not len(inside) or np.min(np.linalg.norm(inside - c, axis=1)) > step / 2]
    return np.concatenate([inside, np.array(own).reshape(-1, 2)])


@fast_jit
def _at(views: Views, ground: Ground, plan_m: Array) -> tuple[Array, Array, Array, Array]:
    xyz_m = ground.at(plan_m)
    return (xyz_m, *views.spots(xyz_m))
