"""Structure from motion: start values of poses and points, and the adjustment in rounds (arrays in, arrays out)."""

from jaxba.sfm._adjust import Adjusted, adjust
from jaxba.sfm._attitude_findings import attitude_turns
from jaxba.sfm._findings import GnssFit, findings, gnss_fit, height_above_ground
from jaxba.sfm._flights import flight_offsets, without_offsets
from jaxba.sfm._initialise import initialise
from jaxba.sfm._intrinsics import AtBound, free_parameters, intrinsics_at_bounds, natural_intrinsics
from jaxba.sfm._points import with_points
from jaxba.sfm._problem import positions_hold, to_problem
from jaxba.sfm._rounds import Settings, Tiling
from jaxba.sfm._spread import weighed
from jaxba.sfm._survey_statistics import survey_statistics
from jaxba.sfm._uncertainty import Uncertainty, uncertainty
from jaxba.sfm.control._bar_ends import add_bars
from jaxba.sfm.control._bar_findings import bar_findings
from jaxba.sfm.control._control import agreeing_marks, control_part
from jaxba.sfm.control._findings import control_findings
from jaxba.sfm.control._fit import Controlled, apply_affine, apply_control
from jaxba.sfm.control._onto_bars import compared as compared_bars
from jaxba.sfm.control._start import place_by_control, transformed

__all__ = [
    "Adjusted", "AtBound", "Controlled", "GnssFit", "Settings", "Tiling", "Uncertainty", "add_bars", "adjust",
    "agreeing_marks", "apply_affine", "apply_control", "attitude_turns", "bar_findings", "compared_bars",
    "control_findings", "control_part", "findings", "flight_offsets", "free_parameters", "gnss_fit",
    "height_above_ground", "initialise", "intrinsics_at_bounds", "natural_intrinsics", "place_by_control",
    "positions_hold", "survey_statistics", "to_problem", "transformed", "uncertainty", "weighed", "with_points",
    "without_offsets",
]  # fmt: skip
