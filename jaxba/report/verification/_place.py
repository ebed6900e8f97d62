"""Checks of the place on earth: every file says the CRS that was resolved, and the cloud lies where the photos were.

The positions are those of the photos' tags or list, brought into the CRS by pyproj in one step and not by the survey's
local frame, so that an error of that frame shows. Lengths are metres, whatever the CRS's unit.

A camera sees ground that lies aside of it by its distance from the ground at most; a cloud farther away than twice
that, and than five sigmas of the positions, is not the ground of these photos.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from pyproj import CRS, Transformer
from pyproj.exceptions import CRSError

from jaxba.engine._project import Project
from jaxba.engine._stage import Pipeline
from jaxba.engine._store import load, read_record
from jaxba.report.verification._check import Check, failed, judged, skipped
from jaxba.report.verification._exported import CLOUDS, DESCRIPTION, FRAME, TEXT, Exported

_EDGE_DEG = 0.05  # bounds of an area of use are rounded
_REACH = 2.0  # of the distance from the cameras to their points
_SIGMAS = 5.0
_BEND = 0.05  # of the positions' extent: a receiver's drift during a flight
_INSIDE = 0.9  # of the positions: some may be outliers
_CURE = "run again to export it anew"
_NO_PLACE = "no place on earth: the block has no CRS, since positions do not determine one"


@dataclass(frozen=True, kw_only=True, eq=False)
class Measured:
    """Positions as the photos or their list state them, of those that are trusted.

    - `xy`: in the CRS of the exports, its unit. `std_m`: horizontal sigma. `unit_m`: metres in a unit of the CRS.
    """

    xy: dict[str, Float[np.ndarray, "2"]]
    std_m: float
    unit_m: float


def place_checks(
    project: Project, pipeline: Pipeline, exported: Exported, offset_m: Float[np.ndarray, "3"]
) -> Iterator[Check]:
    """Yield the checks of CRS and place; skipped where the block has none.

    `offset_m`: what the measured positions are off from control in common.
    """
    missing = [name for name in ("control", "metadata") if read_record(project.stage(name)) is None]
    if missing:
        yield failed("CRS", f"the record of the {missing[0]} stage is missing or damaged; run again to make it anew.")
        return
    reference = load(project.stage("control"), pipeline["control"].module.Outputs).reference
    if (exported.has(FRAME) and exported.frame is None) or reference.frame is None:
        for name in ("CRS", "area of use", "cloud at its cameras", "positions in the cloud's box", "camera positions"):
            yield skipped(name, _NO_PLACE)
        return
    resolved = CRS(reference.frame.crs)
    yield from _crs_checks(exported, resolved, reference.frame.crs)
    clouds = {name: _finite_xy(exported, name) for name in CLOUDS if exported.has(name)}
    flat = _horizontal(resolved)
    for name, xy in clouds.items():
        if not len(xy):
            yield skipped(f"area of use {name}", "no point has finite coordinates")
            continue
        yield _in_area_of_use(name, xy, flat)
    photos = load(project.stage("metadata"), pipeline["metadata"].module.Outputs).photos
    xy = {}
    for photo, is_used in zip(photos, reference.is_used, strict=True):
        if is_used and photo.position is not None:
            way = Transformer.from_crs(photo.position.crs, flat, always_xy=True)
            xy[photo.name] = np.array(way.transform(photo.position.x, photo.position.y))
    std_m = float(np.median(reference.std_m[reference.is_used][:, :2])) if xy else np.nan
    measured = Measured(xy=xy, std_m=std_m, unit_m=flat.axis_info[0].unit_conversion_factor)
    if not exported.has(TEXT):
        yield skipped("place", f"{TEXT} could not be read, which tells what each camera sees")
        return
    for name in (name for name, xy in clouds.items() if len(xy)):
        yield _at_cameras(name, exported, measured)
        yield _around_positions(name, exported, measured)
    yield _camera_positions(exported, measured, float(np.hypot(*offset_m[:2])))


def _finite_xy(exported: Exported, file: str) -> Float[np.ndarray, "points 2"]:
    xy = exported[file].cloud.xyz[:, :2]
    return xy[np.isfinite(xy).all(axis=1)]


def _horizontal(crs: CRS) -> CRS:
    return crs.sub_crs_list[0].to_2d() if crs.is_compound else crs.to_2d()


def _crs_checks(exported: Exported, resolved: CRS, code: str) -> Iterator[Check]:
    """Yield a check for each file that says its CRS."""
    said = {
        "cloud.csv": ("column EPSG", lambda found: found.crs),
        DESCRIPTION: ("field wkt", lambda found: found["wkt"] or ""),
        "cloud.laz": ("its header", lambda found: found.crs),
        "cameras.gpkg": ("its layer", lambda found: found.crs),
        FRAME: ("field crs of the origin", lambda found: found.crs),
    }
    wanted = f"{code} ({resolved.name})" if code.startswith("EPSG:") else resolved.name
    for file, (place, read) in said.items():
        if not exported.has(file):
            continue
        text, name = read(exported[file]), f"CRS {file}"
        if not text and file == "cloud.csv" and not code.startswith("EPSG:"):
            yield skipped(name, f"{wanted} has no code that the column EPSG could hold")
        elif not text:
            yield failed(name, f"{place} says no CRS, it must be {wanted}: the CRS was lost; {_CURE}.")
        else:
            yield _same_crs(name, place, text, resolved, wanted)


def _same_crs(name: str, place: str, text: str, resolved: CRS, wanted: str) -> Check:
    try:
        found = CRS(text)
    except CRSError:
        return failed(name, f"{place} says {text[:80]!r}, which is no CRS; it must be {wanted}; {_CURE}.")
    return judged(
        name,
        found.equals(resolved, ignore_axis_order=True),
        f"{place} says {found.name}",
        f"{place} says {text if len(text) < 40 else found.name}, it must be {wanted}: the CRS was changed; {_CURE}.",
    )


def _in_area_of_use(file: str, xy: Float[np.ndarray, "points 2"], crs: CRS) -> Check:
    name, area = f"area of use {file}", crs.area_of_use
    if area is None:
        return skipped(name, f"{crs.name} states no area of use")
    low, high = xy.min(axis=0), xy.max(axis=0)
    corners = np.array([(x, y) for x in (low[0], high[0]) for y in (low[1], high[1])])
    lon, lat = Transformer.from_crs(crs, crs.geodetic_crs, always_xy=True).transform(*corners.T)
    west, south, east, north = area.bounds
    half = ((east - west) % 360 or 360) / 2
    beside = np.abs((np.asarray(lon) - (west + half) + 180) % 360 - 180) - half
    outside = np.maximum(beside, np.maximum(south - lat, lat - north))
    box = f"longitude {np.min(lon):.4f} to {np.max(lon):.4f}, latitude {np.min(lat):.4f} to {np.max(lat):.4f}"
    bounds = f"that of {crs.name}, {west:g} to {east:g}, {south:g} to {north:g}"
    is_inside = bool(np.isfinite(outside).all() and outside.max() <= _EDGE_DEG)
    cure = "X and Y may be swapped, or of another zone"
    return judged(name, is_inside, f"{box}, inside {bounds}", f"{box}, outside {bounds}: {cure}; {_CURE}.")


def _reach_m(exported: Exported, measured: Measured) -> float:
    """Return how far aside of a camera the points that it sees may lie: metres."""
    block = exported[TEXT].block
    apart_m = block.centers_m[block.observation_image] - block.points_m[block.observation_point]
    return _REACH * float(np.nanmedian(np.linalg.norm(apart_m, axis=1))) + _SIGMAS * measured.std_m


def _at_cameras(file: str, exported: Exported, measured: Measured) -> Check:
    """The points that each photo sees lie near its measured position."""
    name, model, cloud = f"cloud at its cameras {file}", exported[TEXT], exported[file].cloud
    places = {photo.replace(" ", "%20"): xy for photo, xy in measured.xy.items()}  # as COLMAP's text has them
    rows = [row for row, photo in enumerate(model.names) if photo in places]
    if not rows:
        return skipped(name, "no registered photo has a position that is trusted")
    xy = np.full((model.block.num_points + 1, 2), np.nan)
    known = cloud.point_id < len(xy)
    xy[cloud.point_id[known]] = cloud.xyz[known, :2]
    away_m = []
    for row in rows:
        seen = xy[model.block.observation_point[model.block.observation_image == row] + 1]
        seen = seen[np.isfinite(seen).all(axis=1)]
        if len(seen):
            away_m.append(measured.unit_m * np.hypot(*(np.median(seen, axis=0) - places[model.names[row]])))
    if not away_m:
        return skipped(name, "no registered photo with a position sees a point of it")
    median, limit = float(np.median(away_m)), _reach_m(exported, measured)
    figures = f"the points of a photo lie {median:.1f} m from its measured position (median of {len(away_m)} photos)"
    return judged(
        name,
        median <= limit,
        f"{figures}, at most {limit:.0f} m",
        f"{figures}, over {limit:.0f} m (twice the distance from camera to ground): X or Y are shifted or swapped; "
        f"if all files are, see `jaxba diagnose`, else {_CURE}.",
    )


def _around_positions(file: str, exported: Exported, measured: Measured) -> Check:
    """The cloud's box, grown by what a camera sees aside, holds the measured positions."""
    name, xy = f"positions in the cloud's box {file}", _finite_xy(exported, file)
    if not measured.xy:
        return skipped(name, "no photo has a position that is trusted")
    reach = _reach_m(exported, measured) / measured.unit_m
    low, high = xy.min(axis=0) - reach, xy.max(axis=0) + reach
    inside = {photo: bool(np.all((place >= low) & (place <= high))) for photo, place in measured.xy.items()}
    first = next((photo for photo, is_inside in inside.items() if not is_inside), "")
    figures = f"{sum(inside.values())} of {len(inside)} measured positions lie in the cloud's box, grown by a reach of "
    figures += f"{reach * measured.unit_m:.0f} m"
    return judged(
        name,
        sum(inside.values()) >= _INSIDE * len(inside),
        figures,
        f"{figures}; the first outside is {first}: the cloud is not where the photos were taken; if all files are so, "
        f"see `jaxba diagnose`, else {_CURE}.",
    )


