"""What else might be flown or measured, and what it would gain: more photos, better positions.

More photos see the block's own tie points, as many of them as its photos do, so that the same works for a block that
was planned and one that was flown.
"""

import dataclasses
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from jaxba._errors import JaxbaError
from jaxba.ba import ControlPointPrior, Observations, PositionOffsetPrior, PositionPrior, Problem, ScaleBarPrior
from jaxba.design._network import Network
from jaxba.design._photos import Photos, marks
from jaxba.design._sections import Gnss
from jaxba.design._stations import around, level
from jaxba.geometry import AbstractLoss, Linear, Pose

_OBLIQUE_SHARE, _LEAST_OBLIQUE, _TILT_DEG = 0.1, 8, 30.0
_SECOND_HEIGHT = 1.3  # times the first
_PIECE = 16  # photos that look for their points at a time


def with_oblique(network: Network) -> Network:
    """Return the network with photos around the area that look at its middle: a tenth of its own, 8 at least."""
    count = max(_LEAST_OBLIQUE, round(_OBLIQUE_SHARE * network.photos.num))
    more = around(network.area_m, _height(network), count, _TILT_DEG)
    rise = np.array([0.0, 0.0, _ground_height(network)])
    return with_photos(network, more.center_m + rise, more.cam_from_world)


def with_second_height(network: Network) -> Network:
    """Return the network flown once more, 1.3 times as high and turned by a right angle, with half of its photos."""
    photos = network.photos
    chosen = photos.center_m[::2]
    center_m = np.column_stack([chosen[:, :2], chosen[:, 2] + (_SECOND_HEIGHT - 1) * _height(network)])
    heading = np.array([np.rad2deg(np.arctan2(*(-rotation[1, :2]))) for rotation in photos.cam_from_world[::2]])
    rotation = np.stack([level(90.0 + degrees) for degrees in heading])
    return with_photos(network, center_m, rotation)


def with_positions(network: Network, gnss: Gnss) -> Network:
    """Return the network with all its positions measured by another receiver."""
    problem = network.problem
    every = np.arange(problem.num_images, dtype=np.int32)
    bars = problem.num_bar_ends
    before = len(problem.position_offset) - bars
    ends = np.asarray(problem.position_offset)[before:]
    kept = [
        dataclasses.replace(p, offset_index=np.asarray(p.offset_index) + np.int32(1 - before))
        if isinstance(p, ScaleBarPrior)
        else p
        for p in problem.priors
        if not isinstance(p, PositionPrior | PositionOffsetPrior)
    ]
    weights = np.eye(1, 1 + bars).repeat(problem.num_images, axis=0)
    positions = PositionPrior(
        image_index=every,
        xyz=network.photos.center_m,
        std_m=np.tile(gnss.std_m, (problem.num_images, 1)),
        loss=Linear(),
        offset_weights=weights,
    )
    std_m = np.maximum(np.array(gnss.common_std_m), 1e-6)
    offset = PositionOffsetPrior(xyz=np.zeros((1 + bars, 3)), std_m=np.vstack([std_m, np.full((bars, 3), np.inf)]))
    problem = dataclasses.replace(
        problem,
        priors=(positions, *kept, offset),
        position_offset=np.vstack([np.zeros((1, 3)), ends]),
        free=dataclasses.replace(problem.free, position_offset=np.array(True)),
    )
    return dataclasses.replace(network, problem=problem)


def with_photos(
    network: Network, center_m: Float[np.ndarray, "n 3"], cam_from_world: Float[np.ndarray, "n 3 3"]
) -> Network:
    """Return the network with more photos of its first camera."""
    photos, problem = network.photos, network.problem
    more = Photos(center_m, cam_from_world, photos.cameras, np.zeros(len(center_m), np.int32), photos.size_px)
    both = photos.and_more(center_m, cam_from_world)
    poses = Pose(
        np.concatenate([np.asarray(problem.poses.quaternion, float), more.poses.quaternion]),
        np.concatenate([np.asarray(problem.poses.translation, float), more.poses.translation]),
    )
    problem = dataclasses.replace(
        problem,
        poses=poses,
        camera_index=np.asarray(both.camera_index, np.int32),
        observations=_with_observations(problem, more),
        priors=tuple(_with_rows(prior, problem.num_images, center_m) for prior in problem.priors),
        free=dataclasses.replace(problem.free, poses=np.append(problem.free.poses, np.ones(len(center_m), bool))),
        image_names=(),
    )
    return dataclasses.replace(network, photos=both, problem=problem)


