"""Covariance: marginal covariances of poses, intrinsics, lever arm and points at a problem's present values.

The blocks of (J^T J)^-1 that belong to one image, camera or point. They are computed tile by tile, as steps are by
`solve_tiled`, and no inverse of the whole is ever there; see `tiles/_inverse.py`.
Poses are tangent steps (w in rad, v in metres) in the camera's frame, as `Pose.retract` takes them.
"""

import dataclasses
import functools
import os
import threading
from collections.abc import Callable
from typing import Any, Literal, NamedTuple, get_args

import numpy as np
from jaxtyping import Float, Int

from jaxba._errors import JaxbaError
from jaxba.ba._plan_shape import PlanShape, bare_shape
from jaxba.ba._problem import Problem
from jaxba.ba._projection import rotation_matrices
from jaxba.ba._system import own_unknowns
from jaxba.ba._unknowns import Unknowns, antenna_names
from jaxba.ba.checks import Dropped, prepare, require_gauge
from jaxba.ba.tiles._dense import NotPositive
from jaxba.ba.tiles._engine import Engine, compile_tiles
from jaxba.ba.tiles._inverse import Marginals, Rows, calls_of_marginals, marginals
from jaxba.ba.tiles._opened import TILE_OBSERVATIONS, opened
from jaxba.ba.tiles._right_hand_sides import solved
from jaxba.ba.uncertainty._inner_constraints import free_block, num_free, of_photos_alone
from jaxba.ba.uncertainty._leverage import Leverage
from jaxba.ba.uncertainty._variance_factor import variance_factor
from jaxba.geometry import AbstractLoss, Linear, check_loss

Datum = Literal["priors", "inner"]
Independent = Literal["observations", "tracks"]
_PROBING = 1e-9  # damping, relative, under which a singular system shows where it is weak
_MAX_INFLATION = 1e13  # of a variance by the other unknowns: beyond it rounding has eaten the answer


@dataclasses.dataclass(frozen=True)
class Covariance:
    """Covariances a priori: of measurements whose sigmas are true. Times `variance_factor` they are a posteriori.

    Zero for what is fixed. A parameter at its bound counts as free.

    - `poses`: tangent steps (w, v) in the camera's frame: rad and metres. `centers`: camera positions, world, m^2.
    - `intrinsics`: of each camera, in its parameters' units. `lever_arm`: camera's frame, m^2. `points`: world, m^2.
    - `position_offset`: of the offsets that measured positions share, all of them jointly, world, m^2; of none zeros.
    - `border`: joint covariance of the shared unknowns named in `border_names`: all refined intrinsics, then lever arm
      and position offset. Where each image has its own camera, only these.
    - `variance_factor`: near 1 where the sigmas are right, under any loss; `2 cost / redundancy` under least squares,
      and where a loss is robust the same without the tail, which no sigma describes. NaN without redundancy.
    - `redundancy`: measured components that depend on something free, minus free unknowns.
    - `dropped`: observations and points that took no part.
    """

    poses: Float[np.ndarray, "images 6 6"]
    centers: Float[np.ndarray, "images 3 3"]
    intrinsics: Float[np.ndarray, "cameras parameters parameters"]
    lever_arm: Float[np.ndarray, "3 3"]
    position_offset: Float[np.ndarray, "offsets3 offsets3"]
    points: Float[np.ndarray, "points 3 3"]
    border: Float[np.ndarray, "border border"]
    border_names: tuple[str, ...]
    variance_factor: float
    redundancy: int
    dropped: Dropped

    @property
    def correlation(self) -> Float[np.ndarray, "border border"]:
        """Correlations of the shared unknowns named in `border_names`; NaN of those that are fixed."""
        std = np.sqrt(np.diagonal(self.border))
        known = np.where(std > 0, std, np.nan)
        return self.border / np.outer(known, known)


def covariance(
    problem: Problem,
    *,
    loss: AbstractLoss | None = None,
    datum: Datum = "priors",
    independent: Independent = "observations",
    max_memory: float | str | None = None,
    max_observations: float = TILE_OBSERVATIONS,
    folder: str | os.PathLike[str] | None = None,
    workers: int | None = None,
    like: PlanShape | None = None,
) -> Covariance:
    """Return the covariances at the problem's present values; call it on `solution.apply(problem)`.

    - `loss`: as given to `solve`; rows count with the weight that it gives them (least squares if None).
    - `datum`: what the block's place, rotation and scale are known from: `priors`, with what is held fixed, or `inner`
      for photos and scale bars alone, under inner constraints over the points, whatever other priors say.
    - `independent`: of which errors are: `observations`, or only `tracks`, some of which are measured worse than others
      in all their images. That tells in `border`, intrinsics that images share, lever arm and position offsets
      (`_track_scores.py`).
    - `max_memory`, `max_observations`, `folder`, `workers`: as in `solve_tiled`.
    - `like`: shape of an earlier plan, as in `make_plan`: a problem of up to `max_observations` shares what was
      compiled for it (`statistics_compiler`).

    Raises `JaxbaError` where the problem has no gauge, where something in it is not determined, and where memory or
    disk do not suffice.

    >>> import jaxba
    >>> survey = jaxba.synthetic.uav_block(8)
    >>> found = jaxba.ba.covariance(survey.problem)
    >>> found.poses.shape, found.points.shape[1:], found.border_names[:2]
    ((8, 6, 6), (3, 3), ('camera 0 fx', 'camera 0 fy'))
    """
    room: dict[str, Any] = {
        "max_memory": max_memory,
        "max_observations": max_observations,
        "folder": folder,
        "workers": workers,
        "like": like,
    }
    loss = Linear() if loss is None else loss
    return marginals_at("Covariance", problem, loss, datum, independent, "none", **room).covariance


