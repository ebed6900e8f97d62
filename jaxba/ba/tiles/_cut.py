"""Cut a problem into the tiles of a tree: each holds some points with all their observations and the images of these.

Every row of every prior goes to one tile: those of a point to its own, those of an image, or of its own camera, to the
first one that the image has points in, the others to the first tile, as do images that see nothing. Tiles of like sizes
get like shapes, so that they share what is compiled.
"""

import dataclasses
import functools
from collections.abc import Iterator, Sequence

import jax
import numpy as np
from jaxtyping import Bool, Int

from jaxba.ba._plan import Orders, Plan, make_plan
from jaxba.ba._plan_shape import PlanShape, alike, bare_shape, larger, num_rows
from jaxba.ba._problem import AbstractPrior, Free, Observations, Problem
from jaxba.ba._system import System, arrange, make_system, restore
from jaxba.ba._unknowns import Unknowns
from jaxba.ba.tiles._dissect import Tree
from jaxba.geometry import AbstractLoss, Pose

_LIKE = 0.6  # of the observations of the largest tile of a shape: smaller ones get one of their own


@dataclasses.dataclass(frozen=True)
class Tile:
    """A tile: which of the problem's images, cameras and points it holds, and its structure.

    - `images`, `cameras`, `points`: in the problem's order. `order`: the images in that of elimination, its solver's.
    - `rows`, `prior_rows`: its observations, and its rows of each prior.
    - `plan`: its orders, in the solver and out of it.
    """

    images: Int[np.ndarray, " images"]
    cameras: Int[np.ndarray, " cameras"]
    points: Int[np.ndarray, " points"]
    rows: Int[np.ndarray, " rows"]
    prior_rows: tuple[Int[np.ndarray, " _"], ...]
    order: Int[np.ndarray, " images"]
    plan: Orders

    @property
    def solver_cameras(self) -> Int[np.ndarray, " cameras"]:
        """Its cameras in the order of its solver."""
        return self.cameras[self.plan.camera_order]

    def take(self, unknowns: Unknowns) -> Unknowns:
        """Return the tile's part of all unknowns, in its solver's order."""
        poses = Pose(unknowns.poses.quaternion[self.images], unknowns.poses.translation[self.images])
        of_tile = Unknowns(poses, unknowns.intrinsics[self.cameras], unknowns.antenna, unknowns.points[self.points])
        return arrange(of_tile, self.plan)

    def bare(self) -> "Tile":
        """Return what work on it needs that is given its part of the unknowns."""
        none = np.zeros(0, np.int32)
        bare = dataclasses.replace(self.plan, point_order=none, row_observation=none)
        return dataclasses.replace(self, points=none, rows=none, prior_rows=(), plan=bare)

    def put(self, part: Unknowns, unknowns: Unknowns) -> None:
        """Write poses and points of the tile's solver into all unknowns, which are numpy arrays."""
        found = restore(part, self.plan)
        unknowns.poses.quaternion[self.images] = found.poses.quaternion
        unknowns.poses.translation[self.images] = found.poses.translation
        unknowns.points[self.points] = found.points


def cut(
    problem: Problem, tree: Tree, loss: AbstractLoss, like: PlanShape | None = None
) -> Iterator[tuple[int, Tile, System]]:
    """Return the tiles with their systems, the largest ones first, each with its number.

    - `like`: gives a problem's only tile the least sizes.
    """
    shape = bare_shape(problem, None if like is None or len(tree.tiles) > 1 else _of_tile(like))
    shape = dataclasses.replace(shape, prior_rows=())  # a tile has some of the rows
    seen = problem.observations
    tile_of_row = tree.tile_of_point[np.asarray(seen.point_index)]
    rows_of_tile = np.split(np.argsort(tile_of_row, kind="stable"), np.cumsum(np.bincount(tile_of_row))[:-1])
    owner, camera_index = np.zeros(problem.num_images, np.int32), np.asarray(problem.camera_index)
    for number in reversed(range(len(rows_of_tile))):
        owner[np.asarray(seen.image_index)[rows_of_tile[number]]] = number
    unseen = np.bincount(np.asarray(seen.image_index), minlength=problem.num_images) == 0
    of_cameras = np.zeros(problem.num_cameras, np.int32)
    if shape.own_cameras:  # else every tile has all cameras
        of_cameras[camera_index] = owner
    owners = {"image_index": owner, "point_index": tree.tile_of_point, "camera_index": of_cameras}
    tile_of_prior = [_tile_of_rows(prior, owners) for prior in problem.priors]

    def part(number: int, like: PlanShape) -> tuple[Problem, Plan, Tile]:
        rows = rows_of_tile[number]
        images = np.unique(np.append(np.asarray(seen.image_index)[rows], np.flatnonzero(unseen & (number == 0))))
        points = np.flatnonzero(tree.tile_of_point == number)
        chosen = [np.flatnonzero(tiles == number) for tiles in tile_of_prior]
        cameras = np.sort(camera_index[images]) if shape.own_cameras else np.arange(problem.num_cameras)
        found = sub_problem(problem, rows, images, points, cameras, chosen)
        order = np.argsort(tree.rank[images]).astype(np.int32)
        plan = make_plan(found, linear_solver="dense", like=like, image_order=order)
        tile = Tile(images, cameras, points, rows.astype(np.int32), tuple(chosen), images[order], plan.orders())
        return found, plan, tile

    for group in alike([len(rows) for rows in rows_of_tile], _LIKE):
        like = functools.reduce(larger, (part(number, shape)[1].shape for number in group))
        for number in group:
            found, plan, tile = part(number, like)
            yield number, tile, make_system(found, plan, loss)


