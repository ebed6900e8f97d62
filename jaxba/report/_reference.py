"""What is said of the place on earth: the CRS, what heights are above, positions on review."""

from typing import Any

from jaxba.scene import Reference


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
