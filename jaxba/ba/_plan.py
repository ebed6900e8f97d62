"""Plan: everything about a problem's structure that the solver needs and that its values do not change.

Made once on the host, in numpy, from who sees what: the order of the images, the order and padding of the observations,
the pairs of observations that couple two images through a point, the shape of the reduced system and how to solve it.

**Order.** Images are ordered so that the reduced system is narrow around its diagonal; the observations are sorted by
image and each image's are padded to whole runs of `ROW_RUN`, so that sums over an image are sums over contiguous runs;
points are sorted by the first image that sees them.

**Pairs.** An off-diagonal block (i, j) of the reduced system is a sum over the points that images i and j share. The
pairs of observations of one block form runs of `PAIR_RUN`, padded with a row of zeros: a small matrix product a run.

**Shapes.** Compiling costs seconds, so every count is rounded up to one of eight sizes an octave. What is added weighs
nothing and has finite derivatives: observations of weight zero, points and images that nothing sees.

Cost: O(observations log observations + pairs log pairs); 0.1 s for 500 images, 106k observations and 188k pairs.
"""

import dataclasses
from typing import Literal, NamedTuple, get_args

import equinox as eqx
import numpy as np
from jax import Array
from jax.core import Tracer
from jaxtyping import Bool, Int
from scipy import sparse
from scipy.sparse.csgraph import reverse_cuthill_mckee

from jaxba._errors import JaxbaError
from jaxba.ba._plan_shape import SMALL_IMAGES, PlanShape, bare_shape, bucket
from jaxba.ba._problem import Problem
from jaxba.ba._projection import camera_centers
from jaxba.geometry import require_number

ROW_RUN = 32
CHUNK_RUNS = 64  # runs computed at a time: 36 numbers a row, 0.6 MB
PAIR_RUN = 16  # 8 take 10% longer where a block has 16 pairs, 30% where it has 280; 32 take longer where it has 16
PAIR_CHUNK = 256  # pair runs gathered at a time: 1.2 MB of 6x3 blocks, about the size of a level-two cache

LinearSolver = Literal["auto", "dense", "banded", "cg"]


class Orders(eqx.Module):
    """Where everything of a problem stands in the solver; `shape` is static."""

    image_order: Int[Array | np.ndarray, " images"]
    """Original index of each image, in solver order (without padding)."""
    point_order: Int[Array | np.ndarray, " points"]
    camera_order: Int[Array | np.ndarray, " cameras"]
    """Original index of each camera in solver order: that of the images where each has its own."""
    row_observation: Int[Array | np.ndarray, " rows"]
    """Original index of the observation in each row, -1 for padding."""
    shape: PlanShape = eqx.field(static=True)


class Plan(Orders):
    """Index arrays of a problem's structure: its orders, and who meets whom."""

    row_image: Int[Array | np.ndarray, " rows"]
    row_point: Int[Array | np.ndarray, " rows"]
    point_image: Int[Array | np.ndarray, " padded_points"]
    """The image that sees each point and comes first in the problem; both in solver order, padding included."""
    pair_first: Int[Array | np.ndarray, "chunks pair_chunk pair_run"]
    pair_second: Int[Array | np.ndarray, "chunks pair_chunk pair_run"]
    """Rows of each pair; the first one's image comes later in the order. Padding is the last row, of weight zero."""
    pair_block: Int[Array | np.ndarray, " pair_runs"]
    block_row: Int[Array | np.ndarray, " blocks"]
    block_column: Int[Array | np.ndarray, " blocks"]
    """Images of each off-diagonal block, row > column; padding repeats the last image in both."""

    def orders(self) -> Orders:
        """Return the orders alone, without what takes the memory."""
        return Orders(**{field.name: getattr(self, field.name) for field in dataclasses.fields(Orders)})


