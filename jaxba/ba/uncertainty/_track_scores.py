"""What single tracks do to the shared unknowns: the compiled part of covariances by tracks.

A blurred or slanted feature is measured worse in all its images, so that its errors are not those of others. With only
tracks taken for independent (Liang and Zeger 1986) the part of the observations in the covariance of the shared
unknowns, A = sum over observations of k k^T, becomes

    M = sum over tracks of u u^T / f,    u = sum over the track's observations of k r,    k = C J^T

with J and r as the loss weighs them, C the covariances of the shared unknowns with what an observation depends on, and
f = sum r^2 / sum (2 n - 3) over tracks of n views (2 n of a fixed point): M is A where all errors are alike, however
large. As C N = 1, the scores u of a track hold nothing of its own point, whose freedom its residuals lack.

M is a sum of squares and errs. What is added to the covariance is therefore not M - A but the share of it that is no
chance (Ledoit and Wolf 2004, toward A), with the sizes of matrices measured by the covariance C of the shared unknowns,
|X|^2 = tr(C^-1 X C^-1 X):

    1 - b^2 / |M - A|^2,    b^2 = sum over tracks of |u u^T / f|^2 - |M|^2 / tracks
"""

from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float

from jaxba.ba._linearise import masked_columns, scan_chunks
from jaxba.ba._reweighting import reweighting
from jaxba.ba._rows import rows_of, segments
from jaxba.ba._system import System
from jaxba.ba._unknowns import Unknowns
from jaxba.ba.groups import Reprojection
from jaxba.ba.uncertainty._point_marginals import InverseBlocks, Joint


class TrackSums(NamedTuple):
    """Sums over the tracks of a tile, or of all.

    - `scores`: of u u^T. `fourth`: of |u u^T|^2. `alike`: A. `squared`: of r^2. `freedom`: of 2 n - 3. `tracks`: of 1.
    """

    scores: Float[Array | np.ndarray, "border border"]
    fourth: Float[Array | np.ndarray, ""]
    alike: Float[Array | np.ndarray, "border border"]
    squared: Float[Array | np.ndarray, ""]
    freedom: Float[Array | np.ndarray, ""]
    tracks: Float[Array | np.ndarray, ""]

    def by_tracks(self, corner: Float[np.ndarray, "border border"]) -> Float[np.ndarray, "border border"]:
        """Return what is to be added to the covariance of the shared unknowns, which is `corner`."""
        alike = np.asarray(self.alike)
        if not (self.freedom > 0 and self.squared > 0):
            return np.zeros(alike.shape)
        factor = float(self.freedom / self.squared)
        found = factor * np.asarray(self.scores)
        unit, inverse = _unit_and_inverse(corner, np)

        def square(matrix: Float[np.ndarray, "border border"]) -> float:
            product = inverse @ (matrix / np.outer(unit, unit))
            return float(np.sum(product * product.T))

        chance = factor**2 * float(self.fourth) - square(found) / float(self.tracks)
        more, all_of_it = found - alike, square(found - alike)
        return more * max(1 - chance / all_of_it, 0.0) if all_of_it > 0 else np.zeros(alike.shape)


def _unit_and_inverse(corner: Any, xp: Any) -> tuple[Any, Any]:
    """Return the sigmas of the shared unknowns and the inverse of their correlations; what is fixed has zeros in it.

    - `corner`: the covariance of the shared unknowns. `xp`: numpy or `jax.numpy`, whichever its arrays are of.
    """
    variance = xp.diagonal(corner)
    unit = xp.where(variance > 0, xp.sqrt(xp.abs(variance)), 1.0)
    return unit, xp.linalg.pinv(corner / xp.outer(unit, unit), hermitian=True)


def track_sums(system: System, unknowns: Unknowns, inverse: InverseBlocks, joint: Joint) -> TrackSums:
    """Return the sums over the tracks of a system; `inverse`, `joint`: of its equations at the same unknowns."""
    shape = system.shape
    columns, k = 6 + shape.num_refined, shape.num_refined
    place = None
    if not shape.own_cameras and k:
        place = jnp.asarray(system.reprojection.camera_index)[:, None] * k + jnp.arange(k)
    corner, of_images = jnp.asarray(inverse.corner), jnp.asarray(inverse.border)

    def body(carry: tuple[Array, ...], part: Reprojection) -> tuple[tuple[Array, ...], tuple[()]]:
        scores, views, alike, squared = carry
        rows = part.rows(unknowns, lambda residual: reweighting(residual, system.loss, jnp.zeros(())))
        rows = masked_columns(rows, part, system)
        residual, by_point = rows[:, :, columns], rows[:, :, columns + 1 :]
        by_image = rows[:, :, : shape.block]
        pull = jnp.einsum("rcal,rab->rlcb", by_image, rows_of(of_images, part.run_image))
        if place is not None:
            on_border = rows_of(corner, rows_of(place, part.run_image))
            pull += jnp.einsum("rckl,rkb->rlcb", rows[:, :, 6:columns], on_border)
        pull += jnp.einsum("rcil,rlib->rlcb", by_point, rows_of(joint.with_border, part.point_index))
        index = part.point_index.reshape(-1)
        of_rows = jnp.einsum("rlcb,rcl->rlb", pull, residual).reshape(len(index), -1)
        seen = (jnp.asarray(part.weight) > 0).reshape(-1).astype(views.dtype)
        flat = pull.reshape(2 * len(index), pull.shape[-1])
        return (
            scores + segments(of_rows, index, shape.num_points),
            views + segments(seen, index, shape.num_points),
            alike + flat.T @ flat,
            squared + jnp.sum(residual**2),
        ), ()

    unit, of_correlations = _unit_and_inverse(corner, jnp)
    dtype = unknowns.points.dtype
    start = (
        jnp.zeros((shape.num_points, shape.border), dtype),
        jnp.zeros(shape.num_points, dtype),
        jnp.zeros((shape.border, shape.border), dtype),
        jnp.zeros((), dtype),
    )
    (scores, views, alike, squared), _ = scan_chunks(system, body, start)
    freedom = jnp.sum(jnp.maximum(2 * views - 3 * jnp.asarray(system.free.points)[:, 0], 0.0))
    scaled = scores / unit
    fourth = jnp.sum(jnp.sum((scaled @ of_correlations) * scaled, axis=1) ** 2)
    tracks = jnp.sum(views > 0).astype(dtype)
    return TrackSums(scores.T @ scores, fourth, alike, squared, freedom, tracks)
