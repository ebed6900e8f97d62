"""Where a planned flight takes its photos: lines over an area, and photos around it that look at its middle.

Lines cover strips of the area as wide as they are apart, and go on for a base beyond it at both ends, so that the rim
is seen as often as the middle.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from jaxba._errors import JaxbaError
from jaxba.design._flight_plan import FlightPlan
from jaxba.design._sections import Camera, Flight

MOST_PHOTOS = 1000
_SECOND_TURN_DEG = 90.0  # lines at a second height cross the first ones


@dataclass(frozen=True, eq=False)
class Stations:
    """Photos as planned.

    - `center_m`: east, north, up in metres about the area's middle on the mean ground.
    - `cam_from_world`: rotations. `num_lines`: of the flight; `length_m`: along all lines.
    """

    center_m: Float[np.ndarray, "images 3"]
    cam_from_world: Float[np.ndarray, "images 3 3"]
    num_lines: int = 0
    length_m: float = 0.0


def stations_of(plan: FlightPlan) -> Stations:
    """Return the photos of a plan in the order of the flight.

    Raises `JaxbaError` where they are too many, or too few to make a block.
    """
    flight = plan.flight
    passes = [(flight.height_m, flight.heading_deg)]
    if flight.crossing:
        passes.append((flight.height_m, flight.heading_deg + 90.0))
    if flight.second_height_m is not None:
        passes.append((flight.second_height_m, flight.heading_deg + _SECOND_TURN_DEG))
    parts = [_lines(plan.area_m, plan.camera, flight, height, heading) for height, heading in passes]
    if flight.oblique:
        parts.append(around(plan.area_m, flight.height_m, flight.oblique, flight.oblique_tilt_deg))
    center_m = np.concatenate([part.center_m for part in parts])
    if len(center_m) > MOST_PHOTOS:
        raise JaxbaError(
            f"the plan has {len(center_m)} photos, over {MOST_PHOTOS}; fly higher (flight.height_m), overlap less, or "
            "plan a part of area.polygon."
        )
    if len(center_m) < 3:
        raise JaxbaError(
            f"the plan has {len(center_m)} photos; fly lower (flight.height_m) or give a larger area.polygon."
        )
    rotation = np.concatenate([part.cam_from_world for part in parts])
    return Stations(center_m, rotation, sum(p.num_lines for p in parts), sum(p.length_m for p in parts))


def around(area_m: Float[np.ndarray, "corners 2"], height_m: float, count: int, tilt_deg: float) -> Stations:
    """Return photos evenly along the area's outline, that look at its middle `tilt_deg` off straight down."""
    import shapely

    outline = shapely.Polygon(area_m).exterior
    places = shapely.line_interpolate_point(outline, np.arange(count) / count, normalized=True)
    plan = shapely.get_coordinates(places)
    middle = shapely.get_coordinates(shapely.Polygon(area_m).centroid)[0]
    towards = middle - plan
    towards /= np.maximum(np.linalg.norm(towards, axis=1, keepdims=True), 1e-9)
    tilt = np.deg2rad(tilt_deg)
    axis = np.column_stack([np.sin(tilt) * towards, np.full(count, -np.cos(tilt))])
    right = np.column_stack([towards[:, 1], -towards[:, 0], np.zeros(count)])
    rotation = np.stack([right, np.cross(axis, right), axis], axis=1)
    return Stations(np.column_stack([plan, np.full(count, height_m)]), rotation)


def level(heading_deg: float) -> Float[np.ndarray, "3 3"]:
    """Return `cam_from_world` of a photo straight down whose upper edge points to `heading_deg`."""
    sine, cosine = np.sin(np.deg2rad(heading_deg)), np.cos(np.deg2rad(heading_deg))
    return np.array([[cosine, -sine, 0.0], [-sine, -cosine, 0.0], [0.0, 0.0, -1.0]])


def _lines(
    area_m: Float[np.ndarray, "corners 2"], camera: Camera, flight: Flight, height_m: float, heading_deg: float
) -> Stations:
    import shapely

    spacing = height_m * camera.width_px / camera.focal * (1 - flight.side_overlap)
    base = height_m * camera.height_px / camera.focal * (1 - flight.forward_overlap)
    turn = level(heading_deg)[:2, :2] * [[1.0], [-1.0]]  # rows: to the right of the line, along it
    area = shapely.Polygon(area_m @ turn.T)
    left, low, right, high = area.bounds
    num_lines = max(2, int(np.ceil((right - left) / spacing)) + 1)
    if num_lines * (high - low) / base > 10 * MOST_PHOTOS:
        raise JaxbaError(f"the plan has over {10 * MOST_PHOTOS} photos; fly higher (flight.height_m) or overlap less.")
    across = (left + right) / 2 + (np.arange(num_lines) - (num_lines - 1) / 2) * spacing
    plans, rotations, length = [], [], 0.0
    for x in across:
        strip = area.intersection(shapely.box(x - spacing, low - 1, x + spacing, high + 1))
        if strip.is_empty:
            continue
        _, first, _, last = strip.bounds
        count = int(np.ceil((last - first) / base)) + 3
        along = (first + last) / 2 + (np.arange(count) - (count - 1) / 2) * base
        back = len(plans) % 2 == 1
        plans.append(np.column_stack([np.full(count, x), along[::-1] if back else along]) @ turn)
        rotations.append(np.repeat(level(heading_deg + 180.0 * back)[None], count, axis=0))
        length += float(along[-1] - along[0])
    plan = np.concatenate(plans)
    center_m = np.column_stack([plan, np.full(len(plan), height_m)])
    return Stations(center_m, np.concatenate(rotations), len(plans), length)
