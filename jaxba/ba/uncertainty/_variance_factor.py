"""Variance factor: by how much the measurements scatter more than their sigmas say, squared.

Under least squares it is `sum r^2 / redundancy`. A robust loss is there for errors that no sigma describes, so that
neither their squares nor the loss's cost tells whether the sigmas are right: with right ones twice the cost over the
redundancy is 0.84 under Huber(1) and 0.51 under Cauchy(1). There the factor k^2 solves

    sum min(r^2, q f k^2) = f k^2 sum E min(chi^2_c, q),   f = redundancy / components

with q the 99th percentile of chi^2_c, c the components of an observation. With right sigmas it comes out as 0.98 under
Huber(1) and 1.02 under Cauchy(1), with 2% of gross errors as 1.11 and 1.14 (blocks of 20 and 40 images).
"""

from collections.abc import Sequence

import numpy as np
from scipy.special import chdtr, chdtrc, gammaincinv

from jaxba.ba.uncertainty._point_marginals import Squares
from jaxba.geometry import AbstractLoss, Linear

_COUNTED = 0.99  # of errors whose squares count in full where the loss is robust
_PASSES = 30  # each takes some 0.85 of what is left
# chi^2's quantile and its two tails are these functions: `scipy.stats`, which has them by name, takes 0.5 s to import


def variance_factor(losses: Sequence[AbstractLoss], groups: Sequence[Squares], num_free: float) -> tuple[float, float]:
    """Return the variance factor, NaN without redundancy, and the redundancy.

    - `losses`, `groups`: of the reprojections and the priors, or of some of them. `num_free`: free unknowns, or the
      share of these that some groups bear.
    """
    number = sum(int(np.sum(group.components)) for group in groups)
    redundancy = number - num_free
    if redundancy <= 0:
        return np.nan, redundancy
    left = redundancy / number  # of an error's variance in its residual, on the average
    limits, expected = [], 0.0
    for loss, group in zip(losses, groups, strict=True):
        freedom = np.arange(np.max(group.components, initial=0) + 1)
        degrees = np.maximum(freedom, 1)
        limit = np.where(isinstance(loss, Linear), np.inf, 2 * gammaincinv(degrees / 2, _COUNTED))
        beyond = 0.0 if isinstance(loss, Linear) else limit * chdtrc(degrees, limit)
        mean = np.where(freedom > 0, freedom * chdtr(freedom + 2, limit) + beyond, 0.0)
        limits.append(limit[group.components] * left)
        expected += left * float(np.sum(np.bincount(group.components, minlength=len(mean)) * mean))
    factor = sum(float(np.sum(group.squared)) for group in groups) / expected
    for _ in range(_PASSES if factor > 0 else 0):
        parts = [np.sum(np.minimum(g.squared, limit * factor)) for limit, g in zip(limits, groups, strict=True)]
        factor = float(sum(parts)) / expected
    return factor, redundancy
