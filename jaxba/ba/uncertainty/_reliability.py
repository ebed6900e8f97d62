"""Reliability of measurements: redundancy, tests for blunders, and what an unseen blunder does (Baarda 1968).

Of a row with residual v, leverage G (`_leverage.py`) and weight w, all over its sigmas, w being what a robust loss left
of it (1 in least squares), the residual and its covariance had the row been left out of the adjustment are

    e = (I - w G)^-1 v        E = I + G (I - w G)^-1

by the formula of Sherman, Morrison and Woodbury. With w = 1 they are R^-1 v and R^-1, R = I - G, so that e / sqrt(E)
of one component is Baarda's w = v / sqrt(r), r its redundancy number, and e^T E^-1 e = v^T R^-1 v is chi-squared with
as many degrees as the row has components. A row that a loss has let go is so compared with what the others say of it,
as any other is.
"""

import dataclasses

import numpy as np
from jaxtyping import Float, Int
from scipy.special import chdtrc, ndtri

from jaxba.ba.uncertainty._leverage import Leverage

SIGNIFICANCE, POWER = 0.001, 0.80
NONCENTRALITY = float(ndtri(1 - SIGNIFICANCE / 2) + ndtri(POWER))
"""Sigmas by which an error of the size `detectable` shifts a test of `SIGNIFICANCE`, so that it has this `POWER`."""
_LEAST_REDUNDANCY = 1e-6  # of a component: below it rounding tells its test
_ROUNDING = 1e-9  # of the largest leverage


@dataclasses.dataclass(frozen=True)
class RowStatistics:
    """Statistics of the rows of one group; components along the second axis, in the units of `std`.

    NaN where a row took no part, where a component was not measured (an infinite sigma) or depends on nothing free, and
    tests where nothing else checks the component.

    - `name`: of the group: `observations`, or the prior's.
    - `std`: sigmas as stated. `weight`: what the loss has left of each row, 1 in least squares.
    - `residual`: adjusted minus measured. `without`: the same, had the row been left out of the adjustment.
    - `redundancy`: share of an error that its residual shows, 0 to 1; they sum up to the redundancy of the adjustment.
    - `test`: `without` over its sigma, one component left out at a time: a standard normal variable.
    - `row_test`: the same of all components of a row, squared: chi-squared with `freedom` degrees, as many as others
      check. `p_value`: of it.
    - `detectable`: the smallest error that a test of 0.1% finds in four of five cases (internal reliability).
    - `reach_m`: metres by which an error of that size moves the point, or the camera of a prior on images (external
      reliability); 0 for what is neither, NaN where it is not known.
    """

    name: str
    std: Float[np.ndarray, "rows components"]
    weight: Float[np.ndarray, " rows"]
    residual: Float[np.ndarray, "rows components"]
    without: Float[np.ndarray, "rows components"]
    redundancy: Float[np.ndarray, "rows components"]
    test: Float[np.ndarray, "rows components"]
    row_test: Float[np.ndarray, " rows"]
    freedom: Int[np.ndarray, " rows"]
    p_value: Float[np.ndarray, " rows"]
    detectable: Float[np.ndarray, "rows components"]
    reach_m: Float[np.ndarray, "rows components"]

    @property
    def over_sigma(self) -> Float[np.ndarray, "rows components"]:
        """Residuals over their stated sigmas."""
        return self.residual / self.std


def row_statistics(
    name: str, std: Float[np.ndarray, "rows components"], weight: Float[np.ndarray, " rows"], rows: Leverage
) -> RowStatistics:
    """Return the statistics of rows.

    - `std`: sigmas; rows with a NaN took no part. `weight`: of the loss.
    """
    v, leverage, reach = (np.asarray(part, float) for part in rows)
    own = np.einsum("nii->ni", leverage)
    used = (own > 0) & np.isfinite(std)
    redundancy = np.where(used, 1 - weight[:, None] * own, np.nan)
    checked = used & (redundancy > _LEAST_REDUNDANCY)

    variance = 1 + own / np.where(checked, redundancy, 1.0)
    error = v / np.where(checked, redundancy, 1.0)
    test = np.where(checked, error / np.sqrt(variance), np.nan)
    detectable = np.where(used, np.where(checked, NONCENTRALITY * np.sqrt(variance), np.inf), np.nan)
    moved = np.linalg.norm(reach, axis=1) * weight[:, None]
    reach_m = np.where(moved > 0, detectable, 0.0) * np.where(used, moved, np.nan)  # what moves nothing may be infinite

    # along the eigenvectors of the leverage components are independent; two rays of a point check one direction alone
    spread, turn = np.linalg.eigh(np.where(used[:, :, None] & used[:, None], leverage, 0.0))
    shown = 1 - weight[:, None] * spread
    along = np.einsum("nij,ni->nj", turn, np.where(used, v, 0.0))
    of_row = (shown > _LEAST_REDUNDANCY) & (spread > _ROUNDING * spread.max(axis=1, keepdims=True))
    along = np.where(of_row, along, 0.0) / np.where(of_row, shown, 1.0)
    row_test = np.sum(along**2 / (1 + spread / np.where(of_row, shown, 1.0)), axis=1)
    freedom = of_row.sum(axis=1)
    without = np.where((freedom == used.sum(axis=1))[:, None], np.einsum("nij,nj->ni", turn, along), np.nan)
    known = np.where(used, std, np.nan)
    return RowStatistics(
        name=name,
        std=np.where(np.isfinite(std), std, np.nan),
        weight=weight,
        residual=v * known,
        without=without * known,
        redundancy=redundancy,
        test=test,
        row_test=np.where(freedom > 0, row_test, np.nan),
        freedom=freedom,
        p_value=np.where(freedom > 0, chdtrc(np.maximum(freedom, 1), row_test), np.nan),
        detectable=detectable * known,
        reach_m=reach_m,
    )
