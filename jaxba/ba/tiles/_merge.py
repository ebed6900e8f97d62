"""`merge_tiles`: tiles that were adjusted each on its own become one block again.

1. **Similarities.** Each tile goes by a similarity onto the block's frame (`_ties.py`).
2. **Values.** Images and points that several tiles have get the mean of what these say, by the observations that each
   has of them; rotations a mean of matrices. Cameras and the lever arm likewise. A tile that contradicts the one with
   most observations has no part in a mean. Points that no tile has are intersected from the merged images.
3. **A pass over the block** (`_global_pass.py`): all points with every image held, then the images where tiles meet
   with the points that they see.

What it costs beside an exact adjustment: a tile knows nothing of what lies beyond it, so its cameras, its tilt and its
bends are its own, and a similarity takes out seven of these unknowns. `solve_tiled` gives the answer of the block in
one piece, and starts well from merged values.
"""

import dataclasses
from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Int

from jaxba._errors import JaxbaError
from jaxba.ba._problem import Problem
from jaxba.ba._solution import Solution
from jaxba.ba._solvers import require_stops
from jaxba.ba._system import is_traced
from jaxba.ba.checks import validate
from jaxba.ba.tiles._frames import frame_of_block, frame_of_tile
from jaxba.ba.tiles._global_pass import adjust_points, adjust_shared, intersect, shared_images
from jaxba.ba.tiles._means import means
from jaxba.ba.tiles._partition import BlockTile
from jaxba.ba.tiles._ties import LEAST_IMAGES, LEAST_POINTS, place
from jaxba.geometry import AbstractLoss, Linear, Similarity, check_loss

_ANOTHER = "it was cut from another block. Give the tiles of this one, cut again if it has changed."


@dataclasses.dataclass(frozen=True, eq=False)
class MergedTile:
    """Where a tile went.

    - `similarity`: `block_from_tile`.
    - `num_shared_images`, `num_shared_points`: that other tiles have as well.
    - `misfit_m`: of its shared images, moved, from the means over tiles: rms distance of centres; 0 without any.
    """

    similarity: Similarity
    num_shared_images: int
    num_shared_points: int
    misfit_m: float


@dataclasses.dataclass(frozen=True, eq=False)
class Merged:
    """A block merged from tiles.

    - `problem`: the block with the merged values.
    - `tiles`: where each went. `by_priors`: whether priors and what is fixed gave the frame; else it is tile `root`'s.
    - `std_m`: by how much tiles differ at shared centres and points, sigma an axis.
    - `num_contradictions`: values of a tile that had no part in a mean, as another tile with more observations is far.
    - `intersected`, `untouched`: points that no tile has, from merged images or, where these tell nothing, as given.
    - `shared`: free images where tiles meet: those of several tiles, and those that see a point whose images no tile
      has together (none where tiles overlap widely).
    - `solutions`: of the global pass, none without it: of the points, then of the shared images and their points. The
      last is of a part of the block, which its report holds.
    """

    problem: Problem
    tiles: tuple[MergedTile, ...]
    by_priors: bool
    root: int
    std_m: tuple[float, float]
    num_contradictions: int
    intersected: Int[np.ndarray, " _"]
    untouched: Int[np.ndarray, " _"]
    shared: Bool[np.ndarray, " images"]
    solutions: tuple[Solution, ...]

    def summary(self) -> list[str]:
        """Return sentences on the tiles, the frame, and what tiles did not tell."""
        frame = "the block's, by its priors" if self.by_priors else f"that of tile {self.root}"
        lines = [f"{len(self.tiles)} tiles are merged; the frame is {frame}"]
        for number, tile in enumerate(self.tiles):
            one = tile.similarity
            lines.append(
                f"tile {number}: {tile.num_shared_images} shared images miss by {tile.misfit_m:.3g} m (rms); scale "
                f"{one.scale:.6f}, turned by {np.degrees(one.angle_rad):.3g} degrees"
            )
        if self.num_contradictions:
            lines.append(
                f"{self.num_contradictions} positions of a tile are left out of the mean: another tile, which has more "
                "observations of them, contradicts it"
            )
        if len(self.intersected):
            lines.append(f"{len(self.intersected)} points that no tile has are intersected from the merged images")
        if len(self.untouched):
            lines.append(f"{len(self.untouched)} points that no tile has keep their values: no two images tell them")
        return lines


