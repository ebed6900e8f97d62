"""The view graph: images are its nodes, verified pairs its edges, each with its matches and relative pose."""

import enum
from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8


class EdgeStatus(enum.IntEnum):
    """What became of a candidate pair."""

    REJECTED = 0
    """Fewer inliers than an edge needs: missing data, not weak data. It has no matches."""
    WEAK = 1
    """An edge, but below the figures of a good pair."""
    GOOD = 2


@dataclass(frozen=True, kw_only=True)
class PrunedEdge:
    """An edge that the adjustment left out, since its matches do not fit the block.

    - `name`: both photos, as `a.jpg, b.jpg`. `num_matches`: verified ones.
    - `median_px`: what they are off by in the median, over the limit `limit_px`.
    """

    name: str
    num_matches: int
    median_px: float
    limit_px: float


@dataclass(frozen=True, kw_only=True, eq=False)
class ViewGraph:
    """Candidate pairs in rising order, with what verification made of each.

    - `pairs`: image indices, the first below the second. `status`: an `EdgeStatus`.
    - `matches`: features of both images, only verified ones; those of pair k are `offsets[k]:offsets[k + 1]`.
    - `num_putative`: matches before verification.
    - `is_planar`: a homography explains the pair as well as a fundamental matrix does.
    - `quaternion`, `direction`: relative pose `x_j = R x_i + t`, t of unit length; NaN where there is none.
    - `residual_px`: median distance to the epipolar line, or of the homography's transfer; NaN without inliers.
    - `distinctiveness`: median of 1 - (distance to the nearest over the second nearest descriptor) of the inliers.
    - `angle_rad`: median angle between the rays of the inliers; NaN without a relative pose.
    - `coverage`: share of an 8 x 8 grid's cells that hold an inlier, in the image where it is smaller; None where it
      was not measured.
    """

    pairs: Int[np.ndarray, "pairs 2"]
    status: UInt8[np.ndarray, " pairs"]
    offsets: Int[np.ndarray, " offsets"]
    matches: Int[np.ndarray, "matches 2"]
    num_putative: Int[np.ndarray, " pairs"]
    is_planar: Bool[np.ndarray, " pairs"]
    quaternion: Float[np.ndarray, "pairs 4"]
    direction: Float[np.ndarray, "pairs 3"]
    residual_px: Float[np.ndarray, " pairs"]
    distinctiveness: Float[np.ndarray, " pairs"]
    angle_rad: Float[np.ndarray, " pairs"]
    coverage: Float[np.ndarray, " pairs"] | None = None

    @property
    def num_inliers(self) -> Int[np.ndarray, " pairs"]:
        return np.diff(self.offsets)

    @property
    def inlier_ratio(self) -> Float[np.ndarray, " pairs"]:
        """Inliers over putative matches; 0 where there are none."""
        return self.num_inliers / np.maximum(self.num_putative, 1)

    @property
    def is_edge(self) -> Bool[np.ndarray, " pairs"]:
        return self.status != EdgeStatus.REJECTED

    def matches_of(self, pair: int) -> Int[np.ndarray, "matches_of_pair 2"]:
        """Return the matches of one pair."""
        return self.matches[self.offsets[pair] : self.offsets[pair + 1]]

    def select(self, keep: Bool[np.ndarray, " pairs"]) -> "ViewGraph":
        """Return the view graph of some of the pairs."""
        counts = self.num_inliers
        per_pair = {f.name: getattr(self, f.name) for f in fields(self) if f.name not in ("offsets", "matches")}
        columns: dict[str, Any] = {name: None if c is None else c[keep] for name, c in per_pair.items()}
        offsets = np.concatenate([[0], np.cumsum(counts[keep])]).astype(np.int64)
        return ViewGraph(offsets=offsets, matches=self.matches[np.repeat(keep, counts)], **columns)

    @staticmethod
    def concatenate(parts: Sequence["ViewGraph"]) -> "ViewGraph":
        """Return the pairs of all parts, which hold different ones, in rising order."""
        measured = all(part.coverage is not None for part in parts)
        parts = [ViewGraph.empty(), *parts]
        names = [f.name for f in fields(ViewGraph) if f.name != "offsets" and (measured or f.name != "coverage")]
        columns: dict[str, Any] = {name: np.concatenate([getattr(part, name) for part in parts]) for name in names}
        counts = np.concatenate([part.num_inliers for part in parts])
        order = np.lexsort((columns["pairs"][:, 1], columns["pairs"][:, 0]))
        ends = np.cumsum(counts)
        rows = [np.arange(int(ends[k] - counts[k]), int(ends[k])) for k in order]
        matches = columns.pop("matches")[np.concatenate(rows)] if rows else columns.pop("matches")
        offsets = np.concatenate([[0], np.cumsum(counts[order])]).astype(np.int64)
        return ViewGraph(offsets=offsets, matches=matches, **{name: c[order] for name, c in columns.items()})

    @staticmethod
    def empty() -> "ViewGraph":
        """Return a view graph without pairs."""
        return ViewGraph(
            pairs=np.zeros((0, 2), np.int32),
            status=np.zeros(0, np.uint8),
            offsets=np.zeros(1, np.int64),
            matches=np.zeros((0, 2), np.int32),
            num_putative=np.zeros(0, np.int32),
            is_planar=np.zeros(0, bool),
            quaternion=np.zeros((0, 4)),
            direction=np.zeros((0, 3)),
            residual_px=np.zeros(0),
            distinctiveness=np.zeros(0),
            angle_rad=np.zeros(0),
            coverage=np.zeros(0),
        )
