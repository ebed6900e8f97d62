"""Fronts: the multifrontal Cholesky of a reduced system over the tree of a dissection, on the host.

The reduced system and its right-hand side are one symmetric matrix, of the images and a tail: the border and one more,

    [A   B   a]
    [B^T C   c]
    [a^T c^T .]

Each node gathers its part of it in a dense front over its own images, its boundary and the tail, adds what its children
hand on, and eliminates its own images (Duff and Reid 1983):

    F11 = L L^T        X = F21 L^-T        F22 - X X^T goes to the parent.

So the root hands on C - B^T A^-1 B with its right-hand side, and on the way back `x = -L^-T X^T [x_rest, -1]`. The
inverse Z of the whole comes back the same way, its parts over each front alone (Erisman and Tinney 1975):

    P = L^-T X^T        Z_or = -P Z_rr        Z_oo = F11^-1 + P Z_rr P^T

with o a node's own images and r its boundary and the tail. Sizes are counted in blocks of an image's unknowns, to which
the tail is padded; lower triangles alone are filled. The arithmetic stands in `_dense.py`.
"""

import itertools
import threading
from concurrent.futures import ThreadPoolExecutor
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from jaxba.ba.tiles import _dense
from jaxba.ba.tiles._dissect import Tree
from jaxba.ba.tiles._programs import Handed, tail_size


class Factor(NamedTuple):
    """What the way back needs of a node: L, whose upper triangle holds anything, and X."""

    root: Float[np.ndarray, "own own"]
    across: Float[np.ndarray, "rest own"]


class _Run(NamedTuple):
    """Blocks that lie side by side in a child's boundary and in its parent's front."""

    start: int
    place: int
    length: int


class _Source(NamedTuple):
    """Which blocks of a tile go where in a part of a front."""

    index: Int[np.ndarray, " blocks"]
    row: Int[np.ndarray, " blocks"]
    column: Int[np.ndarray, " blocks"]


class Part(NamedTuple):
    """What a tile gives one of its fronts: blocks into F11, F21 and F22, and the tails of its images."""

    off_diagonal: tuple[_Source, _Source, _Source]
    images: Int[np.ndarray, " images"]
    """Places in the tile of the images whose diagonal and tail blocks enter here, in the front's order."""
    place: Int[np.ndarray, " images"]
    with_corner: bool


class TileFronts(NamedTuple):
    """How a tile's blocks go into the fronts of its nodes, `first` to `last`, the tile's own."""

    first: int
    last: int
    parts: tuple[Part, ...]


class _Memory:
    """Matrices whose memory is used again: to touch fresh memory takes longer than to fill it and compute with it."""

    def __init__(self) -> None:
        self.limit = np.inf
        self._free: list[np.ndarray] = []
        self._lock = threading.Lock()

    def take(self, rows: int, columns: int) -> Float[np.ndarray, "rows columns"]:
        """Return a matrix with anything in it."""
        size = rows * columns
        with self._lock:
            fitting = [i for i, buffer in enumerate(self._free) if size <= len(buffer) <= 2 * size]
            chosen = min(fitting, key=lambda i: len(self._free[i]), default=None)
            buffer = np.empty(size) if chosen is None else self._free.pop(chosen)
        return buffer[:size].reshape(rows, columns)

    def give_back(self, matrix: Float[np.ndarray, "rows columns"]) -> None:
        """Take the memory of a matrix back; not that of one which another process has made."""
        buffer = matrix
        while isinstance(buffer.base, np.ndarray):
            buffer = buffer.base
        if buffer.ndim != 1 or buffer.base is not None:
            return
        with self._lock:
            self._free.append(buffer)
            while sum(buffer.nbytes for buffer in self._free) > self.limit:
                self._free.pop(0)

    def zeros(self, rows: int, columns: int) -> Float[np.ndarray, "rows columns"]:
        """Return a matrix of zeros."""
        matrix = self.take(rows, columns)
        matrix[:] = 0
        return matrix

    def lower_zeros(self, size: int) -> Float[np.ndarray, "size size"]:
        """Return a matrix with zeros in its lower triangle."""
        matrix = self.take(size, size)
        ends = np.linspace(0, size, 9).astype(int)
        for begin, end in itertools.pairwise(ends):
            matrix[begin:end, :end] = 0
        return matrix


