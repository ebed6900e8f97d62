"""From a block and what was measured beside it to an adjustment problem: priors, bounds, what is free.

**Positions** are priors with a loss that lets a single bad fix go (`POSITION_LOSS`): at four sigmas a fix has a quarter
of its weight left, at six a tenth. Sigmas are those of the reference times `position_scale`, for receivers whose
positions scatter more than they claim. Without control the first two rounds take positions at their word and let go
later: with the principal point not yet adjusted, positions of lines flown up and down scatter by that error, and sigmas
enlarged to it would leave it as it is.

**Attitudes** of one flight err alike (a compass, a gimbal's zero), so that all of them together count as one
measurement: each sigma is multiplied by the root of their number. They hold the block where positions cannot: a single
flight line may roll about itself.

**Cameras** have weak priors and bounds (`_intrinsics.py`), and square pixels. Parameters in `held` keep their value
through a tight prior, not as fixed ones: so all rounds of an adjustment have one shape and compile once.

**A block without a place on earth** is held by weak priors on all positions at its start values: the seven directions
that photos cannot fix stay where they were, and nothing else is bent (sigma a tenth of the block's extent).

**Control points** stand behind the block's own points and observations (see `control/_control.py`).
"""

import dataclasses
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from jaxba.ba import (
    AbstractPrior,
    AspectPrior,
    AttitudePrior,
    ControlPointPrior,
    IntrinsicsPrior,
    Observations,
    PositionOffsetPrior,
    PositionPrior,
    Problem,
    Solution,
)
from jaxba.geometry import CAMERAS, Cauchy, GemanMcClure, Linear, Pose
from jaxba.scene import Block, CommonOffset, Photo, Reference
from jaxba.sfm._intrinsics import NaturalIntrinsics, natural_intrinsics
from jaxba.sfm._measured import LEAST_POSITIONS, flights_of, used_positions
from jaxba.sfm.control._control import CONTROL_LOSS, ControlPart

POSITION_LOSS = GemanMcClure(4.0)
_ASPECT_STD = 5e-4
_HELD = 1e-6  # of a parameter's natural sigma
_ATTITUDE_STD_RAD = 0.035  # at least: 2 degrees
_START_ATTITUDE_STD_RAD = 0.5
_ANCHOR = 0.1  # sigma of positions at their start values, of the block's extent
_COLLINEAR = 0.03  # second over first extent of the positions