class At(NamedTuple):
    """What is known at a problem's present values.

    - `problem`: whose priors hold it; without those of poses and points under inner constraints.
    - `leverages`: of the rows that were asked for. `kept`: the observations that took part.
    """

    problem: Problem
    covariance: Covariance
    leverages: tuple[Leverage, ...]
    kept: Int[np.ndarray, " kept"]


def marginals_at(
    label: str,
    problem: Problem,
    loss: AbstractLoss,
    datum: Datum,
    independent: Independent,
    rows: Rows,
    **room: Any,
) -> At:
    """Return the covariances, and the leverages of the rows that are asked for.

    - `label`: of the function that asks, for messages. `datum`, `independent`, `room`: as in `covariance`, whose errors
      it raises.
    """
    check_loss(f"{label.lower()}: loss", loss)
    for name, given, choices in (("datum", datum, Datum), ("independent", independent, Independent)):
        if given not in get_args(choices):
            raise JaxbaError(f"{label.lower()}: {name} {given!r}; give {' or '.join(map(repr, get_args(choices)))}.")
    if datum == "inner":
        problem = of_photos_alone(label, problem)
    prepared = prepare(problem)
    of_datum = _of_priors if datum == "priors" else _of_photos
    found = of_datum(label, prepared.problem, loss, rows, independent == "tracks", **room)
    losses = [loss, *(prior.loss for prior in problem.priors)]
    defect = 0 if datum == "priors" else num_free(problem)
    of_all = _in_order(found, losses, prepared.problem, prepared.dropped, defect)
    return At(problem, of_all, found.leverages, prepared.kept)


def statistics_compiler(
    problem: Problem,
    like: PlanShape,
    *,
    loss: AbstractLoss | None = None,
    independent: Independent = "observations",
    stop: threading.Event | None = None,
) -> Callable[[], None]:
    """Return what compiles that which `statistics` will call, to be called in a thread beside other work.

    - `problem`: as it will be by then, but for its values and for observations and points that come and go; where it
      is not, `statistics` compiles as without.
    - `like`: as `statistics` will be given. `loss`, `independent`: likewise.
    - `stop`: once it is set, no further program is begun; each takes a second or less.

    Nothing is compiled for a problem in several tiles, whose shapes are not known before.

    >>> import jaxba
    >>> problem = jaxba.synthetic.uav_block(8).problem
    >>> shape = jaxba.ba.make_plan(problem, spare=0.1).shape
    >>> jaxba.ba.statistics_compiler(problem, shape)()
    >>> jaxba.statistics(problem, like=shape).covariance.redundancy > 0
    True
    """
    loss = Linear() if loss is None else loss
    if problem.num_observations > TILE_OBSERVATIONS:
        return lambda: None
    with opened("statistics", problem, loss, inverse=True, like=like) as engine:
        ones = engine.one_of_each_shape(own_unknowns(problem))
    calls = calls_of_marginals("all", by_tracks=independent == "tracks")
    return functools.partial(compile_tiles, ones, calls, at_a_time=1, stop=stop)


def _of_photos(label: str, problem: Problem, loss: AbstractLoss, rows: Rows, by_tracks: bool, **room: Any) -> Marginals:
    """Return the marginals under inner constraints; the reach of rows, which those would tell, is not known."""
    block = free_block(label, problem)
    found = _of_priors(label, block.held, loss, rows, by_tracks, **room)
    unknowns = own_unknowns(block.held)
    with opened(label.lower(), block.held, loss, **room) as engine:
        across = solved(engine, unknowns, block.columns())
    blocks = found.blocks.copy()
    blocks[:, :6, :6], points = block.transformed(blocks[:, :6, :6], found.points, across)
    leverages = tuple(of._replace(reach=np.full(of.reach.shape, np.nan)) for of in found.leverages[:-1])
    return found._replace(blocks=blocks, points=points, squares=found.squares[:-1], leverages=leverages)


def _of_priors(label: str, problem: Problem, loss: AbstractLoss, rows: Rows, by_tracks: bool, **room: Any) -> Marginals:
    """Return the marginals as priors, and what is fixed, hold a problem that was checked."""
    require_gauge(problem, label)
    unknowns = own_unknowns(problem)
    with opened(label.lower(), problem, loss, inverse=True, **room) as engine:
        compile_tiles(engine.one_of_each_shape(unknowns), calls_of_marginals(rows, by_tracks=by_tracks))
        found = _marginals(engine, problem, unknowns, 0.0, rows, by_tracks)
        if found is None or not _determined(found):
            weakest = _weakest(_marginals(engine, problem, unknowns, _PROBING), problem)
            raise JaxbaError(
                f"{label}: the measurements do not determine {weakest}. Hold it fixed or add a prior; an image "
                "needs three points or more that others see, and intrinsics need views from different heights or sides."
            )
    return found


