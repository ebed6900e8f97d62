"""Places on earth: WGS 84, the survey's local frame, projected CRSs, heights, and which measured positions to trust.

Arrays in, arrays out. Order is always x (east or longitude), then y (north or latitude), whatever a CRS's own order is.
"""

from jaxba.geo._against_tags import hold_against_tags
from jaxba.geo._attitudes import local_attitudes
from jaxba.geo._control import AS_PHOTOS, Surveyed, heights_above, surveyed_points
from jaxba.geo._crs import describe, parse_crs, target_crs, utm_zone
from jaxba.geo._flights import flight_numbers
from jaxba.geo._frame import (
    geodetic_from_local,
    grid_from_local,
    local_frame,
    local_from_geodetic,
    local_from_projected,
    projected_from_local,
)
from jaxba.geo._gates import HeightDrift, Judgement, judge_positions
from jaxba.geo._heights import HeightStep, height_step, list_heights
from jaxba.geo._notes import UNTRUSTED, frame_notes, height_notes
from jaxba.geo._operation import Operation, horizontal_operation
from jaxba.geo._positions import Measured, measured_positions
from jaxba.geo._readings import distance_m, elsewhere, would_fit

__all__ = [
    "AS_PHOTOS", "UNTRUSTED", "HeightDrift", "HeightStep", "Judgement", "Measured", "Operation", "Surveyed", "describe",
    "distance_m", "elsewhere", "flight_numbers", "frame_notes", "geodetic_from_local", "grid_from_local",
    "height_notes", "height_step", "heights_above", "hold_against_tags", "horizontal_operation", "judge_positions",
    "list_heights", "local_attitudes", "local_frame", "local_from_geodetic", "local_from_projected",
    "measured_positions", "parse_crs", "projected_from_local", "surveyed_points", "target_crs", "utm_zone", "would_fit",
]  # fmt: skip