def merge_tiles(
    problem: Problem,
    tiles: Sequence[BlockTile],
    *,
    loss: AbstractLoss | None = None,
    global_pass: bool = True,
    max_nfev: int = 500,
    ftol: float = 1e-8,
    xtol: float = 1e-8,
    gtol: float = 1e-10,
) -> Merged:
    """Merge tiles that were adjusted each on its own into the block that they were cut from.

    - `problem`: the block. `tiles`: its tiles, their problems with adjusted values (`solution.apply(tile.problem)`).
    - `global_pass`: whether the block is adjusted at last: its points, then the images where tiles meet.
    - `loss`, `max_nfev`, `ftol`, `xtol`, `gtol`: of this pass, as in `solve`.

    The frame is the block's where its priors, or what is held fixed, place a tile; else that of the tile with most
    images. This is the quick answer: `solve_tiled` gives the exact one.

    Raises `JaxbaError` where tiles belong to another block, an image is in no tile, values are not finite, where groups
    of tiles have too little in common, and where the block's position offset is free.

    >>> import jaxba
    >>> problem = jaxba.synthetic.uav_block(30).problem
    >>> tiles = jaxba.partition(problem, max_images=20, overlap=4).tiles
    >>> solutions = jaxba.solve_batch([tile.problem for tile in tiles])
    >>> solved = [dataclasses.replace(t, problem=s.apply(t.problem)) for t, s in zip(tiles, solutions)]
    >>> merged = jaxba.merge_tiles(problem, solved)
    >>> merged.by_priors, len(merged.tiles) == len(tiles)
    (True, True)
    """
    loss = Linear() if loss is None else loss
    check_loss("merge_tiles: loss", loss)
    if is_traced((problem, loss, [tile.problem for tile in tiles])):
        raise JaxbaError("merge_tiles: a problem is traced, as inside jit, vmap and derivatives; merge outside of it.")
    max_nfev = require_stops("merge_tiles", max_nfev=max_nfev, ftol=ftol, xtol=xtol, gtol=gtol)
    _require_of_block(problem, tiles)
    if problem.free.position_offset:
        raise JaxbaError(
            "merge_tiles: the position offset is free, and each tile has found one of its own; jaxba.solve_tiled finds "
            "one for the whole block, or hold it fixed (free.position_offset) before tiles are cut."
        )

    placed = place([frame_of_tile(tile) for tile in tiles], frame_of_block(problem))
    if placed.similarities is None:
        raise JaxbaError(_apart(placed.groups))
    mean = means(problem, tiles, placed.similarities, placed.std_m)
    missing = np.flatnonzero(~mean.has_point & np.asarray(problem.free.points))
    merged, found = intersect(mean.problem, missing)
    shared = shared_images(problem, tiles) & np.asarray(problem.free.poses)
    solutions: list[Solution | None] = []
    if global_pass:
        stops = {"max_nfev": max_nfev, "ftol": ftol, "xtol": xtol, "gtol": gtol}
        solutions.append(adjust_points(merged, loss, stops))
        merged = merged if solutions[0] is None else solutions[0].apply(merged)
        merged, of_shared = adjust_shared(merged, shared, loss, stops)
        solutions.append(of_shared)
    places = zip(placed.similarities, mean.num_shared_images, mean.num_shared_points, mean.misfit_m, strict=True)
    return Merged(
        problem=merged,
        tiles=tuple(MergedTile(one, int(images), int(points), float(off)) for one, images, points, off in places),
        by_priors=placed.by_priors,
        root=placed.root,
        std_m=placed.std_m,
        num_contradictions=mean.num_contradictions,
        intersected=missing[found],
        untouched=missing[~found],
        shared=shared,
        solutions=tuple(solution for solution in solutions if solution is not None),
    )


