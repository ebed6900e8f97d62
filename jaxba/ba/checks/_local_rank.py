"""Local rank: images and cameras that their own measurements do not determine, even if all points were known.

With the points held, a pose stands in the rows of its own image alone, and a camera's intrinsics in those of its
images. A null direction of these rows is one of the whole problem's. One point gives a pose two rows, two give four,
and points on one line five; position and attitude priors add theirs. Losses do not count, nor do sigmas unless they
are infinite.

**Poses.** The camera model changes no rank, so rows are taken on the sphere: with u the unit ray and d the distance to
a point, a step (w, v) turns the ray by P (w x u + v / d), `P = I - u u^T`, and

    J^T J = sum of [ P            [u]_x / d ]
                   [ [u]_x^T / d  P / d^2   ]

**Intrinsics.** With J an image's rows by its pose and K by the intrinsics, the poses are eliminated:

    S = sum over images of K^T K - K^T J (J^T J)^+ J^T K,  and the rows of priors on intrinsics

Cost: 500k observations take 60 ms for the poses. Of each camera a few images with the most observations are looked at
for its intrinsics, which takes 50 ms; where they leave something open, all of them.
"""

import dataclasses

import jax
import numpy as np
from jaxtyping import Bool, Float, Int

from jaxba.ba._problem import AbstractPrior, Problem
from jaxba.ba._projection import project_in_cameras
from jaxba.ba._unknowns import Unknowns
from jaxba.ba.checks._connected_parts import hat
from jaxba.ba.checks._gauge import prior_rows
from jaxba.geometry import AbstractCamera

_NULL = 1e-12  # eigenvalue over the largest, as for the gauge
_FEW_IMAGES, _FEW_ROWS = 8, 40  # of each camera that are looked at first: images, observations of each
_MOST_ROWS = 200
_NAMED = 1e-3  # smaller components of a null direction are of rounding
_STEP = 1e-5  # relative, of differences
_PIECE = 500_000  # observations, some 150 bytes each, that are worked on at a time


def pose_ranks(
    problem: Problem, kept: Int[np.ndarray, " kept"], point_in_cam: Float[np.ndarray, "3 observations"]
) -> Int[np.ndarray, " images"]:
    """Return how many of the six directions of each pose its image's observations and priors determine.

    - `kept`: the observations that count. `point_in_cam`: of every observation.
    """
    image = np.asarray(problem.observations.image_index)
    blocks, scale = _pose_blocks(image, point_in_cam, kept, problem.num_images)
    ranks = _ranks(blocks)
    if (ranks < 6).any():
        ranks = _ranks(blocks + _pose_priors(problem, scale))
    return ranks


def undetermined_intrinsics(
    problem: Problem, kept: Int[np.ndarray, " kept"], point_in_cam: Float[np.ndarray, "3 observations"]
) -> Bool[np.ndarray, "cameras parameters"]:
    """Return True for each free intrinsic that takes part in a direction which nothing determines.

    Cameras without observations have none.
    """
    free = np.asarray(problem.free.intrinsics)
    found = np.zeros(free.shape, bool)
    image = np.asarray(problem.observations.image_index)[kept]
    counts = np.bincount(image, minlength=problem.num_images)
    camera_of_image = np.asarray(problem.camera_index)
    seen = np.bincount(camera_of_image, counts, problem.num_cameras) > 0
    suspects = np.flatnonzero(free.any(axis=1) & seen)
    order = np.argsort(image, kind="stable")
    first = np.cumsum(counts) - counts
    for num_images, num_rows in ((_FEW_IMAGES, _FEW_ROWS), (problem.num_images, _MOST_ROWS)):
        if not len(suspects):
            break
        chosen = _most_seen(counts, camera_of_image, suspects, num_images)
        rows = min(num_rows, int(counts[chosen].max(initial=0)))
        spread = np.arange(rows) * counts[chosen][:, None] / max(rows, 1)
        some = np.minimum(spread.astype(int), counts[chosen][:, None] - 1)  # a repeated row changes no rank
        observation = kept[order[first[chosen][:, None] + some]]
        is_last = num_rows == _MOST_ROWS
        null = _null_parameters(problem, chosen, observation, point_in_cam, with_priors=is_last)
        suspects = suspects[null[suspects].any(axis=1)]
        if is_last:
            found[suspects] = null[suspects]
    return found


