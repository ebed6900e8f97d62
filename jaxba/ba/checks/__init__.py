"""Checks: what can be told of a problem before it is solved, and what is left out or held for it to be solvable."""

from jaxba.ba.checks._check import Dropped, Prepared, Reason, prepare
from jaxba.ba.checks._gauge import free_directions, free_gauge, require_gauge
from jaxba.ba.checks._plausible import implausible_cameras
from jaxba.ba.checks._validate import validate

__all__ = [
    "Dropped",
    "Prepared",
    "Reason",
    "free_directions",
    "free_gauge",
    "implausible_cameras",
    "prepare",
    "require_gauge",
    "validate",
]