def _apart(groups: list[list[int]]) -> str:
    names = ["tile " + str(group[0]) if len(group) == 1 else "tiles " + ", ".join(map(str, group)) for group in groups]
    return (
        f"merge_tiles: {'; '.join(names[:4])}{'; ...' if len(names) > 4 else ''} have too little in common: what ties "
        f"two tiles is {LEAST_IMAGES} images or {LEAST_POINTS} points, and what places one by itself is three of its "
        "positions measured by priors. Cut tiles that overlap more, or give the block positions."
    )


def _require_of_block(problem: Problem, tiles: Sequence[BlockTile]) -> None:
    """Raise `JaxbaError` where tiles are not parts of the block, or do not hold all its images."""
    validate(problem)
    if not len(tiles):
        raise JaxbaError("merge_tiles: tiles are empty; give the block's tiles, such as those of jaxba.partition.")
    seen = problem.observations
    key = np.asarray(seen.image_index).astype(np.int64) * problem.num_points + np.asarray(seen.point_index)
    order = np.argsort(key)
    has = np.zeros(problem.num_images, bool)
    for number, tile in enumerate(tiles):
        label = f"merge_tiles: tile {number} of {len(tiles)}"
        try:
            validate(tile.problem)
        except JaxbaError as error:
            raise JaxbaError(f"{label}: {error}") from error
        _require_numbers(f"{label}: images", tile.images, tile.problem.num_images, problem.num_images)
        _require_numbers(f"{label}: points", tile.points, tile.problem.num_points, problem.num_points)
        model, of_block = type(tile.problem.cameras).__name__, type(problem.cameras).__name__
        if model != of_block:
            raise JaxbaError(f"{label} has {model} cameras, and the block {of_block}: {_ANOTHER}")
        names, of_tile = problem.image_names, tile.problem.image_names
        if names and of_tile:
            for own, image in zip(of_tile, tile.images.tolist(), strict=True):
                if own != names[image]:
                    raise JaxbaError(f"{label}: {own} is {problem.image_label(image)} of the block: {_ANOTHER}")
        inside = tile.problem.observations
        image, point = tile.images[inside.image_index], tile.points[inside.point_index]
        wanted = image.astype(np.int64) * problem.num_points + point
        place = order[np.minimum(np.searchsorted(key, wanted, sorter=order), len(key) - 1)]
        strange = (key[place] != wanted) | np.any(np.asarray(seen.xy_px)[place] != np.asarray(inside.xy_px), axis=1)
        if strange.any():
            first = int(np.flatnonzero(strange)[0])
            x, y = np.asarray(inside.xy_px, float)[first]
            raise JaxbaError(
                f"{label}: {np.count_nonzero(strange)} of its observations are none of the block, first: point "
                f"{point[first]} at {x:.2f}, {y:.2f} px in {problem.image_label(int(image[first]))}; {_ANOTHER}"
            )
        has[tile.images] = True
    missing = np.flatnonzero(~has)
    if len(missing):
        more = f" (and {len(missing) - 1} more)" if len(missing) > 1 else ""
        raise JaxbaError(
            f"merge_tiles: {problem.image_label(int(missing[0]))}{more} is in no tile; give all tiles of the block."
        )


def _require_numbers(label: str, numbers: Int[np.ndarray, " n"], own: int, of_block: int) -> None:
    kind = label.rsplit(" ", 1)[1]
    if len(numbers) != own:
        raise JaxbaError(f"{label}: {len(numbers)} numbers for {own} {kind} of its problem; give one for each.")
    wrong = np.flatnonzero((numbers < 0) | (numbers >= of_block))
    if len(wrong):
        raise JaxbaError(
            f"{label}: number {numbers[wrong[0]]}, but the block has {of_block} {kind}, counted from 0: {_ANOTHER}"
        )
    if len(np.unique(numbers)) != own:
        raise JaxbaError(f"{label}: a number stands twice; give each of the {kind} once.")