def _pose_blocks(
    image: Int[np.ndarray, " observations"],
    point: Float[np.ndarray, "3 observations"],
    kept: Int[np.ndarray, " kept"],
    count: int,
) -> tuple[Float[np.ndarray, "images 6 6"], Float[np.ndarray, " images"]]:
    """Return each image's block, translations in units of its distance to the points, and that distance."""
    pieces = [kept[start : start + _PIECE] for start in range(0, len(kept), _PIECE)]
    number, inverse_squares = np.zeros((2, count))
    for rows in pieces:
        number += np.bincount(image[rows], minlength=count)
        inverse_squares += np.bincount(image[rows], _distance(point[:, rows]) ** -2.0, count)
    inverse = np.sqrt(inverse_squares / np.maximum(number, 1))
    scale = np.where(inverse > 0, 1 / np.where(inverse > 0, inverse, 1.0), 1.0)
    blocks, turns = np.zeros((count, 6, 6)), np.zeros((count, 3))
    for rows in pieces:
        here, distance = image[rows], _distance(point[:, rows])
        near, ray = scale[here] / distance, point[:, rows] / distance
        for i in range(3):
            for j in range(i, 3):
                across = float(i == j) - ray[i] * ray[j]
                blocks[:, i, j] += np.bincount(here, across, count)
                blocks[:, 3 + i, 3 + j] += np.bincount(here, across * near**2, count)
            turns[:, i] += np.bincount(here, ray[i] * near, count)
    blocks += np.swapaxes(np.triu(blocks, 1), 1, 2)
    cross = hat(turns)
    blocks[:, :3, 3:], blocks[:, 3:, :3] = cross, np.swapaxes(cross, 1, 2)
    return blocks, scale


def _distance(point: Float[np.ndarray, "3 n"]) -> Float[np.ndarray, " n"]:
    return np.maximum(np.linalg.norm(point, axis=0), np.finfo(float).tiny)


def _ranks(blocks: Float[np.ndarray, "n k k"]) -> Int[np.ndarray, " n"]:
    values = np.linalg.eigvalsh(blocks)
    return np.count_nonzero(values > _NULL * np.maximum(values[:, -1:], np.finfo(float).tiny), axis=1)


def _pose_priors(problem: Problem, scale: Float[np.ndarray, " images"]) -> Float[np.ndarray, "images 6 6"]:
    """Return J^T J of all priors by each pose, every row of length one: whether it is there counts, not its sigma."""
    blocks = np.zeros((problem.num_images, 6, 6))
    for prior in problem.priors:
        index = getattr(prior, "image_index", None)
        rows = None if index is None else prior_rows(prior, problem)
        if index is None or rows is None or rows.pose is None:
            continue
        jacobian = np.moveaxis(np.asarray(rows.pose.jacobian), 2, 0).copy()
        jacobian[:, :, 3:] *= scale[np.asarray(index)][:, None, None]
        np.add.at(blocks, np.asarray(index), _gram(_unit(jacobian)))
    return blocks


def _unit(rows: Float[np.ndarray, "n rows columns"]) -> Float[np.ndarray, "n rows columns"]:
    length = np.linalg.norm(rows, axis=2, keepdims=True)
    return rows / np.where(length > 0, length, 1.0)


def _gram(rows: Float[np.ndarray, "n rows columns"]) -> Float[np.ndarray, "n columns columns"]:
    return np.swapaxes(rows, 1, 2) @ rows


def _most_seen(
    counts: Int[np.ndarray, " images"], camera: Int[np.ndarray, " images"], cameras: Int[np.ndarray, " c"], most: int
) -> Int[np.ndarray, " chosen"]:
    """Return the images of these cameras with the most observations, at most so many of each camera."""
    order = np.lexsort((-counts, camera))
    order = order[np.isin(camera[order], cameras) & (counts[order] > 0)]
    begins = np.flatnonzero(np.diff(camera[order], prepend=-1))
    place = np.arange(len(order)) - np.repeat(begins, np.diff(begins, append=len(order)))
    return order[place < most]


def _null_parameters(
    problem: Problem,
    images: Int[np.ndarray, " chosen"],
    observation: Int[np.ndarray, "chosen rows"],
    point_in_cam: Float[np.ndarray, "3 observations"],
    *,
    with_priors: bool,
) -> Bool[np.ndarray, "cameras parameters"]:
    """Return the free intrinsics in null directions of S, from these observations of these images."""
    free = np.asarray(problem.free.intrinsics)
    camera = np.asarray(problem.camera_index)[images]
    of_pose, of_intrinsics = _rows(problem, camera, point_in_cam[:, observation])
    of_intrinsics = of_intrinsics * free[camera][:, None]
    scale = np.sqrt(np.mean(np.sum(of_pose[:, :, 3:] ** 2, axis=2), axis=1))
    of_pose[:, :, 3:] /= np.where(scale > 0, scale, 1.0)[:, None, None]
    of_pose *= np.asarray(problem.free.poses)[images][:, None, None]
    pose, cross = _gram(of_pose), np.swapaxes(of_pose, 1, 2) @ of_intrinsics
    if with_priors:
        of_image = np.ones(problem.num_images)
        of_image[images] = 1 / np.where(scale > 0, scale, 1.0)
        priors = _pose_priors(problem, of_image)
        pose += np.trace(pose, axis1=1, axis2=2)[:, None, None] * priors[images]
    inverse = np.linalg.pinv(pose, rcond=_NULL, hermitian=True)
    of_images = _gram(of_intrinsics) - np.swapaxes(cross, 1, 2) @ inverse @ cross
    total, size = np.zeros((2, problem.num_cameras, free.shape[1], free.shape[1]))
    np.add.at(total, camera, of_images)
    np.add.at(size, camera, _gram(of_intrinsics))
    unit = np.sqrt(np.diagonal(size, axis1=1, axis2=2))
    unit = np.where(unit > 0, unit, 1.0)
    total /= unit[:, :, None] * unit[:, None]
    if with_priors:
        total += _intrinsics_priors(problem, unit)
    total += np.eye(free.shape[1]) * ~free[:, :, None]  # what is fixed is determined
    values, vectors = np.linalg.eigh(total)
    null = values <= _NULL * np.maximum(values[:, -1:], 1.0)
    return np.any(null[:, None] & (np.abs(vectors) > _NAMED), axis=2) & free


