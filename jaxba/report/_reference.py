"""What is said of the place on earth: the CRS, what heights are above, positions on review, offsets of flights."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from jaxba.scene import FlightOffsets, Reference


def reference_facts(reference: Reference) -> dict[str, Any]:
    """Return the entry `crs` of a run's summary."""
    frame = reference.frame
    return {
        "crs": {
            "name": None if frame is None else frame.crs_name,
            "epsg": None if frame is None else frame.epsg,
            "heights": None if frame is None else frame.height_note,
            "review": [{"name": entry.name, "reason": entry.reason} for entry in reference.review],
        }
    }


def flight_facts(flights: FlightOffsets | None) -> list[dict[str, Any]]:
    """Return what each flight's positions have in common, adjusted minus measured, with its sigma.

    Nothing where flights are not told apart.
    """
    if flights is None:
        return []
    columns = flights.number, flights.num_photos, flights.offset_m, flights.std_m
    return [
        {
            "flight": int(number) + 1,
            "photos": int(count),
            "offset_m": [0.0 - float(value) if np.isfinite(value) else None for value in offset],
            "std_m": [float(value) if np.isfinite(value) else None for value in std],
        }
        for number, count, offset, std in zip(*columns, strict=True)
    ]


def flight_lines(facts: Sequence[Mapping[str, Any]]) -> list[str]:
    """Return facts of flights in words."""
    lines = []
    for fact in facts:
        axes = [
            of for of in zip(("east", "north", "up"), fact["offset_m"], fact["std_m"], strict=True) if of[1] is not None
        ]
        values = ", ".join(f"{value:+.3f}" + ("" if std is None else f" ({std:.3f})") for _, value, std in axes)
        names = ", ".join(axis for axis, _, _ in axes)
        lines.append(
            f"{fact['flight']}, {fact['photos']} photos: adjusted minus measured positions in common {values} m {names}"
        )
    return lines
