"""The marginals of a block: the diagonal blocks of (J^T J)^-1, and what rows have to do with it, tile by tile.

Up, everything but the border is eliminated as for a step (`_engine.py`), undamped. Down, each node gets the inverse
over its own images, its boundary and the border from that of its parent (`_fronts.py`), and each tile the covariances
of its points from the blocks of the inverse that its own images have in common (`_point_marginals.py`). The inverse
of the whole is nowhere: of a node's part its children's parts are taken, and it goes.
"""

from collections.abc import Callable, Iterator
from typing import Literal, NamedTuple

import jax
import numpy as np
from jaxtyping import Float

from jaxba.ba._compiler import call_compiled, result_shapes
from jaxba.ba._linearise import Linearisation
from jaxba.ba._plan_shape import num_rows
from jaxba.ba._problem import Problem
from jaxba.ba._system import System
from jaxba.ba._unknowns import Unknowns
from jaxba.ba.tiles._dense import NotPositive
from jaxba.ba.tiles._engine import Call, Engine
from jaxba.ba.uncertainty._leverage import Leverage, pixel_leverage, prior_leverages
from jaxba.ba.uncertainty._point_marginals import (
    InverseBlocks,
    Joint,
    Squares,
    joint_marginals,
    point_marginals,
    squares,
)
from jaxba.ba.uncertainty._track_scores import TrackSums, track_sums

Rows = Literal["none", "priors", "all"]
"""Whose leverages are asked for: of all rows those of the reprojections come first."""


class Marginals(NamedTuple):
    """Covariances in the problem's order.

    - `blocks`: of images. `border`: joint, of the shared unknowns.
    - `block_inflation`, `border_inflation`: each variance over what it were if all other unknowns were known.
    - `squares`: of the reprojections and the priors, by tiles.
    - `leverages`: of the rows that were asked for, in the problem's order. `tracks`: the sums, where these were.
    """

    blocks: Float[np.ndarray, "images block block"]
    border: Float[np.ndarray, "border border"]
    points: Float[np.ndarray, "points 3 3"]
    block_inflation: Float[np.ndarray, "images block"]
    border_inflation: Float[np.ndarray, " border"]
    squares: tuple[Squares, ...]
    leverages: tuple[Leverage, ...] = ()
    tracks: TrackSums | None = None


class _OfTile(NamedTuple):
    number: int
    blocks: Float[np.ndarray, "images block block"]
    """Of the images in the tile's order; right for those that are eliminated in it."""
    points: Float[np.ndarray, "points 3 3"]
    squares: tuple[Squares, ...]
    leverages: tuple[Leverage, ...]
    tracks: TrackSums | None


def calls_of_marginals(
    rows: Rows = "none", *, by_tracks: bool = False
) -> Callable[[System, Unknowns, Linearisation], list[Call]]:
    """Return what tells `compile_tiles` what `marginals` calls."""

    def calls(system: System, part: Unknowns, model: Linearisation) -> list[Call]:
        shape = system.shape
        images = shape.num_images, shape.block
        inverse = InverseBlocks(
            np.zeros((*images, shape.block)),
            np.zeros((shape.num_blocks, shape.block, shape.block)),
            np.zeros((*images, shape.border)),
            np.zeros((shape.border, shape.border)),
        )
        of_points = system, model, inverse, np.zeros(())
        found = [Call(squares, (system, part))]
        if rows != "all" and not by_tracks:
            points = result_shapes(point_marginals, *of_points)
            found.append(Call(point_marginals, of_points))
        else:
            joint = result_shapes(joint_marginals, *of_points)
            points = joint.points
            found.append(Call(joint_marginals, of_points))
            if by_tracks:
                found.append(Call(track_sums, (system, part, inverse, joint)))
            if rows == "all":
                found.append(Call(pixel_leverage, (system, part, inverse, joint)))
        if rows != "none":
            found.append(Call(prior_leverages, (system, part, inverse, points)))
        return found

    return calls


def marginals(
    engine: Engine,
    problem: Problem,
    unknowns: Unknowns,
    damping: float = 0.0,
    rows: Rows = "none",
    *,
    by_tracks: bool = False,
) -> Marginals:
    """Return the marginals at some unknowns.

    - `problem`: the engine's. `damping`: that every diagonal is raised by, as a share of it. `by_tracks`: whether the
      sums over tracks are asked for.

    Raises `NotPositive` where the equations have no inverse.
    """
    shape, tree, fronts = engine.shape, engine.tree, engine.fronts
    up = engine.up(engine.each_part("step_up", unknowns, np.array(damping), np.zeros(())), np.array(damping))
    corner = inverse_of_border(up.update[: shape.border, : shape.border])
    tail = np.zeros((fronts.tail * shape.block,) * 2)
    tail[: shape.border, : shape.border] = corner
    blocks = np.zeros((len(tree.rank), shape.block, shape.block))

    def descend() -> Iterator[tuple[int, np.ndarray]]:
        """Yield the tiles with the inverse over their boundary and the tail; fill in what lies above them."""
        of_rest = {len(tree.nodes) - 1: tail}
        for number in reversed(engine.tops):
            rest = of_rest.pop(number)
            if number in engine.tile_of_node:
                yield engine.tile_of_node[number], rest
                continue
            whole = fronts.inverse(engine.factor(number), rest, engine.pool)
            node = tree.nodes[number]
            blocks[node.eliminated] = fronts.diagonal_blocks(whole)[: len(node.eliminated)]
            of_rest |= {child: fronts.of_child(child, whole) for child in node.children}
            if whole is not rest:
                fronts.memory.give_back(whole)

    def of_tile(number: int, rest: np.ndarray) -> _OfTile:
        return _of_tile(engine, unknowns, number, rest, corner, damping, rows, by_tracks=by_tracks)

    points = np.zeros((len(tree.tile_of_point), 3, 3))
    parts: list[tuple[Squares, ...]] = [()] * len(engine.tiles)
    sums: list[TrackSums | None] = [None] * len(engine.tiles)
    of_rows = _empty(problem, rows)
    for found in engine.each_tile(of_tile, descend()):
        tile, _ = engine.tiles[found.number]
        own = tree.node_of_image[tile.order] <= tree.tiles[found.number]
        blocks[tile.order[own]] = found.blocks[own]
        points[tile.points[tile.plan.point_order]] = found.points
        parts[found.number], sums[found.number] = found.squares, found.tracks
        places = (tile.rows, *tile.prior_rows) if rows == "all" else tile.prior_rows
        for whole, part, place in zip(of_rows, found.leverages, places, strict=bool(of_rows)):
            for all_rows, own_rows in zip(whole, part, strict=True):
                all_rows[place] = own_rows
    groups = [Squares(*map(np.concatenate, zip(*group, strict=True))) for group in zip(*parts, strict=True)]
    return Marginals(
        blocks,
        corner,
        points,
        np.diagonal(blocks, axis1=1, axis2=2) * up.diagonal,
        np.diagonal(corner) * up.border_diagonal,
        tuple(groups),
        of_rows,
        TrackSums(*map(sum, zip(*sums, strict=True))) if by_tracks else None,  # type: ignore[arg-type]
    )


