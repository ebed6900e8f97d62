"""The plan of a flight as a TOML file: the area, and a table for the camera, flight, positions, ties, ground, control.

[area]
polygon = [[576100, 5183300], [576400, 5183300], [576400, 5183500], [576100, 5183500]]
crs = "EPSG:32615"                 # of the coordinates, x (or longitude) first; without it they are metres

[flight]
height_m = 80

[control]
points = [[576120, 5183320], [576380, 5183480]]
"""

import dataclasses
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from jaxba._errors import JaxbaError
from jaxba.design._place import Place
from jaxba.design._sections import Camera, Control, Flight, Gnss, Ground, Ties
from jaxba.engine import Parameters, set_from_tables, to_toml
from jaxba.io import text_of

_SECTIONS = (Camera, Flight, Gnss, Ties, Ground, Control)
_LEAST_AREA = 1.0  # m^2


@dataclass(frozen=True, kw_only=True, eq=False)
class FlightPlan:
    """What is to be flown.

    - `area_m`: corners of the area, east and north in metres about its middle; `place`: where that lies.
    - `control_m`: control points, likewise. The others are the tables of the file.
    """

    area_m: Float[np.ndarray, "corners 2"]
    place: Place = field(default_factory=Place)
    camera: Camera = field(default_factory=Camera)
    flight: Flight = field(default_factory=Flight)
    gnss: Gnss = field(default_factory=Gnss)
    ties: Ties = field(default_factory=Ties)
    ground: Ground = field(default_factory=Ground)
    control: Control = field(default_factory=Control)
    control_m: Float[np.ndarray, "points 2"] = field(default_factory=lambda: np.zeros((0, 2)))

    def changed(self, **tables: Mapping[str, Any]) -> "FlightPlan":
        """Return the plan with other values: `plan.changed(flight={"oblique": 8})`."""
        return dataclasses.replace(
            self, **{name: dataclasses.replace(getattr(self, name), **values) for name, values in tables.items()}
        )


def read_plan(path: Path) -> FlightPlan:
    """Return the plan in a file.

    Raises `JaxbaError`, which names the file, the parameter, its value and the cure.
    """
    try:
        tables = tomllib.loads(text_of(path.read_bytes()))
    except FileNotFoundError:
        raise JaxbaError(
            f"{path}: there is no such file; give a plan, a table [area] with its polygon at least."
        ) from None
    except IsADirectoryError:
        raise JaxbaError(f"{path}: is a folder, and no project; give the plan of a flight, or a project.") from None
    except (OSError, UnicodeDecodeError) as error:
        raise JaxbaError(f"{path}: cannot be read as text ({error}).") from error
    except tomllib.TOMLDecodeError as error:
        raise JaxbaError(f"{path}: is not valid TOML ({error}); write tables such as [flight].") from None
    try:
        return _plan_of(tables)
    except JaxbaError as error:
        raise JaxbaError(f"{path}: {error}") from None


def _plan_of(tables: dict[str, Any]) -> FlightPlan:
    area = tables.pop("area", None)
    if not isinstance(area, dict) or "polygon" not in area:
        raise JaxbaError("there is no area.polygon; write [area] and polygon = [[x, y], [x, y], [x, y]].")
    unknown = sorted(set(area) - {"polygon", "crs"})
    if unknown:
        raise JaxbaError(f"no parameter area.{unknown[0]}; the parameters of area are polygon, crs.")
    crs = area.get("crs")
    if crs is not None and not isinstance(crs, str):
        raise JaxbaError(f'area.crs={crs}: give a text, such as "EPSG:32615".')
    control = tables.get("control")
    points = control.pop("points", []) if isinstance(control, dict) else []
    known: dict[str, Any] = set_from_tables(sections(), tables)
    polygon = _pairs("area.polygon", area["polygon"], least=3)
    place, area_m = Place.of(polygon, crs)
    _refuse_polygon(area_m)
    height, relief = known["flight"].height_m, known["ground"].relief_m
    if relief > height:
        raise JaxbaError(
            f"ground.relief_m={relief:g} is over flight.height_m={height:g}, which counts from the mean ground: hills "
            "would reach the photos. Fly higher, or plan a part of the area with less relief."
        )
    control_m = place.local(_pairs("control.points", points, least=0))
    return FlightPlan(area_m=area_m, place=place, control_m=control_m, **known)


def _pairs(name: str, given: Any, *, least: int) -> Float[np.ndarray, "n 2"]:
    rows = given if isinstance(given, list) else [given]
    for number, row in enumerate(rows, 1):
        is_pair = isinstance(row, list) and len(row) == 2 and all(type(value) in (int, float) for value in row)
        if not is_pair or not np.isfinite(row).all():
            raise JaxbaError(f"{name}: entry {number} is {row!r}; give pairs [x, y] of numbers.")
    if len(rows) < least:
        raise JaxbaError(f"{name} has {len(rows)} corners; give {least} or more.")
    return np.array(rows, float).reshape(-1, 2)


def _refuse_polygon(area_m: Float[np.ndarray, "corners 2"]) -> None:
    import shapely

    polygon = shapely.Polygon(area_m)
    if not polygon.is_valid:
        reason = shapely.is_valid_reason(polygon)
        raise JaxbaError(f"area.polygon crosses itself ({reason}, metres about its middle); give corners in order.")
    if polygon.area < _LEAST_AREA:
        raise JaxbaError(
            f"area.polygon has {polygon.area:.2g} square metres, which is none to fly; for degrees of longitude and "
            'latitude write crs = "EPSG:4326" beside it.'
        )


def example() -> str:
    """Return a plan to begin with: a square, and every parameter with its default, range and meaning."""
    area = [
        "[area]",
        "# corners, x (or longitude) first",
        "polygon = [[0, 0], [300, 0], [300, 200], [0, 200]]",
        "# of the coordinates; without it they are metres",
        '# crs = "EPSG:32615"',
        "",
    ]
    control = ["# places of control points, in the same coordinates", "# points = [[10, 10], [290, 190]]", ""]
    return "\n".join(area) + "\n" + to_toml(sections(), explain=True) + "\n".join(control)


def sections() -> dict[str, Parameters]:
    """Return the tables of a plan with their defaults."""
    return {section.section: section() for section in _SECTIONS}
