"""Where control points help most: places of n of them that lower the worst sigma over the area, by its gradient.

A control point at p is a measurement of where the block has that spot, y(p) = G(p) c + noise. With K = G_spots C and R
the noise of the marks and of the survey, n points turn the variances of the spots into

    diag(K G_spots^T) - diag(M S^-1 M^T),   M = K G(p)^T,   S = G(p) C G(p)^T + R

the update of a linear prediction, which differentiates by p as all of it is smooth. That their marks tie photos to
each other, too, is left out: a few among hundreds of tie points. The largest sigma is not smooth: its gradient is that
of a mean of a high power of the sigmas. The descent begins at the best places of a coarse grid, taken one after the
other and exchanged until none helps, and at places spread evenly.
"""

import functools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float

from jaxba._errors import JaxbaError
from jaxba.ba import fast_jit
from jaxba.design._ground import Ground
from jaxba.design._network import Network, spots_in
from jaxba.design._on_grid import POWER, OnGrid
from jaxba.design._views import Views

_CANDIDATES = 13  # along the longer side of the area
_LEAST_RAYS = 3.0  # of a place for a control point
_STEPS, _FIRST_STEP, _SHRINK, _LAST_STEP = 60, 0.1, 0.6, 1e-3  # steps are shares of the area's extent
MOST_POINTS = 40
"""Control points that can be placed at once."""
_STARTS = 3


@dataclass(frozen=True, eq=False)
class Placed:
    """Control points, and what they do.

    - `plan_m`: east and north of each. `worst_m`: largest sigma over the area with all of them; `before_m`: without.
    - `without_m`: largest sigma without each of them, which is what it is worth.
    - `typical_m`: median of the largest sigma of each spot, with all of them; `typical_before_m`: without.
    """

    plan_m: Float[np.ndarray, "points 2"]
    worst_m: float
    before_m: float
    without_m: Float[np.ndarray, " points"]
    typical_m: float
    typical_before_m: float


class _Given(eqx.Module):
    """What the sigmas follow from: `across` is K, `variance` that of the spots without more points."""

    views: Views
    ground: Ground
    covariance: Float[Array | np.ndarray, "unknowns unknowns"]
    across: Float[Array | np.ndarray, "coordinates unknowns"]
    variance: Float[Array | np.ndarray, " coordinates"]
    mark_variance: Float[Array | np.ndarray, ""]
    survey_variance: Float[Array | np.ndarray, "3"]


class _Reached(NamedTuple):
    plan_m: np.ndarray
    worst_m: float


@functools.lru_cache(maxsize=4)
def place_control(network: Network, count: int, std_m: tuple[float, float, float]) -> Placed:
    """Return where `count` more control points lower the largest sigma over the area most.

    - `std_m`: sigma of their surveyed coordinates, east, north, up.

    Raises `JaxbaError` where the count is none, or the photos see too little of the area.
    """
    if not 1 <= count <= MOST_POINTS:
        raise JaxbaError(f"{count} control points to place; give from 1 to {MOST_POINTS}.")
    given = _given(network, std_m)
    candidates = network.at(spots_in(network.area_m, _CANDIDATES))
    seen = candidates.rays >= _LEAST_RAYS
    if not seen.any():
        raise JaxbaError("no spot of the area is seen by three photos; overlap more, or fly over all of it.")
    candidates = network.at(candidates.xyz_m[seen, :2])
    places = candidates.xyz_m[:, :2]
    chosen = OnGrid(network, candidates, std_m).exchanged(count)
    starts = [places[chosen], *(_spread(places, count, turn) for turn in range(_STARTS))]
    reached = [_descended(given, network.area_m, start) for start in starts]
    best = min(reached, key=lambda each: each.worst_m)
    before, after = (_std(given, plan_m) for plan_m in (np.zeros((0, 2)), best.plan_m))
    without = [float(_std(given, np.delete(best.plan_m, k, axis=0)).max()) for k in range(count)]
    return Placed(
        best.plan_m, best.worst_m, float(before.max()), np.array(without), float(np.median(after)),
        float(np.median(before)),
    )  # fmt: skip


