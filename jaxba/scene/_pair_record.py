"""What was decided on each candidate pair, with the figures: threshold, model, which figure it missed, the fallback."""

import enum
from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
from jaxtyping import Float, Int, UInt8


class Model(enum.IntEnum):
    """What explains a pair's matches best."""

    NONE = 0
    ESSENTIAL = 1
    FUNDAMENTAL = 2
    HOMOGRAPHY = 3


class Missed(enum.IntEnum):
    """The first figure that a pair missed: the first two reject it, the others make it weak."""

    NOTHING = 0
    MATCHES = 1
    VERIFIED = 2
    MIN_GOOD = 3
    MIN_INLIER_RATIO = 4


class Fallback(enum.IntEnum):
    """What became of a pair of ORB features that is not good."""

    NONE = 0
    """It was not asked for: the pair is good, or its features are of another kind."""
    TAKEN = 1
    NOT_BETTER = 2
    GSD_TOO_FINE = 3
    GSD_UNKNOWN = 4


@dataclass(frozen=True, kw_only=True, eq=False)
class PairRecord:
    """A row a pair, in the order of the view graph.

    - `threshold_px`: of the sample consensus. `model`: a `Model`. `missed`: a `Missed`. `fallback`: a `Fallback`.
    - `num_verified`: matches that the model explains, also of a rejected pair. `gsd_m`: the mean ground sample distance
      of its photos, a pixel; NaN where it is unknown or was not needed.
    """

    threshold_px: Float[np.ndarray, " pairs"]
    model: UInt8[np.ndarray, " pairs"]
    missed: UInt8[np.ndarray, " pairs"]
    fallback: UInt8[np.ndarray, " pairs"]
    num_verified: Int[np.ndarray, " pairs"]
    gsd_m: Float[np.ndarray, " pairs"]

    @staticmethod
    def of(
        *, threshold_px: float, model: Model, missed: Missed, num_verified: int, gsd_m: float = np.nan
    ) -> "PairRecord":
        """Return the record of one pair, without a fallback."""
        return PairRecord(
            threshold_px=np.array([threshold_px]),
            model=np.array([model], np.uint8),
            missed=np.array([missed], np.uint8),
            fallback=np.array([Fallback.NONE], np.uint8),
            num_verified=np.array([num_verified], np.int32),
            gsd_m=np.array([gsd_m]),
        )

    @staticmethod
    def concatenate(parts: Sequence["PairRecord"]) -> "PairRecord":
        """Return the rows of all parts, in their order."""
        empty = PairRecord.of(threshold_px=0.0, model=Model.NONE, missed=Missed.NOTHING, num_verified=0)
        rows: dict[str, Any] = {
            field.name: np.concatenate([getattr(empty, field.name)[:0], *(getattr(part, field.name) for part in parts)])
            for field in fields(PairRecord)
        }
        return PairRecord(**rows)