def _rows(
    problem: Problem, camera: Int[np.ndarray, " n"], point: Float[np.ndarray, "3 n rows"]
) -> tuple[Float[np.ndarray, "n twice 6"], Float[np.ndarray, "n twice parameters"]]:
    """Return rows of pixels by poses and intrinsics, from differences; those by intrinsics are exact, being linear."""
    names = type(problem.cameras).parameter_names()
    shape, flat = point.shape[1:], point.reshape(3, -1)
    of_row = np.repeat(camera, shape[1])
    values = np.stack([np.asarray(getattr(problem.cameras, name), float) for name in names], axis=-1)

    step = _STEP * np.linalg.norm(flat, axis=0)
    changes = np.eye(len(names))[:, None] * 1e-3 * np.maximum(np.abs(values), 1.0)
    moved = [(values, flat + sign * axis[:, None] * step) for axis in np.eye(3) for sign in (1, -1)]
    changed = [(values + sign * change, flat) for change in changes for sign in (1, -1)]
    pixels = _project_all([*moved, *changed], type(problem.cameras), of_row)
    differences = pixels[0::2] - pixels[1::2]
    by_point = differences[:3] / (2 * step)
    by_intrinsics = differences[3:] / (2 * changes.max(axis=2)[:, None, of_row])
    a = np.moveaxis(by_point, 2, 0)  # rows, xyz, uv
    turned = np.einsum("nik,nij->njk", a, -hat(flat.T))
    of_pose = np.concatenate([turned, a], axis=1)
    of_intrinsics = np.moveaxis(by_intrinsics, 2, 0)

    def by_image(rows: Float[np.ndarray, "m columns 2"]) -> np.ndarray:
        rows = np.where(np.isfinite(rows), rows, 0.0)
        return np.swapaxes(rows, 1, 2).reshape(shape[0], 2 * shape[1], -1)

    return by_image(of_pose), by_image(of_intrinsics)


def _project_all(
    cases: list[tuple[Float[np.ndarray, "cameras parameters"], Float[np.ndarray, "3 rows"]]],
    model: type[AbstractCamera],
    of_row: Int[np.ndarray, " rows"],
) -> Float[np.ndarray, "cases 2 rows"]:
    """Return the pixels of every case, cameras and points, in one call: each costs more than its few rows."""
    values = np.concatenate([values for values, _ in cases])
    camera = (np.arange(len(cases))[:, None] * len(cases[0][0]) + of_row).reshape(-1)
    pixels = project_in_cameras(model(*values.T), camera, np.concatenate([points for _, points in cases], axis=1))
    return np.moveaxis(pixels.reshape(2, len(cases), -1), 0, 1)


def _intrinsics_priors(
    problem: Problem, unit: Float[np.ndarray, "cameras parameters"]
) -> Float[np.ndarray, "cameras parameters parameters"]:
    """Return J^T J of all priors by each camera's intrinsics over their units, every row of length one."""
    total = np.zeros((*unit.shape, unit.shape[1]))
    free = np.asarray(problem.free.intrinsics)
    for prior in problem.priors:
        index = getattr(prior, "camera_index", None)
        if index is not None and len(index):
            jacobian = _camera_rows(prior, problem) * (free / unit)[np.asarray(index)][:, None]
            np.add.at(total, np.asarray(index), _gram(_unit(jacobian)))
    return total


def _camera_rows(prior: AbstractPrior, problem: Problem) -> Float[np.ndarray, "rows components parameters"]:
    names = type(problem.cameras).parameter_names()
    with jax.enable_x64(True):
        values = np.stack([np.asarray(getattr(problem.cameras, name), float) for name in names], axis=-1)
        poses, points = jax.tree.map(jax.numpy.asarray, (problem.poses, np.asarray(problem.points, float)))
        unknowns = Unknowns(poses, jax.numpy.asarray(values), jax.numpy.asarray(problem.antenna), points)
        fields = {f.name: np.asarray(getattr(prior, f.name)) for f in dataclasses.fields(prior) if f.name != "loss"}
        rows = dataclasses.replace(prior, **fields).rows(unknowns)
    if rows.intrinsics is None:
        return np.zeros((len(fields["camera_index"]), 1, len(names)))
    return np.moveaxis(np.asarray(rows.intrinsics.jacobian), 2, 0)
