"""Rule on control: a block that fits its photos, and not its surveyed points."""

import numpy as np

from jaxba.engine._words import some
from jaxba.report._control_findings import along_axes
from jaxba.report._recorded import Recorded
from jaxba.report.diagnosis._adjustment import has_large_errors
from jaxba.report.diagnosis._diagnosis import Diagnosis

_OVER_SIGMA = 3.0  # RMS of the points over their predicted sigma
_LEAST_M = 0.02  # what a target is surveyed to
_SPREAD = 0.3  # of the block's extent, that control should reach over
_LEAST_POINTS = 3


def poor_control(case: Recorded) -> Diagnosis | None:
    """A good median and poor control: weak or wrong control, not the solver."""
    done = case.done
    if done.adjust is None or done.control is None or not done.control.control.num_points or has_large_errors(case):
        return None
    control, fit = done.control.control, done.adjust.control
    known = np.isfinite(fit.residual_m[:, 0])
    if not known.any():
        return None
    names = np.array(control.names)
    suspects = [
        f"{name} ({over:.1f} sigmas)"
        for name, over in zip(names[fit.is_suspect], fit.over_sigma[fit.is_suspect], strict=True)
    ]
    std_m = np.hypot(fit.std_m[known], control.std_m[known])
    expected = [np.median(std[np.isfinite(std)]) if np.isfinite(std).any() else np.nan for std in std_m.T]
    poor = []
    for role, rms in (("control", fit.control_rms_m), ("check", fit.check_rms_m)):
        for axis, value, limit in zip(("east", "north", "up"), rms, expected, strict=True):
            if np.isfinite(value) and np.isfinite(limit) and value > max(_OVER_SIGMA * limit, _LEAST_M):
                poor.append(f"{role} {axis} {value:.3f} m where {limit:.3f} m are expected")
    if not suspects and not poor and not (fit.scale > 1).any():
        return None
    used = ~control.is_check & known
    spread = _spread(case, used)
    texts = [
        f"Residuals (RMS): control {_axes(fit.control_rms_m)}, check {_axes(fit.check_rms_m)}",
        f"too large: {'; '.join(poor)}" if poor else "",
        f"blunder test: {some(suspects)}" if suspects else "the blunder test names none",
        f"sigmas of control were enlarged {fit.scale.max():.1f} times" if (fit.scale > 1).any() else "",
        f"{int(used.sum())} control points reach over {spread:.0%} of the block",
    ]
    is_weak = used.sum() < _LEAST_POINTS or spread < _SPREAD
    weak = "too few points, or too close together, hold the block" if is_weak else "the points are spread well"
    return Diagnosis(
        name="poor control",
        cause=f"The photos fit (median {done.adjust.median_px:.2f} px), and the surveyed points do not: "
        f"{'. '.join(text[0].upper() + text[1:] for text in texts if text)}; {weak}. It is control, not the solver.",
        cure="Look at marks and coordinates of the points named, make a doubtful one a check point (control.check), "
        "check the CRS and the heights of the list, and survey points at the block's corners and middle.",
        figures={
            "control_rms_m": list(map(float, fit.control_rms_m)),
            "check_rms_m": list(map(float, fit.check_rms_m)),
            "suspects": names[fit.is_suspect].tolist(),
            "spread": spread,
        },
    )


def _axes(rms: np.ndarray) -> str:
    return along_axes(rms.tolist(), ".3f") if np.isfinite(rms).any() else "none"


def _spread(case: Recorded, used: np.ndarray) -> float:
    """Return the extent of the control points over that of the cameras."""
    if not used.any():
        return 0.0
    points = case.done.control.control.xyz_m[used, :2]
    cameras = case.done.adjust.block.centers_m[:, :2]
    return float(np.hypot(*np.ptp(points, axis=0)) / max(float(np.hypot(*np.ptp(cameras, axis=0))), 1e-9))