def make_plan(
    problem: Problem,
    *,
    linear_solver: LinearSolver = "auto",
    like: PlanShape | None = None,
    spare: float = 0.0,
    image_order: Int[np.ndarray, " images"] | None = None,
) -> Plan:
    """Return the plan of a problem, whose indices and `free` masks must be concrete (not traced).

    For a series of like problems, whose observations come and go, that shall share compiled code: `spare` leaves room
    for this share of points, observations and pairs more, and `like`, the shape of an earlier plan of the series, gives
    the least sizes, the intrinsics that are refined and the linear solver. What outgrows it gets a shape of its own.
    `image_order` is in place of the order that makes the reduced system narrow.

    Raises `JaxbaError` for options out of range.
    """
    if linear_solver not in get_args(LinearSolver):
        raise JaxbaError(
            f"make_plan: linear_solver {linear_solver!r}: choose one of {', '.join(get_args(LinearSolver))}."
        )
    require_number("make_plan: spare", spare, 0.0, 1e3, "give a share of 0 or more, such as 0.1")
    image = np.asarray(problem.observations.image_index)
    point = np.asarray(problem.observations.point_index)
    least = bare_shape(problem, like)
    layout = lay_out_images(problem, least, linear_solver, like=like, given=image_order)
    image_order, num_images = layout.order, layout.num_images

    rank_of_image = np.empty(problem.num_images, np.int32)
    rank_of_image[image_order] = np.arange(problem.num_images, dtype=np.int32)
    rank = rank_of_image[image]
    first_seen = np.full(problem.num_points, num_images, np.int32)
    np.minimum.at(first_seen, point, rank)
    point_order = np.argsort(first_seen, kind="stable").astype(np.int32)
    rank_of_point = np.empty(problem.num_points, np.int32)
    rank_of_point[point_order] = np.arange(problem.num_points, dtype=np.int32)
    num_points = max(bucket(_more(problem.num_points, spare) + 1), least.num_points)

    row_observation, row_image = _layout_rows(
        rank, rank_of_point[point], problem.num_images, num_images - 1, least.num_rows, spare
    )
    num_rows = len(row_observation)
    row_point = np.where(row_observation >= 0, rank_of_point[point[row_observation]], num_points - 1).astype(np.int32)

    use = (row_observation >= 0) & layout.coupled[row_observation]
    first, second, blocks_of_pairs = _pairs(row_image, row_point, np.flatnonzero(use), num_images)
    runs = _pair_runs(first, second, blocks_of_pairs, num_rows - 1, least.num_pair_runs, spare)
    num_blocks = max(bucket(_more(len(runs.blocks), spare)) if len(runs.blocks) else 0, least.num_blocks)
    blocks = np.full(num_blocks, num_images * num_images - 1, np.int64)
    blocks[: len(runs.blocks)] = runs.blocks

    shape = dataclasses.replace(
        least,
        num_images=num_images,
        num_points=num_points,
        num_rows=num_rows,
        chunk_runs=min(CHUNK_RUNS, num_rows // ROW_RUN),
        num_cameras=num_images if least.own_cameras else problem.num_cameras,
        num_pair_runs=len(runs.block_of_run),
        num_blocks=num_blocks,
        linear_solver=layout.linear_solver,
        panel_images=layout.panel_images,
        band_panels=layout.band_panels,
    )
    return Plan(
        image_order=image_order,
        point_order=point_order,
        camera_order=np.asarray(problem.camera_index)[image_order]
        if least.own_cameras
        else np.arange(problem.num_cameras),
        row_observation=row_observation,
        row_image=row_image,
        row_point=row_point,
        point_image=_point_images(image, point, rank_of_image, point_order, num_points),
        pair_first=runs.first,
        pair_second=runs.second,
        pair_block=runs.block_of_run,
        block_row=(blocks // num_images).astype(np.int32),
        block_column=(blocks % num_images).astype(np.int32),
        shape=shape,
    )


def widened(plan: Plan, shape: PlanShape) -> Plan:
    """Return a plan of a larger shape of the same kind, with as many images, as `larger` makes of two plans' shapes."""
    old, added = plan.shape, shape.num_rows - plan.shape.num_rows
    last = old.num_rows - 1

    def padded(values: Array | np.ndarray, size: int, fill: int) -> np.ndarray:
        return np.append(values, np.full(size - len(values), fill, np.int32))

    def pairs(rows: Array | np.ndarray) -> np.ndarray:
        rows = np.where(np.asarray(rows) == last, last + added, rows).reshape(-1, PAIR_RUN)
        filled = np.full((shape.num_pair_runs - len(rows), PAIR_RUN), last + added, np.int32)
        return np.concatenate([rows, filled]).reshape(-1, PAIR_CHUNK, PAIR_RUN)

    no_point, last_image = shape.num_points - 1, shape.num_images - 1
    return dataclasses.replace(
        plan,
        row_observation=padded(plan.row_observation, shape.num_rows, -1),
        row_image=padded(plan.row_image, shape.num_rows, last_image),
        row_point=padded(np.where(plan.row_observation < 0, no_point, plan.row_point), shape.num_rows, no_point),
        point_image=padded(plan.point_image, shape.num_points, 0),
        pair_first=pairs(plan.pair_first),
        pair_second=pairs(plan.pair_second),
        pair_block=padded(plan.pair_block, shape.num_pair_runs, int(plan.pair_block[-1])),
        block_row=padded(plan.block_row, shape.num_blocks, last_image),
        block_column=padded(plan.block_column, shape.num_blocks, last_image),
        shape=dataclasses.replace(shape, chunk_runs=min(CHUNK_RUNS, shape.num_rows // ROW_RUN)),
    )


class ImageLayout(NamedTuple):
    """How the images stand in the reduced system, and how it is solved.

    - `coupled`: observations whose point and image, or its own camera, are free. `num_images`: with padding.
    """

    order: Int[np.ndarray, " images"]
    coupled: Bool[np.ndarray, " observations"]
    num_images: int
    linear_solver: Literal["dense", "banded", "cg"]
    panel_images: int
    band_panels: int


def lay_out_images(
    problem: Problem,
    least: PlanShape,
    linear_solver: LinearSolver,
    *,
    like: PlanShape | None = None,
    given: Int[np.ndarray, " images"] | None = None,
) -> ImageLayout:
    """Return how the images of a problem stand in the reduced system; see `make_plan`, whose `image_order` is `given`.

    - `least`: of `bare_shape(problem, like)`.
    """
    image, point = np.asarray(problem.observations.image_index), np.asarray(problem.observations.point_index)
    coupled = np.asarray(problem.free.points)[point]
    if not least.own_cameras:
        coupled = coupled & np.asarray(problem.free.poses)[image]
    if given is not None and linear_solver == "dense":
        order, bandwidth = given.astype(np.int32), 0
    else:
        order, bandwidth = _order_images(image[coupled], point[coupled], problem, given)
    solver, panel_images, band_panels = _choose_linear_solver(linear_solver, len(order), least.block, bandwidth)
    if like is not None and like.block == least.block and band_panels <= like.band_panels:
        solver, panel_images, band_panels = like.linear_solver, like.panel_images, like.band_panels
    num_images = max(bucket(problem.num_images + 1, multiple=panel_images, small=SMALL_IMAGES), least.num_images)
    return ImageLayout(order, coupled, -(-num_images // panel_images) * panel_images, solver, panel_images, band_panels)


def _more(count: int, spare: float) -> int:
    return int(count * (1 + spare))


def _order_images(
    image: Int[np.ndarray, " n"],
    point: Int[np.ndarray, " n"],
    problem: Problem,
    given: Int[np.ndarray, " images"] | None,
) -> tuple[Int[np.ndarray, " images"], int]:
    """Return an order of the images with a small bandwidth of the reduced system, and that bandwidth in images.

    The narrowest of: as given, reverse Cuthill-McKee, and sweeps over the block in twelve directions. On flights of 500
    and 2000 images as given is 151 and 306 images wide, Cuthill-McKee 116 and 232, the best sweep 88 and 163.
    """
    seen = sparse.csr_array(
        (np.ones(len(image), np.int32), (image, point)), shape=(problem.num_images, problem.num_points)
    )
    graph = sparse.coo_array(seen @ seen.T)
    orders = (
        [given]
        if given is not None
        else [
            np.arange(problem.num_images),
            reverse_cuthill_mckee(sparse.csr_array(graph), symmetric_mode=True),
            *_sweeps(problem),
        ]
    )
    bandwidths = []
    for order in orders:
        rank = np.argsort(order)
        bandwidths.append(int(np.abs(rank[graph.row] - rank[graph.col]).max(initial=0)))
    best = int(np.argmin(bandwidths))
    return orders[best].astype(np.int32), bandwidths[best]


def _sweeps(problem: Problem) -> list[Int[np.ndarray, " images"]]:
    """Orders of the images along twelve directions in the plane of the block; none where positions are traced."""
    if isinstance(problem.poses.translation, Tracer) or isinstance(problem.poses.quaternion, Tracer):
        return []
    center = camera_centers(problem.poses)
    center = np.nan_to_num(center - center.mean(axis=0))
    axes = np.linalg.svd(center, full_matrices=False)[2][:2]
    angles = np.arange(12) * np.pi / 12
    along = center @ axes.T @ np.stack([np.cos(angles), np.sin(angles)])
    return [np.argsort(along[:, i], kind="stable") for i in range(len(angles))]


def _choose_linear_solver(
    asked: LinearSolver, num_images: int, block: int, bandwidth: int
) -> tuple[Literal["dense", "banded", "cg"], int, int]:
    """Return the way to solve the reduced system, the images a panel and the panels in the band.

    Panels of 48 to 96 unknowns measured best. Banded costs 2 n b^2 flops for half-bandwidth b, dense n^3/3 in one call
    to LAPACK, which wins up to some 900 unknowns (`benchmarks/linear_solvers.py`) and where the band is nearly full.
    """
    panel_images = max(1, round(48 / block))
    band_panels = max(1, -(-bandwidth // panel_images))
    unknowns, band = num_images * block, (band_panels + 1) * panel_images * block
    if asked == "auto":
        full = band > 0.4 * unknowns and unknowns <= _DENSE_MOST
        asked = "dense" if unknowns <= _DENSE_ALWAYS or full else "banded"
        if asked == "banded" and 8.0 * unknowns * band > _BAND_BYTES:
            asked = "cg"
    if asked != "banded":
        return asked, 1, 0
    return "banded", panel_images, bucket(band_panels)


_DENSE_ALWAYS, _DENSE_MOST = 900, 6000
_BAND_BYTES = 2e9


def _layout_rows(
    rank: Int[np.ndarray, " n"],
    point: Int[np.ndarray, " n"],
    num_images: int,
    padding_image: int,
    least_rows: int,
    spare: float,
) -> tuple[Int[np.ndarray, " rows"], Int[np.ndarray, " rows"]]:
    """Sort observations by image, then point, and pad each image's to whole runs."""
    order = np.lexsort((point, rank))
    counts = np.bincount(rank, minlength=num_images)
    padded = -(-counts // ROW_RUN) * ROW_RUN
    starts = np.concatenate([[0], np.cumsum(padded)])
    wanted = max(_more(int(starts[-1]), spare) + 1, least_rows)  # the last row is padding, and pads the pairs
    chunk = CHUNK_RUNS * ROW_RUN if wanted > CHUNK_RUNS * ROW_RUN else ROW_RUN
    num_rows = bucket(wanted, multiple=chunk)
    row_observation = np.full(num_rows, -1, np.int32)
    within = np.arange(len(order)) - np.repeat(np.cumsum(counts) - counts, counts)
    row_observation[np.repeat(starts[:-1], counts) + within] = order
    row_image = np.full(num_rows, padding_image, np.int32)
    row_image[: starts[-1]] = np.repeat(np.arange(num_images, dtype=np.int32), padded)
    return row_observation, row_image


def _point_images(
    image: Int[np.ndarray, " n"],
    point: Int[np.ndarray, " n"],
    rank_of_image: Int[np.ndarray, " images"],
    point_order: Int[np.ndarray, " points"],
    count: int,
) -> Int[np.ndarray, " count"]:
    """Return, in solver order, the image that comes first in the problem's own order among those that see a point."""
    first = np.full(len(point_order), len(rank_of_image), np.int32)
    np.minimum.at(first, point, image.astype(np.int32))
    found = np.zeros(count, np.int32)
    found[: len(point_order)] = np.append(rank_of_image, 0)[first[point_order]]
    return found


def _pairs(
    row_image: Int[np.ndarray, " rows"],
    row_point: Int[np.ndarray, " rows"],
    rows: Int[np.ndarray, " n"],
    num_images: int,
) -> tuple[Int[np.ndarray, " pairs"], Int[np.ndarray, " pairs"], Int[np.ndarray, " pairs"]]:
    """Return all pairs of rows that see one point from two images, by block: (later row, earlier row, block)."""
    rows = rows[np.argsort(row_point[rows], kind="stable")]  # by point, images ascending within
    points = row_point[rows]
    starts = np.flatnonzero(np.diff(points, prepend=-1))
    lengths = np.diff(starts, append=len(rows))
    first, second = [], []
    for length in np.unique(lengths):
        if length < 2:
            continue
        start = starts[lengths == length][:, None]
        earlier, later = np.triu_indices(length, 1)
        first.append(rows[(start + later).ravel()])
        second.append(rows[(start + earlier).ravel()])
    if not first:
        nothing = np.zeros(0, np.int32)
        return nothing, nothing, np.zeros(0, np.int64)
    first, second = np.concatenate(first).astype(np.int32), np.concatenate(second).astype(np.int32)
    block = row_image[first].astype(np.int64) * num_images + row_image[second]
    order = np.argsort(block, kind="stable")
    return first[order], second[order], block[order]


@dataclasses.dataclass(frozen=True)
class _PairRuns:
    first: Int[np.ndarray, "chunks pair_chunk pair_run"]
    second: Int[np.ndarray, "chunks pair_chunk pair_run"]
    block_of_run: Int[np.ndarray, " pair_runs"]
    blocks: Int[np.ndarray, " blocks"]


def _pair_runs(
    first: Int[np.ndarray, " pairs"],
    second: Int[np.ndarray, " pairs"],
    block: Int[np.ndarray, " pairs"],
    padding: int,
    least_runs: int,
    spare: float,
) -> _PairRuns:
    """Cut the pairs of each block into runs, padded with a row of zeros."""
    new_block = np.flatnonzero(np.diff(block, prepend=-1))
    counts = np.diff(new_block, append=len(block))
    runs = -(-counts // PAIR_RUN)
    starts = np.concatenate([[0], np.cumsum(runs)])
    num_runs = max(bucket(_more(int(starts[-1]), spare), multiple=PAIR_CHUNK) if len(block) else 0, least_runs)
    shape = (num_runs, PAIR_RUN)
    of_pair = np.repeat(np.arange(len(counts)), counts)
    within = np.arange(len(block)) - new_block[of_pair] if len(block) else np.zeros(0, np.int64)
    place = (starts[of_pair] + within // PAIR_RUN) * PAIR_RUN + within % PAIR_RUN
    padded_first, padded_second = np.full(shape, padding, np.int32), np.full(shape, padding, np.int32)
    padded_first.flat[place], padded_second.flat[place] = first, second
    block_of_run = np.full(num_runs, max(len(counts) - 1, 0), np.int32)
    block_of_run[: starts[-1]] = np.repeat(np.arange(len(counts), dtype=np.int32), runs)
    chunked = (-1, PAIR_CHUNK, PAIR_RUN)
    return _PairRuns(padded_first.reshape(chunked), padded_second.reshape(chunked), block_of_run, block[new_block])
