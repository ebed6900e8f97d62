"""Ties: the similarity that takes each tile into the frame of the block, by what tiles have in common.

    X_block = s G X_tile + t                             for each tile

Tiles that were adjusted each on its own differ at the images and points that they share: by noise, by how each is bent,
and by a whole similarity where nothing else places them. The similarities are found all together. They bring together
the centres and rotations of shared images, and shared points. What is known in the block's own frame (GNSS, surveyed
points, attitudes, what is held fixed) takes part as one more tile, whose similarity is the identity.

**Start.** A pair of frames is tied by the best of samples, by the median of its distances, so that wrong points turn
nothing. A tree of ties gives each tile its start: the block's frame comes first, then the ties with most in common.

**Refinement.** Gauss-Newton steps on all ties, by Cauchy's loss. The sigma of what two tiles say is the one that their
differences show (median), for centres, points and rotations apart. Points of a tie weigh no more than the images that
it shares do, since the errors of points go with those of the images that see them.

Cost: numpy, 7 unknowns a tile; 9 tiles with 40 shared images and 2000 shared points a pair take 0.3 s.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy import sparse
from scipy.sparse.csgraph import breadth_first_order, connected_components, minimum_spanning_tree
from scipy.sparse.linalg import spsolve
from scipy.spatial.transform import Rotation

from jaxba.ba.checks._connected_parts import hat
from jaxba.ba.tiles._frames import ANTENNA, CENTER, POINT, Frame
from jaxba.geometry import Similarity, umeyama

_SAMPLES, _TURNS = 100, 30  # of three positions; of shared images whose rotation is tried
LEAST_IMAGES, LEAST_POINTS = 2, 6  # in common, either of them, that tie two tiles
_LOSS = 3.0  # sigmas
_NEAR = 20.0  # sigmas: a tile that its own priors have placed is no further from them
_MEDIAN = 1.538  # of the length of a vector of three normal components
_FLOOR = 1e-7  # of the block's extent, or radians: sigma of what agrees to rounding
_STEPS, _DONE, _RIDGE = 50, 1e-10, 1e-10


@dataclass(frozen=True, eq=False)
class Tie:
    """What two frames have in common, positions and rotations of the same things in the same order."""

    first: int
    second: int
    kind: Int[np.ndarray, " n"]
    xyz: tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n 3"]]
    std_m: Float[np.ndarray, "n 3"]
    rotations: tuple[Float[np.ndarray, "m 3 3"], Float[np.ndarray, "m 3 3"]]
    std_rad: Float[np.ndarray, " m"]

    @property
    def num_images(self) -> int:
        return int(np.count_nonzero(self.kind == CENTER))

    @property
    def num_points(self) -> int:
        return int(np.count_nonzero(self.kind == POINT))


@dataclass(frozen=True, eq=False)
class Placed:
    """Where the tiles go.

    - `similarities`: `block_from_tile`, or None where groups of tiles have too little in common.
    - `groups`: numbers of the tiles that hang together; one group where all do.
    - `by_priors`: whether the block's own frame placed them; else it is the frame of tile `root`.
    - `std_m`: by how much centres and points of two tiles differ, sigma an axis, robust; 0 where none are shared.
    """

    similarities: list[Similarity] | None
    groups: list[list[int]]
    by_priors: bool
    root: int
    std_m: tuple[float, float]


def place(tiles: Sequence[Frame], block: Frame) -> Placed:
    """Return the similarities of all tiles onto the block's frame, or what keeps them apart."""
    count = len(tiles)
    frames = [*tiles, block]
    ties = find_ties(frames)
    rng = np.random.default_rng(0)
    fitted = [(tie, similarity) for tie in ties if (similarity := _fit(tie, tie.second == count, rng)) is not None]
    root = int(np.argmax([len(frame.images) for frame in tiles]))
    starts, groups = _spread(fitted, count, root)
    if starts is None:
        return Placed(None, groups, False, root, (0.0, 0.0))
    in_block = any(tie.second == count for tie in ties)
    similarities, std_m = _refine(ties, starts, frames)
    if not in_block:
        back = similarities[root].inverse()
        similarities = [back.after(similarity) for similarity in similarities]
    return Placed(similarities, groups, in_block, root, std_m)


