"""Structure from motion: start values of poses and points, and the adjustment in rounds (arrays in, arrays out)."""

from jaxba.sfm._adjust import Adjusted, adjust
from jaxba.sfm._bounds import AtBound, intrinsics_at_bounds
from jaxba.sfm._findings import GnssFit, findings, gnss_fit, height_above_ground
from jaxba.sfm._initialise import initialise
from jaxba.sfm._points import with_points
from jaxba.sfm._problem import free_parameters, to_problem
from jaxba.sfm._settings import Settings
from jaxba.sfm._uncertainty import Uncertainty, uncertainty

__all__ = [
    "Adjusted", "AtBound", "GnssFit", "Settings", "Uncertainty", "adjust", "findings", "free_parameters", "gnss_fit",
    "height_above_ground", "initialise", "intrinsics_at_bounds", "to_problem", "uncertainty", "with_points",
]  # fmt: skip
