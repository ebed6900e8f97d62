"""What a surveyor should know about the frame and the heights, in sentences."""

import numpy as np
from pyproj import CRS

from jaxba.geo._crs import describe
from jaxba.geo._extent import grid_scale
from jaxba.geo._gates import Judgement
from jaxba.geo._operation import horizontal_operation
from jaxba.geo._positions import Measured, operation_notes
from jaxba.scene import LocalFrame

UNTRUSTED = "The GNSS altitudes behind them contradict each other: all may be wrong by tens of metres."
SCALE_WORTH_SAYING = 1e-3
"""UTM keeps within 0.04 % at its middle and 0.1 % at its edge."""


def frame_notes(frame: LocalFrame, *, is_proposed: bool) -> tuple[str, ...]:
    """Return which CRS the results go to, how it was found, and how well its datum is reached from WGS 84."""
    crs = CRS(frame.crs)
    how = "proposed, since none was given (--crs sets another)" if is_proposed else "as given"
    notes = [f"Results go to {describe(crs)}, unit {frame.unit}, {how}."]
    place = frame.longitude_deg, frame.latitude_deg
    notes += operation_notes(f"{describe(crs)}", horizontal_operation(crs, *place))
    scale = grid_scale(crs, *place)
    if np.isfinite(scale) and abs(scale - 1) > SCALE_WORTH_SAYING:
        notes.append(f"A metre on the ground is {scale:.4f} m in {describe(crs)} here: measure no lengths in it.")
    return (*notes, frame.height_note)


def height_notes(measured: Measured, judgement: Judgement, frame: LocalFrame) -> tuple[str, ...]:
    """Return what became of heights that contradict each other or are missing, and of positions that stand still."""
    notes = []
    used = judgement.is_used
    if judgement.drift is not None:
        notes.append(
            f"{judgement.drift.reason} No height is used: positions keep their horizontal part, all photos are "
            f"adjusted, and the block lies at the median height of {frame.height_m:.1f} m, which may be wrong by tens "
            "of metres. Control points with heights, or heights in a geo.txt, mend that."
        )
    elif missing := int(np.count_nonzero(used & np.isnan(measured.height_m))):
        of = "none of the positions has" if missing == used.sum() else f"{missing} of {used.sum()} positions have no"
        notes.append(f"Heights: {of} height; only their horizontal part is used.")
    places = np.stack([measured.longitude_deg, measured.latitude_deg, np.nan_to_num(measured.height_m)], axis=1)
    order = np.argsort(measured.time_s, kind="stable")
    order = order[np.isfinite(measured.longitude_deg[order])]
    stale = order[1:][(places[order[1:]] == places[order[:-1]]).all(axis=1)]
    if used.sum() >= 2 and np.ptp(places[used, :2], axis=0).max() == 0:
        notes.append("All positions are one and the same place: they give the block no scale and no direction.")
    elif len(stale):
        first = ", ".join(measured.names[k] for k in stale[:5]) + (", ..." if len(stale) > 5 else "")
        notes.append(
            f"Positions equal to that of the photo before to the last digit, as a receiver writes that missed an "
            f"update, {len(stale)}: {first}. "
            "They are used; the robust adjustment judges them."
        )
    return tuple(notes)
