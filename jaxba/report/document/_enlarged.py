"""What drawings of a report need beside its numbers: by how much small things are enlarged."""

from collections.abc import Sequence

import numpy as np

_SHOWN = 0.03  # of the drawing's extent, that the median is to have


def enlarged(sizes: Sequence[float], extent: float) -> float:
    """Return the round factor (1, 2 or 5 times a power of ten) that makes the median size 3% of the extent, at most.

    >>> enlarged([0.01, 0.02, 0.04], 100.0)
    100.0
    """
    known = [size for size in sizes if np.isfinite(size) and size > 0]
    if not known or not extent > 0:
        return 1.0
    wanted = _SHOWN * extent / float(np.median(known))
    power = 10.0 ** np.floor(np.log10(wanted * (1 + 1e-9)))
    return float(power * max(step for step in (1, 2, 5) if step * power <= wanted * (1 + 1e-9)))