def _camera_positions(exported: Exported, measured: Measured, moved_m: float) -> Check:
    """The adjusted cameras, of the GeoPackage, lie where they were measured."""
    name, file = "camera positions", "cameras.gpkg"
    if not exported.has(file):
        return skipped(name, f"{file} could not be read")
    sites = exported[file]
    rows = [k for k, photo in enumerate(sites.name) if sites.is_registered[k] and photo in measured.xy]
    if not rows:
        return skipped(name, "no registered photo has a position that is trusted")
    places = np.array([measured.xy[sites.name[k]] for k in rows])
    away_m = measured.unit_m * np.hypot(*(sites.xyz[rows, :2] - places).T)
    extent_m = measured.unit_m * float(np.hypot(*np.ptp(places, axis=0)))
    median, limit = float(np.median(away_m)), max(_SIGMAS * measured.std_m, _BEND * extent_m) + moved_m
    figures = f"adjusted minus measured is {median:.2f} m horizontally (median of {len(rows)} photos)"
    return judged(
        name,
        median <= limit,
        f"{figures}, at most {limit:.2f} m",
        f"{file}: {figures}, over {limit:.2f} m (five sigmas, or 5% of the positions' extent, "
        f"and what control moves them): its places are shifted; "
        f"if all files are, see `jaxba diagnose`, else {_CURE}.",
    )