def _empty(problem: Problem, rows: Rows) -> tuple[Leverage, ...]:
    """Return arrays for the leverages of all rows."""
    if rows == "none":
        return ()
    own = Unknowns(problem.poses, np.zeros(problem.free.intrinsics.shape), problem.antenna, problem.points)
    shapes = [(num_rows(prior), jax.eval_shape(prior.residual, own).shape[0]) for prior in problem.priors]
    if rows == "all":
        shapes.insert(0, (problem.num_observations, 2))
    return tuple(Leverage(np.zeros((n, c)), np.zeros((n, c, c)), np.zeros((n, 3, c))) for n, c in shapes)


def _of_tile(
    engine: Engine,
    unknowns: Unknowns,
    number: int,
    rest: np.ndarray,
    corner: np.ndarray,
    damping: float,
    rows: Rows,
    *,
    by_tracks: bool,
) -> _OfTile:
    shape, fronts = engine.shape, engine.fronts
    tile, of_tile = engine.tiles[number]
    plan = tile.plan.shape
    images = np.zeros((plan.num_images, shape.block, shape.block))
    pairs = np.zeros((plan.num_blocks, shape.block, shape.block))
    border = np.zeros((plan.num_images, shape.block, shape.border))
    of_rest = {of_tile.last: rest}
    for node in reversed(range(of_tile.first, of_tile.last + 1)):
        rest = of_rest.pop(node)
        whole = fronts.inverse(engine.factor(node), rest)
        part = of_tile.parts[node - of_tile.first]
        fronts.take_blocks(node, whole, part, pairs)
        images[part.images] = fronts.diagonal_blocks(whole)[part.place]
        by_image = whole.reshape(-1, shape.block, len(whole))[part.place]
        end = len(whole) - fronts.tail * shape.block
        border[part.images] = by_image[:, :, end : end + shape.border]
        of_rest |= {child: fronts.of_child(child, whole) for child in engine.tree.nodes[node].children}
        if whole is not rest:
            fronts.memory.give_back(whole)
    system, own = engine.system(number), tile.take(unknowns)
    model = engine.equations(number, own, np.zeros(()))
    inverse = InverseBlocks(images, pairs, border, corner)
    found = jax.tree.map(np.asarray, call_compiled(squares, system, own))
    of_points = system, model, inverse, np.array(damping)
    groups: list[Leverage] = []
    tracks: TrackSums | None = None
    takes: list[np.ndarray] = []
    if rows == "all" or by_tracks:
        joint: Joint = call_compiled(joint_marginals, *of_points)
        points = joint.points
    else:
        points = call_compiled(point_marginals, *of_points)
    if by_tracks:
        tracks = jax.tree.map(np.asarray, call_compiled(track_sums, system, own, inverse, joint))
    if rows == "all":
        groups.append(call_compiled(pixel_leverage, system, own, inverse, joint))
        seen = np.flatnonzero(tile.plan.row_observation >= 0)
        takes.append(seen[np.argsort(tile.plan.row_observation[seen])])
    if rows != "none":
        groups += call_compiled(prior_leverages, system, own, inverse, points)
        takes += [np.arange(len(places)) for places in tile.prior_rows]  # what follows is padding
    of_rows = tuple(Leverage(*(np.asarray(part)[take] for part in of)) for of, take in zip(groups, takes, strict=True))
    count = len(tile.order)
    return _OfTile(number, images[:count], np.asarray(points)[: len(tile.points)], found, of_rows, tracks)


def inverse_of_border(corner: Float[np.ndarray, "border border"]) -> Float[np.ndarray, "border border"]:
    """Return the inverse of a symmetric matrix, of which the lower triangle is read, scaled to a diagonal of ones.

    Raises `NotPositive`.
    """
    scale = np.diagonal(corner)
    if not np.all(scale > 0):
        raise NotPositive
    scale = 1 / np.sqrt(scale)
    try:
        root = np.linalg.cholesky(corner * scale[:, None] * scale)  # numpy reads the lower triangle alone
    except np.linalg.LinAlgError as error:
        raise NotPositive from error
    half = np.linalg.solve(root, np.diag(scale))
    return half.T @ half
