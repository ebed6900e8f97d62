"""Partition: a block cut into problems that overlap, each to be adjusted on its own.

Each image becomes the own one of one tile: by planes that few images see across, or along the flight, at the ends of
its lines. Then each tile takes over some images of its neighbours, and every point that its images see twice, with all
observations between them. Cost: O(observations) a level of cuts; a block of 2000 images takes a second.
"""

import dataclasses
from typing import Any, Literal

import numpy as np
from jaxtyping import Bool, Int
from scipy import sparse
from scipy.spatial import KDTree

from jaxba._errors import JaxbaError
from jaxba.ba._problem import Observations, Problem
from jaxba.ba._projection import camera_centers
from jaxba.ba._system import is_traced
from jaxba.ba.checks import validate
from jaxba.ba.tiles._cut import rows_about, sub_problem
from jaxba.ba.tiles._dissect import dissect_images
from jaxba.ba.tiles._flight_lines import along_lines
from jaxba.geometry import require_number

BY = ("space", "flight-line")
_JUDGED_BY = 256  # observations of an image that tell on which side of a plane it lies, where images are counted
_AT_LEAST = 3  # images that each neighbour gives first: two tiles are laid onto each other by what they share


@dataclasses.dataclass(frozen=True)
class BlockTile:
    """A tile of a block, a problem of its own.

    - `images`, `points`: the numbers, in the block, of the tile's images and points, ascending.
    - `own`: which of its images are the tile's own; the others overlap into it. Each image of the block is the own one
      of exactly one tile.

    Its cameras are those of its images, in the block's order: `np.unique(block.camera_index[images])`.
    """

    problem: Problem
    images: Int[np.ndarray, " images"]
    points: Int[np.ndarray, " points"]
    own: Bool[np.ndarray, " images"]


@dataclasses.dataclass(frozen=True, eq=False)
class Partition:
    """A block in tiles.

    - `block`: the problem that was cut. `owner`: the tile whose own each of its images is.
    - `is_separator`: images in more than one tile.
    - `is_cut`: points that own images of more than one tile see.
    - `is_left_out`: points that are seen twice or more, but by no two images of one tile.
    """

    block: Problem
    tiles: tuple[BlockTile, ...]
    owner: Int[np.ndarray, " images"]
    is_separator: Bool[np.ndarray, " images"]
    is_cut: Bool[np.ndarray, " points"]
    is_left_out: Bool[np.ndarray, " points"]