class Fronts:
    """The structure of all fronts of a tree.

    - `block`, `border`: unknowns of an image, and shared ones. `columns`: right-hand sides.
    """

    def __init__(self, tree: Tree, block: int, border: int, columns: int = 1) -> None:
        self.tree, self.block, self.border = tree, block, border
        self.tail = tail_size(block, border, columns)
        self.ranks = [tree.rank[np.concatenate([node.eliminated, node.boundary])] for node in tree.nodes]
        self.own = [len(node.eliminated) for node in tree.nodes]
        parent = np.full(len(tree.nodes), -1)
        for number, node in enumerate(tree.nodes):
            parent[list(node.children)] = number
        self.parent = parent
        self.memory = _Memory()
        self._runs = [self._runs_of(number) for number in range(len(tree.nodes))]

    def tile_fronts(
        self,
        tile: int,
        images: Int[np.ndarray, " images"],
        row: Int[np.ndarray, " blocks"],
        column: Int[np.ndarray, " blocks"],
    ) -> TileFronts:
        """Return where a tile's blocks go.

        - `images`: the tile's, in the order of elimination. `row`, `column`: places among these of the blocks beside
          the diagonal.
        """
        last = self.tree.tiles[tile]
        first = last
        while self.tree.nodes[first].children:
            first = self.tree.nodes[first].children[0]
        rank = self.tree.rank[images]
        node = np.minimum(self.tree.node_of_image[images], last)
        by_node = np.argsort(node[column], kind="stable")
        begin = np.searchsorted(node[column][by_node], np.arange(first, last + 2))
        parts = []
        for number in range(first, last + 1):
            ranks, own = self.ranks[number], self.own[number]
            index = by_node[begin[number - first] : begin[number - first + 1]]
            r, c = (np.searchsorted(ranks, rank[of[index]]) for of in (row, column))
            kinds = r < own, (r >= own) & (c < own), c >= own
            offsets = (0, 0), (own, 0), (own, own)
            sources = [_Source(index[k], r[k] - dr, c[k] - dc) for k, (dr, dc) in zip(kinds, offsets, strict=True)]
            here = np.flatnonzero(node == number)
            parts.append(
                Part((sources[0], sources[1], sources[2]), here, np.searchsorted(ranks, rank[here]), number == last)
            )
        return TileFronts(first, last, tuple(parts))

    def eliminate(
        self,
        number: int,
        handed_on: list[Float[np.ndarray, "_ _"]],
        diagonal: Float[np.ndarray, "own block"],
        part: Part | None = None,
        handed: Handed | None = None,
        pool: ThreadPoolExecutor | None = None,
    ) -> tuple[Factor, Float[np.ndarray, "rest rest"]]:
        """Fill a node's front and eliminate its images; return its factor and what goes to its parent.

        - `handed_on`: by its children. `diagonal`: what is to be added for its own images, such as damping.
        - `part`, `handed`: of the tile that the node belongs to, if any. `pool`: threads for large fronts.

        Raises `NotPositive` where the front is not positive definite.
        """
        block, own = self.block, self.own[number]
        rest = len(self.ranks[number]) - own + self.tail
        own_size, rest_size = own * block, rest * block
        f22 = self.memory.lower_zeros(rest_size)
        parts = self.memory.lower_zeros(own_size), self.memory.zeros(rest_size, own_size), f22
        with np.errstate(invalid="ignore", over="ignore"):  # what stands above the diagonals may be anything
            if part is not None and handed is not None:
                self._add_blocks(parts, own, part, handed)
            for child, update in zip(self.tree.nodes[number].children, handed_on, strict=True):
                self._extend_add(parts, own, self._runs[child], update)
                self.memory.give_back(update)
        f11, f21, _ = parts
        np.einsum("ii->i", f11)[:] += diagonal.reshape(-1)
        _dense.factor(f11, f21, f22, pool)
        return Factor(f11, f21), f22

    def put_back(
        self, number: int, factor: Factor, solution: Float[np.ndarray, "images block"], tail: Float[np.ndarray, " tail"]
    ) -> None:
        """Write the solution of a node's own images into `solution`, where that of its boundary stands already.

        - `tail`: the border's solution, -1 and zeros.
        """
        node = self.tree.nodes[number]
        if not len(node.eliminated):
            return
        rest = np.concatenate([solution[node.boundary].reshape(-1), tail])
        own = _dense.solve_transposed(factor.root, rest @ factor.across)
        solution[node.eliminated] = -own.reshape(-1, self.block)

    def inverse(
        self, factor: Factor, of_rest: Float[np.ndarray, "rest rest"], pool: ThreadPoolExecutor | None = None
    ) -> Float[np.ndarray, "front front"]:
        """Return the inverse over a node's own images, its boundary and the tail, from that over the last two."""
        if not len(factor.root):
            return of_rest
        size = len(factor.root) + len(of_rest)
        whole = self.memory.take(size, size)
        _dense.inverse(factor.root, factor.across, of_rest, whole, pool)
        return whole

    def diagonal_blocks(self, whole: Float[np.ndarray, "front front"]) -> Float[np.ndarray, "images block block"]:
        """Return the diagonal blocks of a matrix over a front, its tail's included."""
        count = len(whole) // self.block
        places = np.arange(count)
        return whole.reshape(count, self.block, count, self.block)[places, :, places]

    def take_blocks(
        self,
        number: int,
        whole: Float[np.ndarray, "front front"],
        part: Part,
        off_diagonal: Float[np.ndarray, "blocks block block"],
    ) -> None:
        """Copy the blocks of a matrix over a node's front to where a tile's blocks for that front came from."""
        count, own = len(whole) // self.block, self.own[number]
        blocks = whole.reshape(count, self.block, count, self.block)
        for source, (row, column) in zip(part.off_diagonal, ((0, 0), (own, 0), (own, own)), strict=True):
            off_diagonal[source.index] = blocks[source.row + row, :, source.column + column]

    def of_child(self, child: int, whole: Float[np.ndarray, "front front"]) -> Float[np.ndarray, "rest rest"]:
        """Return a matrix over a node's front where it concerns the boundary of a child, and the tail."""
        size = (len(self.ranks[child]) - self.own[child] + self.tail) * self.block
        part = np.empty((size, size))
        runs = [(slice(s * self.block, (s + n) * self.block), slice(p * self.block, (p + n) * self.block))
                for s, p, n in self._runs[child]]  # fmt: skip
        for to_rows, rows in runs:
            for to_columns, columns in runs:
                part[to_rows, to_columns] = whole[rows, columns]
        return part

    def forget(self, factor: Factor) -> None:
        """Take back the memory of a factor that is no longer needed."""
        for matrix in factor:
            self.memory.give_back(matrix)

    def bytes_in_work(self, workers: int) -> float:
        """Return the most that fronts take at a time: those that wait, and the one in work with its factor."""
        block, own = self.block, np.array(self.own, float)
        rest = np.array([len(ranks) for ranks in self.ranks]) - own + self.tail
        handed, whole = 8 * (rest * block) ** 2, 8 * ((own + rest) * block) ** 2
        waiting, most = 0.0, 0.0
        for number, node in enumerate(self.tree.nodes):
            most = max(most, waiting + whole[number])
            waiting += handed[number] - sum(handed[list(node.children)])
        ahead = sorted(whole[list(self.tree.tiles)])[-2 * workers :]  # tiles that are done before their turn
        return float(most + sum(ahead))

    def bytes_in_inverse(self) -> float:
        """Return the most that parts of the inverse take at a time, on the way to the tile that is worked on."""
        block, own = self.block, np.array(self.own, float)
        rest = np.array([len(ranks) for ranks in self.ranks]) - own + self.tail
        part, whole = 8 * (rest * block) ** 2, 8 * ((own + rest) * block) ** 2
        waiting, most = part[-1], 0.0
        for number in reversed(range(len(self.own))):
            most = max(most, waiting + 3 * whole[number])
            waiting += sum(part[list(self.tree.nodes[number].children)]) - part[number]
        return float(most)

    def bytes_of_factors(self) -> int:
        """Return what all factors take."""
        own = np.array(self.own) * self.block
        width = np.array([len(ranks) for ranks in self.ranks]) * self.block + self.tail * self.block
        return int(8 * np.sum(own * width))

    def _runs_of(self, child: int) -> list[_Run]:
        """Return where a node's boundary and tail lie in its parent's front, runs that its own images' end cuts."""
        parent = int(self.parent[child])
        if parent < 0:
            return []
        place = np.searchsorted(self.ranks[parent], self.ranks[child][self.own[child] :])
        place = np.append(place, len(self.ranks[parent]) + np.arange(self.tail))
        jumps = (np.diff(place, prepend=-2) != 1) | (place == self.own[parent])
        starts = np.flatnonzero(jumps)
        lengths = np.diff(starts, append=len(place))
        return [_Run(int(s), int(place[s]), int(n)) for s, n in zip(starts, lengths, strict=True)]

    def _add_blocks(
        self, parts: tuple[np.ndarray, np.ndarray, np.ndarray], own: int, part: Part, handed: Handed
    ) -> None:
        block = self.block
        f11, f21, f22 = (p.reshape(p.shape[0] // block, block, p.shape[1] // block, block) for p in parts)
        for target, source in zip((f11, f21, f22), part.off_diagonal, strict=True):
            target[source.row, :, source.column] += handed.off_diagonal[source.index]
        tails = handed.tail[part.images].reshape(-1, self.tail, block, block)
        inner = np.count_nonzero(part.place < own)
        for target, at, blocks, images in (
            (f11, part.place[:inner], tails[:inner], part.images[:inner]),
            (f22, part.place[inner:] - own, tails[inner:], part.images[inner:]),
        ):
            target[at, :, at] += handed.diagonal[images]
            below = f21 if target is f11 else f22
            for k in range(self.tail):
                below[len(below) - self.tail + k, :, at] += blocks[:, k]
        if part.with_corner:
            size = self.tail * block
            parts[2][-size:, -size:] += handed.corner

    def _extend_add(
        self, parts: tuple[np.ndarray, np.ndarray, np.ndarray], own: int, runs: list[_Run], update: np.ndarray
    ) -> None:
        f11, f21, f22 = parts
        block = self.block
        for i, row in enumerate(runs):
            rows = slice(row.start * block, (row.start + row.length) * block)
            for column in runs[: i + 1]:
                of_update = update[rows, column.start * block : (column.start + column.length) * block]
                target, r, c = f11, row.place, column.place
                if r >= own:
                    target, r, c = (f21, r - own, c) if c < own else (f22, r - own, c - own)
                r, c = r * block, c * block
                target[r : r + of_update.shape[0], c : c + of_update.shape[1]] += of_update