def to_problem(
    block: Block,
    reference: Reference,
    photos: Sequence[Photo],
    *,
    anchor: Block | None = None,
    std_px: float = 1.0,
    position_scale: Float[np.ndarray, "3"] | None = None,
    let_go: float = 1.0,
    held: Sequence[str] = (),
    control: ControlPart | None = None,
    common: CommonOffset | None = None,
) -> Problem:
    """Return the problem of a block with points, its observations and all priors.

    - `anchor`: the block as it started, which holds what nothing measured holds, and gives the focal length's start
      where the photos give none; the block itself if None.
    - `std_px`: sigma of an observation's coordinates. `position_scale`: factor on the sigmas of positions, an axis.
    - `let_go`: times the residual at which a position's loss lets it go.
    - `held`: names of the camera model's parameters that stay as they are.
    - `control`: points and observations that follow the block's own. `common`: what positions are off in common, which
      is an unknown then. What those of each flight are off, where flights are told apart, always is.

    >>> import numpy as np
    >>> from jaxba.sfm import free_parameters
    >>> free_parameters("OPENCV", num_images=4)
    ('fx', 'fy', 'k1')
    """
    anchor = block if anchor is None else anchor
    model = CAMERAS[block.camera_model]
    natural = natural_intrinsics(anchor, photos)
    inside = np.clip(block.camera_parameters, natural.lower, natural.upper)
    names = model.parameter_names()
    priors: list[AbstractPrior] = [
        *_position_priors(anchor, reference, position_scale, let_go),
        *_attitude_priors(anchor, reference),
        _intrinsics_prior(natural, inside, [name in held for name in names]),
    ]
    if names[:2] == ("fx", "fy"):
        cameras = np.arange(len(inside), dtype=np.int32)
        ones = np.ones(len(inside))
        priors.append(AspectPrior(camera_index=cameras, ratio=ones, std=_ASPECT_STD * ones))
    count = block.num_observations
    points = block.points_m
    xy_px, std, image, point = (
        block.observation_xy_px, np.full(count, float(std_px)), block.observation_image, block.observation_point,
    )  # fmt: skip
    if control is not None:
        number = block.num_points + np.arange(len(control.rows))
        priors.append(
            ControlPointPrior(
                point_index=number.astype(np.int32), xyz=control.xyz_m, std_m=control.std_m, loss=CONTROL_LOSS
            )
        )
        points = np.concatenate([points, control.start_m])
        xy_px = np.concatenate([xy_px, control.observation_xy_px])
        std = np.concatenate([std, np.full(len(control.observation_image), control.std_px)])
        image = np.concatenate([image, control.observation_image])
        point = np.concatenate([point, number[control.observation_point]])
    offsets = _offsets(block, reference, common)
    if offsets is not None:
        priors.append(PositionOffsetPrior(xyz=np.zeros(offsets.std_m.shape), std_m=offsets.std_m))
    problem = Problem.build(
        Pose(block.quaternion, block.translation_m),
        model.from_parameters(inside),
        points,
        Observations(xy_px, std, image.astype(np.int32), point.astype(np.int32)),
        camera_index=block.camera_index.astype(np.int32),
        priors=priors,
        image_names=[photos[i].name for i in block.image_index],
    )
    if block.camera_model == "OPENCV":
        problem = problem.fix(intrinsics=["k3"])
    if offsets is not None:
        free = dataclasses.replace(problem.free, position_offset=np.array(True))
        problem = dataclasses.replace(problem, position_offset=offsets.start_m, free=free)
    return dataclasses.replace(problem, lower=natural.lower, upper=natural.upper)


class _Offsets(NamedTuple):
    """Offsets of positions, a row each: start values and sigmas."""

    start_m: Float[np.ndarray, "offsets 3"]
    std_m: Float[np.ndarray, "offsets 3"]


def _offsets(block: Block, reference: Reference, common: CommonOffset | None) -> _Offsets | None:
    """Return what positions have in common as unknowns: all of them, or those of each flight, as the block lies."""
    flights = flights_of(block, reference)
    if flights is None:
        return None if common is None else _Offsets(common.start_m[None], common.std_m[None])
    used = used_positions(block, reference)
    off = reference.xyz_m[block.image_index[used]] - block.centers_m[used]
    start_m = np.zeros((len(flights[0]), 3))
    for number in range(len(start_m)):
        of_flight = off[flights[1] == number]
        known = np.isfinite(of_flight).any(axis=0)
        start_m[number, known] = np.nanmedian(of_flight[:, known], axis=0)
    assert reference.flight_std_m is not None  # flights are told apart
    return _Offsets(start_m, np.full(start_m.shape, reference.flight_std_m))


def with_solution(block: Block, solution: Solution) -> Block:
    """Return the block with the adjusted poses, cameras and points of its own."""
    names = type(solution.cameras).parameter_names()
    return dataclasses.replace(
        block,
        quaternion=np.asarray(solution.poses.quaternion),
        translation_m=np.asarray(solution.poses.translation),
        camera_parameters=np.stack([np.asarray(getattr(solution.cameras, name)) for name in names], axis=1),
        points_m=np.asarray(solution.points)[: block.num_points],
    )


def positions_hold(block: Block, reference: Reference) -> bool:
    """Whether measured positions leave a block free in nothing: place, scale, or rotation."""
    used = used_positions(block, reference)
    return int(used.sum()) >= LEAST_POSITIONS and _fix_attitude(reference, block.image_index[used])


def is_collinear(positions_m: Float[np.ndarray, "n 3"]) -> bool:
    """Whether positions lie on a line, or are too few to tell."""
    if len(positions_m) < 3:
        return True
    extent = np.linalg.svd(positions_m - positions_m.mean(axis=0), compute_uv=False)
    return bool(extent[1] <= _COLLINEAR * extent[0])


