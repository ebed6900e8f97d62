"""What the positions of each flight are off in common, as the adjustment has found it."""

import dataclasses

import numpy as np

from jaxba.scene import FlightOffsets, Reference
from jaxba.sfm._adjust import Adjusted
from jaxba.sfm._measured import flights_of
from jaxba.sfm._uncertainty import Uncertainty


def flight_offsets(adjusted: Adjusted, sigmas: Uncertainty, reference: Reference) -> FlightOffsets | None:
    """Return the offsets of flights; None where flights are not told apart."""
    flights = flights_of(adjusted.block, reference)
    if flights is None:
        return None
    offset_m = np.asarray(adjusted.problem.position_offset, float)
    std_m = np.full(offset_m.shape, np.nan)
    if sigmas.covariance is not None:
        std_m = np.sqrt(np.maximum(np.diagonal(sigmas.covariance.position_offset), 0.0)).reshape(-1, 3)
    return FlightOffsets(flights[0], np.bincount(flights[1]), offset_m, std_m)


def without_offsets(reference: Reference, flights: FlightOffsets | None) -> Reference:
    """Return positions less the offsets of their flights."""
    if flights is None or reference.flight is None:
        return reference
    xyz_m = reference.xyz_m.copy()
    for number, offset_m in zip(flights.number, flights.offset_m, strict=True):
        xyz_m[reference.flight == number] -= offset_m
    return dataclasses.replace(reference, xyz_m=xyz_m)
