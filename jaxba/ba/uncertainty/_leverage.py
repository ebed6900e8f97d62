"""Leverage of measurements: how far the adjustment follows each of them, the compiled part of `_statistics.py`.

A row's prediction depends on its image and camera by A and on its point by C, over the row's sigmas. With the
covariances Q of image and camera, P of the point and X of the point with these,

    leverage = A Q A^T + C P C^T + C X A^T + (C X A^T)^T       reach = P C^T + X A^T

that is the covariance of the predictions in units of the measurements', and that of the point's position with the
predictions. Of a row on an image alone the reach is that of the camera's position.
"""

import dataclasses
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float

from jaxba.ba._linearise import masked_columns, refined_columns, scan_chunks
from jaxba.ba._priors import robust_rows
from jaxba.ba._problem import AbstractPrior
from jaxba.ba._rows import JacobianBlock, rows_of
from jaxba.ba._system import System
from jaxba.ba._unknowns import Unknowns
from jaxba.ba.groups import Reprojection
from jaxba.ba.uncertainty._point_marginals import InverseBlocks, Joint
from jaxba.geometry import Linear


class Leverage(NamedTuple):
    """Rows of a group; residuals over their sigmas, without any robust loss.

    - `leverage`: covariance of a row's predictions over its sigmas. `reach`: of a position, in metres, with these: that
      of the point, or of the camera of a row without a point; zero of a row with neither.
    """

    residual: Float[Array | np.ndarray, "rows components"]
    leverage: Float[Array | np.ndarray, "rows components components"]
    reach: Float[Array | np.ndarray, "rows 3 components"]


def pixel_leverage(system: System, unknowns: Unknowns, inverse: InverseBlocks, joint: Joint) -> Leverage:
    """Return that of the reprojections.

    - `inverse`, `joint`: of the equations that the adjustment weighed its rows in, at the same unknowns.
    """
    return _of_reprojections(system, unknowns, _of_images(system, inverse), joint)


def prior_leverages(
    system: System, unknowns: Unknowns, inverse: InverseBlocks, of_points: Float[Array | np.ndarray, "points 3 3"]
) -> tuple[Leverage, ...]:
    """Return those of each prior; `of_points`: the points' covariances."""
    of_images, points = _of_images(system, inverse), jnp.asarray(of_points)
    return tuple(_of_prior(system, prior, unknowns, inverse, of_images, points) for prior in system.priors)


def _of_images(system: System, inverse: InverseBlocks) -> Float[Array, "images columns columns"]:
    """Return the covariance of each image's pose and its camera's refined intrinsics."""
    if system.shape.own_cameras or not system.shape.num_refined:
        return jnp.asarray(inverse.diagonal)
    place = _shared_columns(system)
    across = jnp.take_along_axis(jnp.asarray(inverse.border), place[:, None, :], axis=2)
    corner = jnp.asarray(inverse.corner)[place[:, :, None], place[:, None, :]]
    above = jnp.concatenate([inverse.diagonal, across], axis=2)
    return jnp.concatenate([above, jnp.concatenate([jnp.swapaxes(across, 1, 2), corner], axis=2)], axis=1)


def _shared_columns(system: System) -> Array:
    """Return where the refined intrinsics of each image's camera stand in the border."""
    k = system.shape.num_refined
    return jnp.asarray(system.reprojection.camera_index)[:, None] * k + jnp.arange(k)