def with_control(network: Network, plan_m: Float[np.ndarray, "points 2"], std_m: Sequence[float]) -> Network:
    """Return the network with control points there, marked in all photos that show them.

    - `std_m`: sigma of their surveyed coordinates, east, north, up.
    """
    problem, before = network.problem, network.problem.num_points
    xyz_m = np.asarray(network.ground.at(plan_m), float)
    image, point, xy_px = marks(network.photos, xyz_m)
    seen = np.bincount(point, minlength=len(xyz_m)) >= 2
    if not seen.all():
        east, north, _ = xyz_m[int(np.argmin(seen))]
        raise JaxbaError(
            f"a control point {east:.0f} m east and {north:.0f} m north of the middle is seen in fewer than 2 photos; "
            "overlap more."
        )
    own = problem.observations
    observations = Observations(
        np.concatenate([np.asarray(own.xy_px, float), xy_px]),
        np.append(np.asarray(own.std_px, float), np.full(len(image), network.mark_std_px)),
        np.append(np.asarray(own.image_index, np.int32), image.astype(np.int32)),
        np.append(np.asarray(own.point_index, np.int32), (before + point).astype(np.int32)),
    )
    given = problem.prior(ControlPointPrior.name)
    index, xyz, std = (
        before + np.arange(len(xyz_m), dtype=np.int32),
        xyz_m,
        np.tile(np.array(std_m, float), (len(xyz_m), 1)),
    )
    loss: AbstractLoss = Linear()
    if isinstance(given, ControlPointPrior):
        index = np.append(np.asarray(given.point_index, np.int32), index)
        xyz, std = np.concatenate([np.asarray(given.xyz), xyz]), np.concatenate([np.asarray(given.std_m), std])
        loss = given.loss
    prior = ControlPointPrior(point_index=index, xyz=xyz, std_m=std, loss=loss)
    problem = dataclasses.replace(
        problem,
        points=np.concatenate([np.asarray(problem.points, float), xyz_m]),
        observations=observations,
        priors=(*(p for p in problem.priors if p is not given), prior),
        free=dataclasses.replace(problem.free, points=np.append(problem.free.points, np.ones(len(xyz_m), bool))),
    )
    return dataclasses.replace(network, problem=problem)


def _with_observations(problem: Problem, more: Photos) -> Observations:
    """Return the observations with those of more photos, as many a photo as the others have, at their sigma."""
    own = problem.observations
    points = np.asarray(problem.points, float)
    usual = float(np.median(np.bincount(np.asarray(own.image_index), minlength=problem.num_images)))
    rng = np.random.default_rng(0)
    parts = [(np.asarray(own.xy_px, float), np.asarray(own.image_index), np.asarray(own.point_index))]
    for first in range(0, more.num, _PIECE):
        piece = slice(first, first + _PIECE)
        some = dataclasses.replace(
            more,
            center_m=more.center_m[piece],
            cam_from_world=more.cam_from_world[piece],
            camera_index=more.camera_index[piece],
        )
        image, point, xy_px = marks(some, points)
        seen = np.bincount(image, minlength=some.num)
        found = rng.random(len(image)) < usual / np.maximum(seen, 1)[image]
        parts.append((xy_px[found], problem.num_images + first + image[found], point[found]))
    xy_px, image, point = (np.concatenate(part) for part in zip(*parts, strict=True))
    std_px = np.full(len(xy_px), float(np.median(np.asarray(own.std_px))))
    std_px[: len(own.std_px)] = own.std_px
    return Observations(xy_px, std_px, image.astype(np.int32), point.astype(np.int32))


def _with_rows(prior: object, num_images: int, center_m: Float[np.ndarray, "n 3"]) -> object:
    """Return a prior of positions with a row for each more photo, measured as the others; any other as it is."""
    if not isinstance(prior, PositionPrior):
        return prior
    count = len(center_m)
    std_m = np.asarray(prior.std_m, float)
    usual = np.median(std_m, axis=0)
    weights = prior.offset_weights
    if weights is not None:  # of the same flight as the last one
        weights = np.concatenate([np.asarray(weights), np.repeat(np.asarray(weights)[-1:], count, axis=0)])
    image = np.arange(num_images, num_images + count, dtype=np.int32)
    return PositionPrior(
        image_index=np.append(np.asarray(prior.image_index, np.int32), image),
        xyz=np.concatenate([np.asarray(prior.xyz, float), center_m]),
        std_m=np.concatenate([std_m, np.tile(usual, (count, 1))]),
        loss=prior.loss,
        offset_weights=weights,
    )


def _ground_height(network: Network) -> float:
    return float(np.median(network.ground.height_m))


def _height(network: Network) -> float:
    """Return the median height of the photos above the ground."""
    return float(np.median(network.photos.center_m[:, 2])) - _ground_height(network)