def partition(
    problem: Problem,
    *,
    max_observations: float | None = None,
    max_images: int | None = None,
    by: Literal["space", "flight-line"] = "space",
    overlap: int = 50,
) -> Partition:
    """Cut a block into tiles that overlap; equal blocks are cut alike.

    - `max_observations`, `max_images`: what the own images of a tile may have, or be, at most; give one of them. Images
      that overlap into it come on top, as in COLMAP.
    - `by`: `space` cuts by planes that few images see across. `flight-line` takes consecutive lines together, for
      images that stand in the order of the flight; a line is cut only where it alone is too large.
    - `overlap`: images that a tile takes over from all its neighbours together, COLMAP's `image_overlap` of a cluster:
      those that share most points with its own, more from a neighbour that shares more, and at first three from each.

    A tile has the points that at least two of its images see, all observations of these points in its images, and the
    priors of its images, points and cameras; those of the lever arm are in every tile.

    Raises `JaxbaError` for a problem that contradicts itself, and for sizes that leave tiles one image, or no more
    than overlap into them.

    >>> import jaxba
    >>> found = jaxba.partition(jaxba.synthetic.uav_block(40).problem, max_images=20, overlap=6)
    >>> [(int(tile.own.sum()), len(tile.own)) for tile in found.tiles]
    [(20, 26), (20, 26)]
    """
    if is_traced(problem):
        raise JaxbaError("partition: the problem is traced, as inside jit, vmap and derivatives; cut it before.")
    if by not in BY:
        raise JaxbaError(f"partition: by {by!r}: choose {' or '.join(BY)}.")
    size = _Size.of_options(max_images, max_observations)
    require_number("partition: overlap", overlap, 0.0, 2.0**31 - 1, "give a whole number of images", whole=True)
    validate(problem)
    if problem.num_bar_ends:
        raise JaxbaError(
            "partition: the block has scale bars, whose points may come to lie in different tiles; jaxba.solve_tiled "
            "solves it whole, or leave the prior scale_bar out."
        )
    if problem.num_images < 2:
        raise JaxbaError("partition: the block has one image; there is nothing to cut.")
    owner = _along_the_flight(problem, size) if by == "flight-line" else _by_space(problem, size)
    own = np.bincount(owner)
    if len(own) > 1:
        _refuse_small(problem, own, size, int(overlap))

    image, point = np.asarray(problem.observations.image_index), np.asarray(problem.observations.point_index)
    ones = np.ones(len(image), np.int32)
    sees = sparse.csr_array((ones, (image, point)), shape=(problem.num_images, problem.num_points))
    of_own = sparse.csr_array((ones, (point, owner[image])), shape=(problem.num_points, len(own)))
    of_own.data[:] = 1
    is_of_tile = _taken_over(sees, of_own, owner, int(overlap))
    is_of_tile[owner, np.arange(problem.num_images)] = True
    tiles = tuple(_tile(problem, is_of_tile[number], owner == number) for number in range(len(own)))
    is_held = np.zeros(problem.num_points, bool)
    for tile in tiles:
        is_held[tile.points] = True
    return Partition(
        block=problem,
        tiles=tiles,
        owner=owner,
        is_separator=is_of_tile.sum(axis=0) > 1,
        is_cut=np.bincount(of_own.nonzero()[0], minlength=problem.num_points) > 1,
        is_left_out=(np.bincount(point, minlength=problem.num_points) > 1) & ~is_held,
    )


@dataclasses.dataclass(frozen=True)
class _Size:
    """What the own images of a tile may be at most: so many, or with so many observations."""

    most: float
    of: Literal["images", "observations"]

    @staticmethod
    def of_options(max_images: Any, max_observations: Any) -> "_Size":
        if max_images is not None and max_observations is None:
            cure = "give a whole number of images, 2 or more"
            require_number("partition: max_images", max_images, 2.0, 2.0**31 - 1, cure, whole=True)
            return _Size(float(max_images), "images")
        if max_images is None and max_observations is not None:
            cure = "give a number of observations"
            require_number("partition: max_observations", max_observations, 1.0, np.inf, cure)
            return _Size(float(max_observations), "observations")
        given = "neither is given" if max_images is None else f"{max_images} and {max_observations:g} are given"
        raise JaxbaError(f"partition: max_images and max_observations: {given}; give one of them.")


def _along_the_flight(problem: Problem, size: _Size) -> Int[np.ndarray, " images"]:
    """Return the tile of each image, cut at the ends of flight lines."""
    counts = np.ones(problem.num_images)
    if size.of == "observations":
        counts = np.bincount(np.asarray(problem.observations.image_index), minlength=problem.num_images) * 1.0
    return along_lines(camera_centers(problem.poses), counts, size.most)


def _by_space(problem: Problem, size: _Size) -> Int[np.ndarray, " images"]:
    """Return the tile of each image, cut by planes. One that sees nothing is taken to see what its neighbour sees."""
    image, point = np.asarray(problem.observations.image_index), np.asarray(problem.observations.point_index)
    counts = np.bincount(image, minlength=problem.num_images)
    blind, seeing = np.flatnonzero(counts == 0), np.flatnonzero(counts)
    if len(blind):
        centers = camera_centers(problem.poses)
        like = seeing[KDTree(centers[seeing]).query(centers[blind])[1]]
        rows = [np.flatnonzero(image == neighbour) for neighbour in like]
        image = np.append(image, np.repeat(blind, [len(of_one) for of_one in rows])).astype(np.int32)
        point = np.append(point, point[np.concatenate(rows)])
        counts = np.bincount(image)
        nothing = np.zeros((len(image), 2))
        problem = dataclasses.replace(problem, observations=Observations(nothing, nothing[:, 0], image, point))
    rows = np.argsort(image, kind="stable")
    if size.of == "observations":
        return dissect_images(problem, rows, size.most)
    first = np.cumsum(counts) - counts
    spread = first[:, None] + (np.arange(_JUDGED_BY) * counts[:, None]) // _JUDGED_BY  # as many of each image
    return dissect_images(problem, rows[spread.ravel()], size.most * _JUDGED_BY)