def find_ties(frames: Sequence[Frame]) -> list[Tie]:
    """Return what each pair of frames has in common, if anything; the last frame is the block's."""
    sizes = [len(frame.number) + len(frame.images) for frame in frames]
    keys = [np.concatenate([frame.key * 2, frame.images.astype(np.int64) * 2 + 1]) for frame in frames]
    _, column = np.unique(np.concatenate(keys), return_inverse=True)
    has = sparse.csr_array((np.ones(len(column), np.int32), (np.repeat(np.arange(len(frames)), sizes), column)))
    shared = sparse.coo_array(sparse.triu(has @ has.T, 1))
    pairs = sorted(zip(shared.row.tolist(), shared.col.tolist(), strict=True))
    return [_tie(first, second, frames[first], frames[second], second == len(frames) - 1) for first, second in pairs]


def _tie(first: int, second: int, a: Frame, b: Frame, is_block: bool) -> Tie:
    _, i, j = np.intersect1d(a.key, b.key, return_indices=True)
    if not is_block:  # two tiles' antennas say what their centres and rotations do
        i, j = i[a.kind[i] != ANTENNA], j[a.kind[i] != ANTENNA]
    _, k, m = np.intersect1d(a.images, b.images, return_indices=True)
    rotations = a.rotations[k], b.rotations[m]
    return Tie(first, second, a.kind[i], (a.xyz[i], b.xyz[j]), b.std_m[j], rotations, b.std_rad[m])


def _fit(tie: Tie, is_block: bool, rng: np.random.Generator) -> Similarity | None:
    """Return the similarity from a tie's first frame to its second one, or None if too little tells it."""
    source, target = tie.xyz
    known = np.isfinite(tie.std_m).all(axis=1) if is_block else np.ones(len(source), bool)
    source, target = source[known], target[known]
    if len(source) < 2 or (not is_block and tie.num_images < LEAST_IMAGES and tie.num_points < LEAST_POINTS):
        return None
    middle = np.median(source, axis=0), np.median(target, axis=0)
    away = np.linalg.norm(source - middle[0], axis=1)
    candidates: list[Similarity | None] = []
    if is_block and np.median(np.linalg.norm((source - target) / tie.std_m[known], axis=1)) < _NEAR:
        candidates.append(Similarity.identity())  # also where positions stand on a line, which determine none
    if away.max() > 0:
        ratio = np.linalg.norm(target - middle[1], axis=1)[away > 0] / away[away > 0]
        scale = float(np.median(ratio[away[away > 0] >= np.median(away)]))
        chosen = np.linspace(0, len(tie.rotations[0]) - 1, min(_TURNS, len(tie.rotations[0]))).astype(int)
        for of_first, of_second in zip(tie.rotations[0][chosen], tie.rotations[1][chosen], strict=True):
            turn = of_second.T @ of_first
            shift = np.median(target - scale * source @ turn.T, axis=0)
            candidates.append(Similarity(scale=scale, rotation=turn, shift=shift))
    if len(source) > 2:
        for _ in range(_SAMPLES):
            sample = rng.choice(len(source), 3, replace=False)
            candidates.append(umeyama(source[sample], target[sample]))
    found = [candidate for candidate in candidates if candidate is not None and candidate.scale > 0]
    off = [float(np.median(np.linalg.norm(one.points(source) - target, axis=1))) for one in found]
    return found[int(np.argmin(off))] if found else None


def _spread(
    fitted: list[tuple[Tie, Similarity]], count: int, root: int
) -> tuple[list[Similarity] | None, list[list[int]]]:
    """Return each tile's start along the strongest ties, from the block's frame or from the root; and the groups."""
    first = np.array([tie.first for tie, _ in fitted], int)
    second = np.array([tie.second for tie, _ in fitted], int)
    cost = np.array([1 / (1 + len(tie.kind)) if tie.second < count else 1e-9 for tie, _ in fitted])
    graph = sparse.csr_array((cost, (first, second)), shape=(count + 1, count + 1))
    _, label = connected_components(graph, directed=False)
    groups = [np.flatnonzero(label[:count] == one).tolist() for one in dict.fromkeys(label[:count].tolist())]
    if len(groups) > 1:
        return None, groups
    tree = minimum_spanning_tree(graph)
    begin = count if label[count] == label[0] else root
    order, before = breadth_first_order(tree, begin, directed=False)
    step = {(tie.first, tie.second): similarity for tie, similarity in fitted}
    starts = {begin: Similarity.identity()}
    for frame in order[1:].tolist():
        towards = int(before[frame])
        one = step[frame, towards] if (frame, towards) in step else step[towards, frame].inverse()
        starts[frame] = starts[towards].after(one)
    return [starts[tile] for tile in range(count)], groups


