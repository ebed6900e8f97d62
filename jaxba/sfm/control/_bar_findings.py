"""Findings on scale bars: those that contradict the block, those without ends, and what they tell of its scale."""

import numpy as np

from jaxba.scene import BarFit, Block, Finding, ScaleBars
from jaxba.sfm._measured import OUTLIER


def bar_findings(bars: ScaleBars, fit: BarFit, block: Block) -> tuple[Finding, ...]:
    """Return the findings on the scale bars of an adjusted block."""
    found = []
    lost = np.flatnonzero(~np.isfinite(fit.distance_m))
    if len(lost):
        found.append(Finding.of("scale bars without ends", names=[bars.names[k] for k in lost]))
    untested = np.flatnonzero(fit.is_used & np.isnan(fit.distance_std_m))
    if len(untested):
        found.append(Finding.of("scale bars not tested", names=[bars.names[k] for k in untested]))
    with np.errstate(invalid="ignore"):
        is_off = fit.is_set_aside | (~fit.is_used & (np.abs(fit.over_sigma) > OUTLIER))
    has_scale = block.is_georeferenced or bool(fit.is_used.any())
    if fit.is_unclear.any():
        names = [bars.names[k] for k in np.flatnonzero(fit.is_unclear)]
        found.append(Finding.of("scale bars contradict each other", names=names, has_scale=has_scale))
    found += [
        Finding.of(
            "scale bar contradicts",
            name=bars.names[k],
            length_m=float(bars.length_m[k]),
            residual_m=float(fit.residual_m[k]),
            over_sigma=float(abs(fit.over_sigma[k])),
            limit=OUTLIER,
            is_set_aside=bool(fit.is_set_aside[k]),
        )
        for k in np.flatnonzero(is_off & ~fit.is_unclear)
        if has_scale
    ]
    if not block.is_georeferenced and fit.is_used.any():
        found.append(Finding.of("scale by bars", count=int(fit.is_used.sum())))
    return tuple(found)