def _of_reprojections(
    system: System, unknowns: Unknowns, of_images: Float[Array, "images columns columns"], joint: Joint
) -> Leverage:
    columns = of_images.shape[1]
    place = None if system.shape.own_cameras or not system.shape.num_refined else _shared_columns(system)

    def body(carry: tuple[()], part: Reprojection, with_image: Array) -> tuple[tuple[()], Leverage]:
        rows = masked_columns(part.rows(unknowns), part, system)
        residual, by_image, by_point = rows[:, :, columns], rows[:, :, :columns], rows[:, :, columns + 1 :]
        across = with_image
        if place is not None:
            on_border = rows_of(joint.with_border, part.point_index)
            at = jnp.broadcast_to(rows_of(place, part.run_image)[:, None, None], (*on_border.shape[:3], place.shape[1]))
            across = jnp.concatenate([across, jnp.take_along_axis(on_border, at, axis=3)], axis=3)
        reach = jnp.einsum("rlij,rcjl->rlic", rows_of(joint.points, part.point_index), by_point)
        reach += jnp.einsum("rlia,rcal->rlic", across, by_image)
        on_image = jnp.einsum("rab,rcbl->rlac", rows_of(of_images, part.run_image), by_image)
        on_image += jnp.einsum("rlia,rcil->rlac", across, by_point)
        leverage = jnp.einsum("rcil,rlid->rlcd", by_point, reach) + jnp.einsum("rcal,rlad->rlcd", by_image, on_image)
        return carry, Leverage(jnp.moveaxis(residual, 1, 2), leverage, reach)

    _, found = scan_chunks(system, body, (), jnp.asarray(joint.with_images))
    return Leverage(*(of_runs.reshape(-1, *of_runs.shape[2:]) for of_runs in found))


def _of_prior(
    system: System,
    prior: AbstractPrior,
    unknowns: Unknowns,
    inverse: InverseBlocks,
    of_images: Float[Array, "images columns columns"],
    of_points: Float[Array, "points 3 3"],
) -> Leverage:
    """Return those of a prior, whose rows touch one kind of unknowns, or a pose and the antenna.

    Of rows that touch a point and the antenna, as scale bars do, none of the components that depend on the point: these
    tie the one to the other, and measure nothing.
    """
    plain = dataclasses.replace(prior, loss=Linear())
    rows = robust_rows(system, plain, unknowns, jnp.zeros(()))
    residual = jnp.asarray(rows.residual).T
    count, components = residual.shape
    reach = jnp.zeros((count, 3, components), residual.dtype)
    leverage = jnp.zeros((count, components, components), residual.dtype)
    border = inverse.corner.shape[0]
    antenna = slice(border - system.shape.antenna, border)
    measures = jnp.ones((count, components), bool)
    if rows.point is not None and rows.antenna is not None:
        measures = jnp.all(rows.point.jacobian == 0, axis=1).T
    elif rows.point is not None:
        reach = jnp.einsum("nij,cjn->nic", rows_of(of_points, rows.point.index), rows.point.jacobian)
        leverage += jnp.einsum("cin,nid->ncd", rows.point.jacobian, reach)
    if rows.intrinsics is not None:
        leverage += _of_intrinsics(system, rows.intrinsics, inverse, of_images)
    if rows.pose is not None:
        index, by_pose = rows.pose.index, rows.pose.jacobian
        on_pose = jnp.einsum("nab,cbn->nac", rows_of(of_images[:, :6, :6], index), by_pose)
        if rows.antenna is not None and system.shape.antenna:
            across = rows_of(jnp.asarray(inverse.border)[:, :6, antenna], index)
            on_pose += jnp.einsum("nai,cin->nac", across, rows.antenna)
            leverage += jnp.einsum("cin,nai,dan->ncd", rows.antenna, across, by_pose)
        leverage += jnp.einsum("can,nad->ncd", by_pose, on_pose)
        rotation = rows_of(unknowns.poses.rotation, index)
        reach = jnp.einsum("nji,njc->nic", rotation, on_pose[:, 3:])
    if rows.antenna is not None and system.shape.antenna:
        of_antenna = jnp.asarray(inverse.corner)[antenna, antenna]
        leverage += jnp.einsum("cin,ij,djn->ncd", rows.antenna, of_antenna, rows.antenna)
        leverage *= measures[:, :, None] & measures[:, None]
    return Leverage(residual, leverage, reach)


def _of_intrinsics(
    system: System, block: JacobianBlock, inverse: InverseBlocks, of_images: Float[Array, "images columns columns"]
) -> Float[Array, "rows components components"]:
    shape, k = system.shape, system.shape.num_refined
    by_refined = block.jacobian[:, refined_columns(system)]
    if shape.own_cameras:  # numbered as the images are
        of_rows = rows_of(of_images[:, 6:, 6:], block.index)
    else:
        place = jnp.asarray(block.index)[:, None] * k + jnp.arange(k)
        of_rows = jnp.asarray(inverse.corner)[place[:, :, None], place[:, None, :]]
    return jnp.einsum("can,nab,dbn->ncd", by_refined, of_rows, by_refined)