def _refuse_small(problem: Problem, own: Int[np.ndarray, " tiles"], size: _Size, overlap: int) -> None:
    """Raise `JaxbaError` where tiles have one image of their own, or no more than overlap into them."""
    small, typical = np.count_nonzero(own < 2), int(np.median(own))
    if typical < 2 or (small and not overlap):
        counts = np.bincount(np.asarray(problem.observations.image_index), minlength=problem.num_images)
        largest = int(np.argmax(counts))
        alone = f": {problem.image_label(largest)} alone has {counts[largest]}" if size.of == "observations" else ""
        raise JaxbaError(
            f"partition: max_{size.of} {size.most:g} leaves {small} of {len(own)} tiles one image of their own; give "
            f"more{alone}."
        )
    if overlap >= typical:
        raise JaxbaError(
            f"partition: overlap {overlap}: the tiles have {typical} images of their own (median), and fewer must "
            f"overlap. Give an overlap such as {max(typical // 4, 1)}, or larger tiles."
        )


def _taken_over(
    sees: sparse.csr_array, of_own: sparse.csr_array, owner: Int[np.ndarray, " images"], overlap: int
) -> Bool[np.ndarray, "tiles images"]:
    """Return which images each tile takes over.

    - `sees`: 1 where an image sees a point. `of_own`: 1 where some own image of a tile does.
    """
    num_images, num_tiles = len(owner), int(owner.max()) + 1
    shared: Any = sparse.coo_array(sees @ of_own)  # points that an image sees as well as some own image of a tile
    image, tile, points = shared.row, shared.col, shared.data
    other = owner[image] != tile
    image, tile, points = image[other], tile[other], points[other]
    order = np.lexsort((image, -points, owner[image], tile))
    image, tile = image[order], tile[order]
    of_pairs: Any = of_own.T @ of_own  # points that two tiles have in common
    in_common = of_pairs.toarray()[tile, owner[image]]
    place = _places(tile * num_tiles + owner[image])  # of an image among those of its neighbour
    order = np.lexsort((image, (place + 1) / in_common, place >= _AT_LEAST, tile))
    image, tile = image[order], tile[order]
    chosen = _places(tile) < overlap
    found = np.zeros((num_tiles, num_images), bool)
    found[tile[chosen], image[chosen]] = True
    return found


def _places(sorted_keys: Int[np.ndarray, " entries"]) -> Int[np.ndarray, " entries"]:
    """Return how many entries of the same key stand before each."""
    places = np.arange(len(sorted_keys))
    starts = np.flatnonzero(np.diff(sorted_keys, prepend=-1))
    return places - np.repeat(starts, np.diff(starts, append=len(places)))


def _tile(problem: Problem, is_of_tile: Bool[np.ndarray, " images"], is_own: Bool[np.ndarray, " images"]) -> BlockTile:
    image, point = np.asarray(problem.observations.image_index), np.asarray(problem.observations.point_index)
    rows = np.flatnonzero(is_of_tile[image])
    has_point = np.bincount(point[rows], minlength=problem.num_points) >= 2
    rows = rows[has_point[point[rows]]]
    images, points = np.flatnonzero(is_of_tile), np.flatnonzero(has_point)
    camera_index = np.asarray(problem.camera_index)
    cameras = np.unique(camera_index[images])
    has_camera = np.zeros(problem.num_cameras, bool)
    has_camera[cameras] = True
    kept = {"image_index": is_of_tile, "point_index": has_point, "camera_index": has_camera}
    of_priors = [rows_about(prior, kept, shared=True) for prior in problem.priors]
    found = sub_problem(problem, rows, images, points, cameras, of_priors)
    names = tuple(problem.image_names[number] for number in images) if problem.image_names else ()
    return BlockTile(dataclasses.replace(found, image_names=names), images, points, is_own[images])
