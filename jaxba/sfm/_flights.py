"""What the positions of each flight are off in common, as the adjustment has found it."""

import dataclasses

import numpy as np

from jaxba.scene import FlightOffsets, Reference
from jaxba.sfm._adjust import Adjusted
from jaxba.sfm._measured import flights_of, used_positions
from jaxba.sfm._uncertainty import Uncertainty


def flight_offsets(adjusted: Adjusted, sigmas: Uncertainty, reference: Reference) -> FlightOffsets | None:
    """Return the offsets of flights, NaN along an axis that is not measured; None where flights are not told apart."""
    flights = flights_of(adjusted.block, reference)
    if flights is None:
        return None
    offset_m = np.asarray(adjusted.problem.position_offset, float)[: len(flights[0])]
    std_m = np.full(offset_m.shape, np.nan)
    if sigmas.covariance is not None:
        std_m = np.sqrt(np.maximum(np.diagonal(sigmas.covariance.position_offset), 0.0)).reshape(-1, 3)
    index = adjusted.block.image_index[used_positions(adjusted.block, reference)]
    known = np.isfinite(reference.xyz_m[index]) & np.isfinite(reference.std_m[index])
    measured = np.stack([known[flights[1] == number].any(axis=0) for number in range(len(flights[0]))])
    offset_m, std_m = np.where(measured, offset_m, np.nan), np.where(measured, std_m, np.nan)
    return FlightOffsets(flights[0], np.bincount(flights[1]), offset_m, std_m)


def without_offsets(reference: Reference, flights: FlightOffsets | None) -> Reference:
    """Return positions less the offsets of their flights."""
    if flights is None or reference.flight is None:
        return reference
    xyz_m = reference.xyz_m.copy()
    for number, offset_m in zip(flights.number, flights.offset_m, strict=True):
        xyz_m[reference.flight == number] -= np.nan_to_num(offset_m)
    return dataclasses.replace(reference, xyz_m=xyz_m)
