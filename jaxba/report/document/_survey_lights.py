"""Traffic lights of what was measured beside the photos: positions, control points, check points.

Control and check points are held against pixels on the ground and against the sigma of their own survey: a point cannot
be met better than it was measured. Where a target accuracy is stated, it alone judges the check points.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float

from jaxba.report._accuracy import accuracy
from jaxba.report._control_findings import along_axes
from jaxba.report.document._light import low, row, unknown
from jaxba.report.document._material import Material, gsd_m

_SCATTER = 1.5, 3.0  # times the sigmas that photos or lists state
_PIXELS = 2.0  # ground sample distances that control and check points may be off
_BEYOND = 2.0  # times the limit of good, over which control and check points are poor
_LIMIT = (
    f"good up to {_PIXELS:g} pixels on the ground or the sigma of the survey, the larger of both; poor over "
    f"{_BEYOND:g} times that"
)
_TARGET = 1.0, 1.0  # of a stated accuracy: it is met, or not


def positions_light(material: Material) -> dict[str, Any]:
    """Return how measured positions of photos scatter beside the sigmas that were stated."""
    name = "Positions of photos"
    limits = f"good up to {_SCATTER[0]:g} times, poor over {_SCATTER[1]:g} times the sigmas as stated"
    adjusted, reference = material.adjusted, material.reference
    if adjusted is None or reference is None or adjusted.gnss_rms_m is None:
        return unknown(name, "No measured position was used.", limits)
    block, residual = adjusted.block, adjusted.gnss_residual_m
    with np.errstate(invalid="ignore", divide="ignore"):
        middle = np.array([np.median(c[np.isfinite(c)]) if np.isfinite(c).any() else np.nan for c in residual.T])
        times = (residual - middle) / reference.std_m[block.image_index]
    known = np.isfinite(times)
    ratio = float(np.sqrt(np.mean(times[known] ** 2))) if known.any() else np.nan
    rms = ", ".join("unknown" if np.isnan(value) else f"{value:.3f}" for value in adjusted.gnss_rms_m)
    text = (
        f"Measured positions scatter, about what they have in common, by {ratio:.2f} times the sigmas as stated by "
        f"photos, lists or parameters; the sigmas as used stand in the section on GNSS positions. Their differences "
        f"have an RMS of {rms} m east, north, up."
    )
    return row(name, f"{ratio:.2f} sigma", low(ratio, _SCATTER), text, limits)


def control_light(material: Material) -> dict[str, Any]:
    """Return how the block fits its control points."""
    name, limits = "Control points", _LIMIT
    given = None if material.done.control is None else material.done.control.control
    if given is None or not (~given.is_check).any():
        return unknown(name, "No control points were given.", limits)
    if material.adjusted is None:
        return unknown(name, "Nothing has been adjusted.", limits)
    fit = material.adjusted.control
    found = _Off.of(fit.residual_m, given.std_m, ~given.is_check[:, None] & ~fit.is_set_aside, gsd_m(material))
    if found is None:
        return unknown(name, "The control points could not be compared with the block.", limits)
    aside = int(fit.is_set_aside.any(axis=1).sum())
    text, state = f"{found.text(given.names)}", low(found.over_limit, (1.0, _BEYOND))
    if aside:
        text = f"{text} Points set aside for contradicting all else: {aside}."
        most = 2 * aside >= int((~given.is_check).sum())  # the RMS of the few that agree with each other says little
        state = "poor" if most else "fair" if state == "good" else state
    return row(name, found.value, state, text, limits)


def check_light(material: Material) -> dict[str, Any]:
    """Return how the block fits its check points, against the target accuracy where there is one."""
    name, params = "Check points", material.settings.get("export")
    target = [getattr(params, key, None) for key in ("accuracy_h", "accuracy_v")]
    asked = [f"{value:g} m {word}" for value, word in zip(target, ("across", "up"), strict=True) if value is not None]
    limits = f"good within the target accuracy of {', '.join(asked)}, else poor" if asked else _LIMIT
    given = None if material.done.control is None else material.done.control.control
    if given is None or not given.is_check.any():
        return unknown(name, "No check points were given: nothing independent states the accuracy.", limits)
    if material.adjusted is None:
        return unknown(name, "Nothing has been adjusted.", limits)
    fit = material.adjusted.control
    found = _Off.of(
        fit.residual_m, given.std_m, np.broadcast_to(given.is_check[:, None], fit.residual_m.shape), gsd_m(material)
    )
    if found is None:
        return unknown(name, "The check points could not be compared with the block.", limits)
    state, text = low(found.over_limit, (1.0, _BEYOND)), found.text(given.names)
    if asked:
        target_m = [np.nan if value is None else float(value) for value in target]
        stated = accuracy(given, fit, (target_m[0], target_m[1]))
        assert stated is not None  # a point has been compared
        product = np.array([stated.horizontal_m, stated.vertical_m])
        state = low(float(np.nanmax(product / target_m)), _TARGET)
        text = f"With the sigma of the survey {product[0]:.3f} m across, {product[1]:.3f} m up. {text}"
    suspect = int((fit.is_suspect & given.is_check).sum())
    if suspect:
        text = f"{text} Points beyond chance: {suspect}."
        state = "fair" if state == "good" else state
    return row(name, found.value, state, text, limits)


@dataclass(frozen=True)
class _Off:
    """How surveyed points differ from the block: RMS an axis, and what it may be.

    - `off_m`: of every point, NaN where it does not count. `rms_m`, `limit_m`: an axis; NaN where no point has it.
    """

    off_m: Float[np.ndarray, "points 3"]
    rms_m: Float[np.ndarray, "3"]
    limit_m: Float[np.ndarray, "3"]

    @staticmethod
    def of(residual_m: np.ndarray, survey_std_m: np.ndarray, counts: np.ndarray, gsd: float) -> "_Off | None":
        known = counts & np.isfinite(residual_m)
        if not known.any():
            return None
        number = np.maximum(known.sum(axis=0), 1)
        has = known.any(axis=0)
        rms, survey = (
            np.where(has, np.sqrt(np.sum(np.where(known, of, 0.0) ** 2, axis=0) / number), np.nan)
            for of in (residual_m, survey_std_m)
        )
        return _Off(np.where(known, residual_m, np.nan), rms, np.where(has, np.fmax(survey, _PIXELS * gsd), np.nan))

    @property
    def over_limit(self) -> float:
        """The largest RMS of an axis over its limit."""
        return float(np.nanmax(self.rms_m / self.limit_m))

    @property
    def value(self) -> str:
        across = f"{float(np.hypot(*self.rms_m[:2])):.3f} m across" if np.isfinite(self.rms_m[:2]).all() else ""
        up = f"{self.rms_m[2]:.3f} m up" if np.isfinite(self.rms_m[2]) else ""
        return ", ".join(part for part in (across, up) if part)

    def text(self, names: Sequence[str]) -> str:
        """Return how far they may be off, and the worst of them."""
        worst = int(np.argmax(np.nansum(self.off_m**2, axis=1)))
        return (
            f"RMS of adjusted minus surveyed {along_axes(self.rms_m.tolist(), '.3f')}; limits of good "
            f"{along_axes(self.limit_m.tolist(), '.3f')}. Worst is {names[worst]}: "
            f"{along_axes(self.off_m[worst].tolist(), '+.3f')}."
        )