def _marginals(
    engine: Engine,
    problem: Problem,
    unknowns: Unknowns,
    damping: float,
    rows: Rows = "none",
    by_tracks: bool = False,
) -> Marginals | None:
    """Return the marginals, or None where there are none."""
    try:
        return marginals(engine, problem, unknowns, damping, rows, by_tracks=by_tracks)
    except NotPositive:
        return None


def _in_order(
    found: Marginals, losses: list[AbstractLoss], problem: Problem, dropped: Dropped, defect: int
) -> Covariance:
    """Return the covariances, zero for what is fixed; `defect`: directions that no measurement is to fix."""
    shape, free = bare_shape(problem), problem.free
    blocks = found.blocks
    poses = blocks[:, :6, :6] * np.asarray(free.poses)[:, None, None]
    rotation = rotation_matrices(problem.poses)
    centers = np.swapaxes(rotation, 1, 2) @ poses[:, 3:, 3:] @ rotation

    names = type(problem.cameras).parameter_names()
    refined = np.flatnonzero(shape.refined)
    num_cameras, num_shared = problem.num_cameras, shape.border - shape.antenna
    free_intrinsics = np.asarray(free.intrinsics)
    shared_free = np.zeros(0, bool) if shape.own_cameras else free_intrinsics[:, refined].reshape(-1)
    border_free = np.append(shared_free, problem.free_antenna[: shape.antenna])
    of_border = found.border if found.tracks is None else found.border + found.tracks.by_tracks(found.border)
    border = of_border * np.outer(border_free, border_free)
    offsets, num_antenna = len(problem.position_offset) - problem.num_bar_ends, 0
    if shape.antenna:
        num_antenna = 3 + 3 * offsets
    antenna = np.zeros((3 + 3 * max(offsets, 1),) * 2)
    of_antenna = slice(num_shared, num_shared + num_antenna)
    antenna[:num_antenna, :num_antenna] = border[of_antenna, of_antenna]
    named = [*range(num_shared), *(num_shared + np.flatnonzero(problem.free_antenna[:num_antenna]))]
    intrinsics = np.zeros((num_cameras, len(names), len(names)))
    if shape.own_cameras:
        intrinsics[np.ix_(np.asarray(problem.camera_index), refined, refined)] = blocks[:, 6:, 6:]
        intrinsics *= free_intrinsics[:, :, None] & free_intrinsics[:, None]
    else:
        of_cameras = border[:num_shared, :num_shared].reshape(num_cameras, len(refined), num_cameras, len(refined))
        cameras = np.arange(num_cameras)
        intrinsics[np.ix_(cameras, refined, refined)] = of_cameras[cameras, :, cameras]
    factor, redundancy = variance_factor(losses, found.squares, float(_num_free(problem) - defect))
    return Covariance(
        poses=poses,
        centers=centers,
        intrinsics=intrinsics,
        lever_arm=antenna[:3, :3],
        position_offset=antenna[3:, 3:],
        points=found.points,
        border=border[np.ix_(named, named)],
        border_names=tuple(np.array(_border_names(shape, problem))[named].tolist()),
        variance_factor=factor,
        redundancy=int(redundancy),
        dropped=dropped,
    )


def _border_names(shape: PlanShape, problem: Problem) -> tuple[str, ...]:
    names = type(problem.cameras).parameter_names()
    cameras = 0 if shape.own_cameras else problem.num_cameras
    refined = [n for n, r in zip(names, shape.refined, strict=True) if r]
    shared = [f"camera {c} {n}" for c in range(cameras) for n in refined]
    return (*shared, *antenna_names(len(problem.position_offset))[: shape.antenna])


def _num_free(problem: Problem) -> int:
    free = problem.free
    blocks = 6 * np.count_nonzero(free.poses) + 3 * np.count_nonzero(free.points) + int(problem.free_antenna.sum())
    return int(blocks + np.count_nonzero(free.intrinsics))


def _determined(found: Marginals) -> bool:
    inflation = np.append(np.ravel(found.block_inflation), found.border_inflation)
    return bool(np.isfinite(found.points).all() and np.max(inflation, initial=0.0) < _MAX_INFLATION)


def _weakest(damped: Marginals | None, problem: Problem) -> str:
    """Name the unknown whose variance the others inflate most, from a system damped until it has an inverse."""
    if damped is None or not (np.isfinite(damped.block_inflation).all() and np.isfinite(damped.border_inflation).all()):
        return "some of the points"
    of_images, of_border = damped.block_inflation, damped.border_inflation
    if np.max(of_border, initial=0.0) > of_images.max():
        return _border_names(bare_shape(problem), problem)[int(np.argmax(of_border))]
    image, column = np.unravel_index(np.argmax(of_images), of_images.shape)
    return f"the {'pose' if column < 6 else 'camera'} of {problem.image_label(int(image))}"
