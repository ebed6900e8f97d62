"""Scale bars: known distances between points that photos show, and how a result fits them."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxba.scene._control import Control


@dataclass(frozen=True, kw_only=True, eq=False)
class ScaleBars:
    """Known distances, one row a bar.

    - `ends`: the points that bars end at, with their marks; nothing of their coordinates counts here.
    - `first`, `second`: rows of these. `length_m`, `std_m`: as measured.
    - `is_check`: an end is a check point, so that the bar is compared with the result and takes no part in it.
    """

    ends: Control
    first: Int[np.ndarray, " bars"]
    second: Int[np.ndarray, " bars"]
    length_m: Float[np.ndarray, " bars"]
    std_m: Float[np.ndarray, " bars"]
    is_check: Bool[np.ndarray, " bars"]

    @staticmethod
    def nothing() -> "ScaleBars":
        """Return no bars."""
        none, no_rows = np.zeros(0), np.zeros(0, np.int64)
        return ScaleBars(
            ends=Control.nothing(), first=no_rows, second=no_rows, length_m=none, std_m=none, is_check=np.zeros(0, bool)
        )

    @property
    def num(self) -> int:
        return len(self.first)

    @property
    def names(self) -> tuple[str, ...]:
        """Each bar by the labels of its ends."""
        return tuple(f"{self.ends.names[a]}-{self.ends.names[b]}" for a, b in zip(self.first, self.second, strict=True))


@dataclass(frozen=True, kw_only=True, eq=False)
class BarFit:
    """How a result fits its scale bars, one row a bar; NaN where an end has no place in it.

    - `distance_m`: between the ends in the result. `distance_std_m`: its sigma, NaN where that was not computed.
    - `residual_m`: adjusted minus measured. `over_sigma`: what the result says without the bar, minus the measured
      length, over the sigma of that difference.
    - `is_used`: the bar took part. `is_set_aside`: it would have, and contradicts all else. `is_unclear`: or
      others do that were set aside with it, and nothing tells which.
    """

    distance_m: Float[np.ndarray, " bars"]
    distance_std_m: Float[np.ndarray, " bars"]
    residual_m: Float[np.ndarray, " bars"]
    over_sigma: Float[np.ndarray, " bars"]
    is_used: Bool[np.ndarray, " bars"]
    is_set_aside: Bool[np.ndarray, " bars"]
    is_unclear: Bool[np.ndarray, " bars"]

    @staticmethod
    def nothing(num: int = 0) -> "BarFit":
        """Return a fit of bars that the result says nothing of."""
        unknown, no = np.full(num, np.nan), np.zeros(num, bool)
        return BarFit(
            distance_m=unknown,
            distance_std_m=unknown,
            residual_m=unknown,
            over_sigma=unknown,
            is_used=no,
            is_set_aside=no,
            is_unclear=no,
        )