def _refine(
    ties: list[Tie], starts: list[Similarity], frames: Sequence[Frame]
) -> tuple[list[Similarity], tuple[float, float]]:
    """Return the similarities of least cost, and the sigmas of centres and points."""
    count = len(starts)
    similarities = [*starts, Similarity.identity()]  # that of the block's frame stays
    centers = [frame.xyz[frame.kind == CENTER] for frame in frames[:-1]]
    middles = [xyz.mean(axis=0) for xyz in centers]
    radius = np.array([one.scale * _radius(xyz) for one, xyz in zip(starts, centers, strict=True)])
    floor = _FLOOR * float(radius.max())
    std = np.zeros(3)
    for _ in range(_STEPS):
        moved = [_Moved.of(tie, similarities) for tie in ties]
        std = _sigmas(moved, floor)
        diagonal, matrix, gradient = _equations(moved, std, similarities, middles, radius)
        ridge = sparse.diags_array(np.full(7 * count, _RIDGE * max(diagonal, np.finfo(float).tiny)))
        step = -np.asarray(spsolve((matrix + ridge).tocsc(), gradient)).reshape(count, 7)
        for tile in range(count):
            similarities[tile] = _stepped(similarities[tile], middles[tile], step[tile], radius[tile])
        if np.abs(step).max() <= _DONE * radius.max():
            break
    return similarities[:count], (float(std[CENTER]), float(std[POINT]))


@dataclass(frozen=True, eq=False)
class _Moved:
    """A tie under the similarities: positions of the first frame, and differences of first and second.

    - `std_m`, `std_rad`: sigmas, NaN where differences show them.
    """

    tie: Tie
    xyz: tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n 3"]]
    turn: Float[np.ndarray, "m 3"]

    @staticmethod
    def of(tie: Tie, similarities: list[Similarity]) -> "_Moved":
        first, second = similarities[tie.first], similarities[tie.second]
        a, b = first.rotations(tie.rotations[0]), second.rotations(tie.rotations[1])
        turn = Rotation.from_matrix(np.swapaxes(a, 1, 2) @ b).as_rotvec() if len(a) else np.zeros((0, 3))
        return _Moved(tie, (first.points(tie.xyz[0]), second.points(tie.xyz[1])), turn)

    @property
    def off(self) -> Float[np.ndarray, "n 3"]:
        return self.xyz[0] - self.xyz[1]

    @property
    def is_between_tiles(self) -> Bool[np.ndarray, " n"]:
        return np.isnan(self.tie.std_m[:, 0])


def _sigmas(moved: list[_Moved], floor: float) -> Float[np.ndarray, "4"]:
    """Return sigmas of centres, points and rotations between tiles, and the factor of those that priors give."""

    def sigma(lengths: list[Float[np.ndarray, " _"]], least: float) -> float:
        every = np.concatenate(lengths) if lengths else np.zeros(0)
        return max(float(np.median(every)) / _MEDIAN, least) if len(every) else least

    length = [np.linalg.norm(one.off, axis=1) for one in moved]
    between = [one.is_between_tiles for one in moved]
    of_kind = [
        sigma(
            [
                far[is_between & (one.tie.kind == kind)]
                for one, far, is_between in zip(moved, length, between, strict=True)
            ],
            floor,
        )
        for kind in (CENTER, POINT)
    ]
    turns = [np.linalg.norm(one.turn[np.isnan(one.tie.std_rad)], axis=1) for one in moved]
    known = [
        np.linalg.norm(one.off[~is_b] / one.tie.std_m[~is_b], axis=1) for one, is_b in zip(moved, between, strict=True)
    ]
    return np.array([*of_kind, sigma(turns, _FLOOR), sigma(known, 1.0)])