def _of_tile(like: PlanShape) -> PlanShape:
    return dataclasses.replace(like, linear_solver="dense", panel_images=1, band_panels=0)


def _tile_of_rows(prior: AbstractPrior, owners: dict[str, Int[np.ndarray, " _"]]) -> Int[np.ndarray, " rows"]:
    """Return the tile of each row; `owners` tells it of images, points and cameras by the name of their index."""
    for name, tiles in owners.items():
        if hasattr(prior, name):
            return tiles[np.asarray(getattr(prior, name))]
    return np.zeros(num_rows(prior), np.int32)


def rows_about(
    prior: AbstractPrior, chosen: dict[str, Bool[np.ndarray, " _"]], *, shared: bool
) -> Int[np.ndarray, " rows"]:
    """Return the rows of a prior that concern what is chosen.

    - `chosen`: masks of images, points and cameras, by the name of their index. `shared`: whether the rows of a prior
      without an index, which is about what all share, are among them.
    """
    masks = [mask[np.asarray(getattr(prior, name))] for name, mask in chosen.items() if hasattr(prior, name)]
    found = np.logical_and.reduce(masks) if masks else np.full(num_rows(prior), shared)
    return np.flatnonzero(found)


def sub_problem(
    problem: Problem,
    rows: Int[np.ndarray, " rows"],
    images: Int[np.ndarray, " images"],
    points: Int[np.ndarray, " points"],
    cameras: Int[np.ndarray, " cameras"],
    of_priors: Sequence[Int[np.ndarray, " _"]],
) -> Problem:
    """Return the problem of these observations, images, points and cameras, and of these rows of each prior.

    Numbers ascend, and whatever is referred to is among them. Images have no names.
    """
    seen, free = problem.observations, problem.free

    def place(kept: Int[np.ndarray, " kept"], count: int) -> Int[np.ndarray, " count"]:
        places = np.zeros(count, np.int32)
        places[kept] = np.arange(len(kept), dtype=np.int32)
        return places

    places = {
        "image_index": place(images, problem.num_images),
        "point_index": place(points, problem.num_points),
        "camera_index": place(cameras, problem.num_cameras),
    }

    def taken(prior: AbstractPrior, rows: Int[np.ndarray, " rows"]) -> AbstractPrior:
        """Return the prior with these rows alone."""
        given = {name: value for name, value in vars(prior).items() if name != "loss" and value is not None}
        fields = {name: np.asarray(value)[rows] for name, value in given.items()}
        return dataclasses.replace(
            prior, **{name: places[name][value] if name in places else value for name, value in fields.items()}
        )

    of_observations = Observations(
        np.asarray(seen.xy_px)[rows],
        np.asarray(seen.std_px)[rows],
        places["image_index"][np.asarray(seen.image_index)[rows]],
        places["point_index"][np.asarray(seen.point_index)[rows]],
    )
    return Problem(
        poses=Pose(np.asarray(problem.poses.quaternion)[images], np.asarray(problem.poses.translation)[images]),
        cameras=jax.tree.map(lambda of_cameras: np.asarray(of_cameras)[cameras], problem.cameras),
        camera_index=places["camera_index"][np.asarray(problem.camera_index)[images]],
        points=np.asarray(problem.points)[points],
        observations=of_observations,
        priors=tuple(taken(*each) for each in zip(problem.priors, of_priors, strict=True)),
        lever_arm=np.asarray(problem.lever_arm),
        free=Free(
            np.asarray(free.poses)[images],
            np.asarray(free.points)[points],
            np.asarray(free.intrinsics)[cameras],
            free.lever_arm,
            free.position_offset,
        ),
        lower=np.asarray(problem.lower)[cameras],
        upper=np.asarray(problem.upper)[cameras],
        position_offset=np.asarray(problem.position_offset),
    )
