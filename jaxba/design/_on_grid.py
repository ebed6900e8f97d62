"""Places of control points among those of a grid: what each choice of them makes of the sigmas over the area.

All that a choice needs is computed once, so that thousands of them are tried in a second.
"""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from jaxba.design._network import Network, Spots

POWER = 12
"""Of the variances, 24 of the sigmas: a mean of so high a power is nearly the largest, and smooth."""

_EXCHANGES = 3


class OnGrid:
    """Variances over a network's area with control points at some of many places; see `_placement.py`."""

    def __init__(self, network: Network, places: Spots, std_m: Sequence[float]) -> None:
        spots = network.spots
        self.num = len(places.xyz_m)
        self.variance = spots.std_m.reshape(-1) ** 2
        self.mixed = spots.across @ network.covariance @ places.across.T
        self.system = places.joint_m2.copy()
        for k, noise in enumerate(places.noise_m2 + np.diag(np.array(std_m, float) ** 2)):
            self.system[3 * k : 3 * k + 3, 3 * k : 3 * k + 3] += noise

    def exchanged(self, count: int) -> list[int]:
        """Return the best places, taken one after the other, then exchanged until no exchange helps."""
        chosen: list[int] = []
        for _ in range(count):
            chosen.append(self.best(chosen))
        for _ in range(_EXCHANGES):
            before = list(chosen)
            for k in range(count):
                chosen[k] = self.best(chosen[:k] + chosen[k + 1 :])
            if chosen == before:
                break
        return chosen

    def best(self, chosen: Sequence[int]) -> int:
        """Return the place that, beside those chosen, lowers nearly the largest sigma most."""
        return int(
            np.argmin([self._nearly_largest([*chosen, k]) if k not in chosen else np.inf for k in range(self.num)])
        )

    def variances(self, chosen: Sequence[int]) -> Float[np.ndarray, " coordinates"]:
        """Return the variances of the area's spots with control points at the chosen places."""
        columns = (3 * np.array(chosen)[:, None] + np.arange(3)).ravel()
        root = np.linalg.cholesky(self.system[np.ix_(columns, columns)])
        half = np.linalg.solve(root, self.mixed[:, columns].T)
        return self.variance - np.sum(half**2, axis=0)

    def _nearly_largest(self, chosen: Sequence[int]) -> float:
        variance = self.variances(chosen)
        largest = float(variance.max())
        return largest * float(np.mean((variance / largest) ** POWER)) ** (1 / POWER)