def _equations(
    moved: list[_Moved],
    std: Float[np.ndarray, "4"],
    similarities: list[Similarity],
    middles: list[Float[np.ndarray, "3"]],
    radius: Float[np.ndarray, " tiles"],
) -> tuple[float, sparse.csr_array, Float[np.ndarray, " unknowns"]]:
    """Return the largest diagonal entry, the matrix and the gradient of the normal equations.

    Unknowns of a tile, all in metres: a shift, a turn and a growth about its middle, both times its radius.
    """
    count = len(radius)
    blocks: dict[tuple[int, int], Float[np.ndarray, "7 7"]] = {(k, k): np.zeros((7, 7)) for k in range(count)}
    gradient = np.zeros((count, 7))
    centers = [one.points(middle[None])[0] for one, middle in zip(similarities, middles, strict=False)]
    for one in moved:
        tie = one.tie
        weight, turn_weight = _weights(one, std)
        residual = np.concatenate([(one.off * weight).ravel(), (one.turn * turn_weight[:, None]).ravel()])
        columns = {}
        for side, tile in enumerate((tie.first, tie.second)):
            if tile == count:
                continue
            offset = (one.xyz[side] - centers[tile]) / radius[tile]
            of_xyz = np.concatenate([np.tile(np.eye(3), (len(offset), 1, 1)), -hat(offset), offset[:, :, None]], axis=2)
            of_turn = np.zeros((len(one.turn), 3, 7))
            of_turn[:, :, 3:6] = np.eye(3) / radius[tile]
            rows = [of_xyz * weight[:, :, None], of_turn * turn_weight[:, None, None]]
            columns[tile] = (1 - 2 * side) * np.concatenate(rows).reshape(-1, 7)
        for tile, jacobian in columns.items():
            gradient[tile] += jacobian.T @ residual
            for other, of_other in columns.items():
                blocks[tile, other] = blocks.get((tile, other), 0.0) + jacobian.T @ of_other
    rows, columns = np.array(list(blocks)).T
    values = np.stack(list(blocks.values()))
    row = (rows[:, None, None] * 7 + np.arange(7)[:, None] + np.zeros(7, int)).ravel()
    column = (columns[:, None, None] * 7 + np.arange(7) + np.zeros((7, 1), int)).ravel()
    matrix = sparse.csr_array((values.ravel(), (row, column)), shape=(7 * count, 7 * count))
    return float(matrix.diagonal().max()), matrix, gradient.ravel()


def _weights(one: _Moved, std: Float[np.ndarray, "4"]) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, " m"]]:
    """Return weights of positions, an axis, and of rotations: one over the sigma, less where Cauchy's loss says so."""
    tie, between = one.tie, one.is_between_tiles
    sigma = np.where(between[:, None], std[np.minimum(tie.kind, POINT)][:, None], tie.std_m * std[3])
    weight = 1 / sigma
    length = np.linalg.norm(one.off * weight, axis=1)
    weight = weight / np.sqrt(1 + (length / _LOSS) ** 2)[:, None]
    is_point = between & (tie.kind == POINT)
    weight[is_point] *= np.sqrt(min(1.0, max(tie.num_images, 1) / max(np.count_nonzero(is_point), 1)))
    turn_weight = 1 / np.where(np.isnan(tie.std_rad), std[2], tie.std_rad)
    length = np.linalg.norm(one.turn, axis=1) * turn_weight
    return weight, turn_weight / np.sqrt(1 + (length / _LOSS) ** 2)


def _radius(xyz: Float[np.ndarray, "n 3"]) -> float:
    """Return the rms distance from the mean, metres; 1 for what lies in one place."""
    return float(np.sqrt(np.mean(np.sum((xyz - xyz.mean(axis=0)) ** 2, axis=1)))) or 1.0


def _stepped(
    similarity: Similarity, middle: Float[np.ndarray, "3"], step: Float[np.ndarray, "7"], radius: float
) -> Similarity:
    turn = Rotation.from_rotvec(step[3:6] / radius).as_matrix()
    scale = similarity.scale * float(np.exp(step[6] / radius))
    rotation = turn @ similarity.rotation
    center = similarity.points(middle[None])[0] + step[:3]
    return Similarity(scale=scale, rotation=rotation, shift=center - scale * rotation @ middle)
