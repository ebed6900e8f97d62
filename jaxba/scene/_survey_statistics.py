"""What an adjustment says of its measurements and of the unknowns that all images share."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float


@dataclass(frozen=True, kw_only=True)
class MeasuredKind:
    """One kind of measurement: how its errors scatter beside what was stated.

    - `name`: tie points, marks, position horizontal, ... `unit`: of sigmas: px, m or deg.
    - `count`, `redundancy`: measured components, and their redundancy numbers summed.
    - `std`: that the residuals show, and `std_share`, its own sigma over it. `taken_std`: that it
      was taken to have, from tags, lists or parameters; NaN where nothing says one. `weighed_std`: with which the
      adjustment weighed it, in the median.
    - `is_known`: whether there is enough redundancy to rely on `std`.
    """

    name: str
    unit: str
    count: int
    redundancy: float
    std: float
    std_share: float
    taken_std: float
    is_known: bool
    weighed_std: float = float("nan")


@dataclass(frozen=True, kw_only=True, eq=False)
class SurveyStatistics:
    """Statistics of an adjusted block.

    - `redundancy`: of measurements and assumptions together. `kinds`: of measurements.
    - `assumed_count`, `assumed_redundancy`: components of what is assumed beside them, and their redundancy numbers
      summed: weak priors on intrinsics, and offsets of positions that are near zero.
    - `unknowns`: names of what images share: intrinsics, offsets of positions. `unknown_std`: sigmas, in their units.
    - `correlation`: among these; NaN of what is fixed.
    """

    redundancy: int
    kinds: tuple[MeasuredKind, ...]
    unknowns: tuple[str, ...]
    unknown_std: Float[np.ndarray, " unknowns"]
    correlation: Float[np.ndarray, "unknowns unknowns"]
    assumed_count: int = 0
    assumed_redundancy: float = 0.0