def _given(network: Network, std_m: Sequence[float]) -> _Given:
    spots = network.spots
    return _Given(
        network.views,
        network.ground,
        network.covariance,
        spots.across @ network.covariance,
        spots.std_m.reshape(-1) ** 2,
        np.array(network.mark_std_px**2),
        np.array(std_m, float) ** 2,
    )


def _variances(given: _Given, plan_m: Array) -> Array:
    """Return the variances of the spots' coordinates with control points at these places."""
    across, inverse, _ = given.views.spots(given.ground.at(plan_m))
    rows = across.reshape(-1, across.shape[2])
    mixed = given.across @ rows.T
    noise = given.mark_variance * inverse + jnp.diag(given.survey_variance)
    count = len(plan_m)
    blocks = jnp.zeros((count, 3, count, 3)).at[jnp.arange(count), :, jnp.arange(count)].set(noise)
    system = rows @ given.covariance @ rows.T + blocks.reshape(3 * count, -1)
    root = jnp.linalg.cholesky(system)
    half = jax.scipy.linalg.solve_triangular(root, mixed.T, lower=True)
    return jnp.asarray(given.variance) - jnp.sum(half**2, axis=0)


def _smooth_worst(given: _Given, plan_m: Array) -> tuple[Array, Array]:
    """Return nearly the largest sigma, and the largest itself."""
    variance = _variances(given, plan_m)
    most = jax.lax.stop_gradient(jnp.max(variance))
    return jnp.sqrt(most * jnp.mean((variance / most) ** POWER) ** (1 / POWER)), jnp.sqrt(most)


@fast_jit
def _slope(given: _Given, plan_m: Array) -> tuple[tuple[Array, Array], Array]:
    return jax.value_and_grad(_smooth_worst, argnums=1, has_aux=True)(given, plan_m)


def _std(given: _Given, plan_m: Float[np.ndarray, "points 2"]) -> Float[np.ndarray, " spots"]:
    """Return the largest sigma of each spot."""
    variance = np.asarray(given.variance)
    if len(plan_m):
        with jax.enable_x64(True):
            variance = np.asarray(_variances_of(given, plan_m))
    return np.sqrt(variance.reshape(-1, 3).max(axis=1))


_variances_of = fast_jit(_variances)


def _descended(given: _Given, area_m: Float[np.ndarray, "corners 2"], start: Float[np.ndarray, "points 2"]) -> _Reached:
    """Walk down the gradient within the area; a step that does not lower the smooth worst sigma is shortened."""
    import shapely

    area, extent = shapely.Polygon(area_m), float(np.max(np.ptp(area_m, axis=0)))

    def within(plan_m: np.ndarray) -> np.ndarray:
        points = shapely.points(plan_m)
        nearest = shapely.get_coordinates(shapely.shortest_line(area, points)).reshape(-1, 2, 2)[:, 0]
        return np.where(np.asarray(shapely.intersects(area, points))[:, None], plan_m, nearest)

    with jax.enable_x64(True):
        at, step = within(start), _FIRST_STEP * extent
        (value, worst), gradient = _slope(given, at)
        best = _Reached(at, float(worst))
        for _ in range(_STEPS):
            length = np.linalg.norm(gradient, axis=1).max()
            if not length > 0 or step < _LAST_STEP * extent:
                break
            tried = within(at - step * np.asarray(gradient) / length)
            (new_value, new_worst), new_gradient = _slope(given, tried)
            if new_value < value:
                at, value, gradient = tried, new_value, new_gradient
                best = min(best, _Reached(at, float(new_worst)), key=lambda each: each.worst_m)
            else:
                step *= _SHRINK
    return best


def _spread(places: Float[np.ndarray, "places 2"], count: int, turn: int) -> Float[np.ndarray, "points 2"]:
    """Return places spread evenly: each as far as can be from those before, the first by `turn`."""
    angle = 2 * np.pi * turn / _STARTS
    middle = places.mean(axis=0)
    chosen = [int(np.argmax((places - middle) @ [np.cos(angle), np.sin(angle)]))]
    while len(chosen) < count:
        away = np.min(np.linalg.norm(places[:, None] - places[chosen], axis=2), axis=1)
        chosen.append(int(np.argmax(away)))
    return places[chosen]
