"""Flights of a survey, as the times of its photos and the bodies of its cameras tell them."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Int

from jaxba.geo._gates import FLIGHT_GAP_S
from jaxba.geo._positions import Measured
from jaxba.scene import Photo


def flight_numbers(photos: Sequence[Photo], measured: Measured) -> Int[np.ndarray, " photos"]:
    """Return the flight of each photo, numbered from 0 by the time of the first photo.

    A flight ends where its camera takes no photo for more than `FLIGHT_GAP_S`; without times each camera has flown one.
    """
    bodies = np.unique([photo.lens.body for photo in photos], return_inverse=True)[1]
    flight = np.zeros(len(photos), int)
    begun: list[float] = []
    for body in range(int(bodies.max(initial=-1)) + 1):
        rows = np.flatnonzero(bodies == body)
        rows = rows[np.argsort(measured.time_s[rows], kind="stable")]
        pauses = np.diff(measured.time_s[rows]) > (FLIGHT_GAP_S if measured.has_time else np.inf)
        for part in np.split(rows, np.flatnonzero(pauses) + 1):
            flight[part] = len(begun)
            begun.append(float(measured.time_s[part[0]]))
    return np.argsort(np.argsort(begun, kind="stable"), kind="stable")[flight]