def _fix_attitude(reference: Reference, index: np.ndarray) -> bool:
    """Whether positions of images fix a block's rotation: they lie on no line, and their heights are measured."""
    full = index[np.isfinite(reference.std_m[index] + reference.xyz_m[index]).all(axis=1)]
    return not is_collinear(reference.xyz_m[full])


def _intrinsics_prior(
    natural: NaturalIntrinsics, values: Float[np.ndarray, "cameras parameters"], held: Sequence[bool]
) -> IntrinsicsPrior:
    std = np.where(held, _HELD * natural.std, natural.std)
    return IntrinsicsPrior(
        camera_index=np.arange(len(values), dtype=np.int32),
        parameters=np.where(held, values, natural.center),
        std=std,
    )


def _position_priors(
    anchor: Block, reference: Reference, scale: Float[np.ndarray, "3"] | None, let_go: float
) -> tuple[PositionPrior, ...]:
    used = used_positions(anchor, reference)
    extent = np.linalg.norm(anchor.centers_m - np.median(anchor.centers_m, axis=0), axis=1)
    weak = _ANCHOR * max(float(np.sqrt(np.mean(extent**2))), 1e-6)
    if used.sum() < LEAST_POSITIONS:
        xyz, std = anchor.centers_m, np.full((anchor.num_images, 3), weak)
        if anchor.is_georeferenced:
            measured = reference.xyz_m[anchor.image_index[used]]
            xyz[used] = np.where(np.isfinite(measured), measured, xyz[used])
            std[used] = _sigma(reference, anchor.image_index[used], scale)
        every = np.arange(anchor.num_images, dtype=np.int32)
        return (PositionPrior(image_index=every, xyz=xyz, std_m=std, loss=Linear()),)
    rows = np.flatnonzero(used)
    index = anchor.image_index[rows]
    xyz, std = reference.xyz_m[index].copy(), _sigma(reference, index, scale)
    nowhere = ~np.isfinite(std).any(axis=0)  # no photo has a height: they stay where they start
    xyz[:, nowhere], std[:, nowhere] = anchor.centers_m[rows][:, nowhere], weak
    loss = GemanMcClure(POSITION_LOSS.f_scale * let_go)
    flights = flights_of(anchor, reference)
    return (
        PositionPrior(
            image_index=rows.astype(np.int32),
            xyz=np.nan_to_num(xyz),
            std_m=std,
            loss=loss,
            offset_weights=None if flights is None else np.eye(len(flights[0]))[flights[1]],
        ),
    )


def _sigma(reference: Reference, index: np.ndarray, scale: np.ndarray | None) -> Float[np.ndarray, "n 3"]:
    """Return sigmas of positions, infinite where an axis is not measured."""
    std = reference.std_m[index] * (1.0 if scale is None else scale)
    return np.where(np.isfinite(reference.xyz_m[index]) & (std > 0), std, np.inf)


def _attitude_priors(anchor: Block, reference: Reference) -> tuple[AttitudePrior, ...]:
    """Measured attitudes; where there are none and positions do not tell them, weakly those at the start."""
    if not anchor.is_georeferenced:
        return ()
    index = anchor.image_index
    measured = np.isfinite(reference.quaternion[index]).all(axis=1)
    if measured.any():
        rows = np.flatnonzero(measured)
        quaternion = reference.quaternion[index[rows]]
        std = np.nan_to_num(reference.attitude_std_rad[index[rows]], nan=_ATTITUDE_STD_RAD)
        std = np.maximum(std, _ATTITUDE_STD_RAD)
    elif not _fix_attitude(reference, index[used_positions(anchor, reference)]):
        rows = np.arange(anchor.num_images)
        quaternion, std = anchor.quaternion, np.full((anchor.num_images, 3), _START_ATTITUDE_STD_RAD)
    else:
        return ()
    unit = Rotation.from_quat(quaternion, scalar_first=True).as_quat(scalar_first=True)
    std = std * np.sqrt(len(rows))
    return (AttitudePrior(image_index=rows.astype(np.int32), quaternion=unit, std_rad=std, loss=Cauchy(3.0)),)
