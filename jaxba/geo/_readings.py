"""Where coordinates of a list would lie if a usual mistake were undone: what a message can say of a list that lies
elsewhere than the photos. A kilometre or so is all that counts here, so datums are not transformed.
"""

from collections.abc import Iterator

import numpy as np
from jaxtyping import Float
from pyproj import CRS, Geod, Transformer
from pyproj.aoi import AreaOfInterest
from pyproj.database import query_crs_info
from pyproj.enums import PJType
from pyproj.exceptions import ProjError

from jaxba._crs_text import horizontal_part
from jaxba.geo._crs import describe, parse_crs, utm_zone
from jaxba.geo._extent import middle

FOOT_M = 0.3048
Reading = tuple[str, Float[np.ndarray, " points"], Float[np.ndarray, " points"]]
"""The mistake undone, in words, and the longitude and latitude that follow."""


def would_fit(
    crs: str,
    xy: Float[np.ndarray, "points 2"],
    longitude_deg: Float[np.ndarray, " points"],
    latitude_deg: Float[np.ndarray, " points"],
    within_m: float,
) -> tuple[str, float] | None:
    """Return which mistake, undone, brings points nearest to places on WGS 84, and how far they still are, metres.

    The distance is the median of the points'. None where no mistake brings it within `within_m`. Where none of the
    usual ones does, the CRS is looked for among EPSG's for the place.

    >>> would_fit("EPSG:32614", np.array([[484201.6, 4971854.0]]), np.array([-93.2]), np.array([44.9]), 1e3)
    ('UTM zone 15N (EPSG:32615)', 10.7)
    """
    place = middle(longitude_deg, latitude_deg)
    for readings in (elsewhere(crs, xy, place), _codes_around(xy, place)):
        tried = [
            (words, float(np.median(distance_m(lon, lat, longitude_deg, latitude_deg)))) for words, lon, lat in readings
        ]
        words, away_m = min(tried, key=lambda entry: round(entry[1], -1), default=("", np.inf))  # of equals, the first
        if away_m <= within_m:
            return words, round(away_m, 1)
    return None


def distance_m(
    lon: Float[np.ndarray, " points"],
    lat: Float[np.ndarray, " points"],
    other_lon: Float[np.ndarray, " points"],
    other_lat: Float[np.ndarray, " points"],
) -> Float[np.ndarray, " points"]:
    """Return geodesic distances between places on WGS 84, metres; a place that is none on earth is infinitely far.

    >>> distance_m(np.array([8.5, np.nan]), np.array([47.4, 0.0]), np.array([8.5, 0.0]), np.array([46.4, 0.0])).round()
    array([111169.,     inf])
    """
    ends = np.stack([lon, lat, other_lon, other_lat])
    known = np.asarray(np.isfinite(ends).all(axis=0) & (np.abs(ends[1::2]) <= 90).all(axis=0))
    away = np.full(len(known), np.inf)
    away[known] = Geod(ellps="WGS84").inv(*ends[:, known])[2]
    return away


def elsewhere(crs: str, xy: Float[np.ndarray, "points 2"], near: tuple[float, float]) -> list[Reading]:
    """Return where points would lie with usual mistakes undone: axes, units, zone, hemisphere, degrees, signs.

    - `near`: longitude and latitude where they ought to be, for the UTM zone.
    """
    flat = horizontal_part(parse_crs(crs))
    swapped = xy[:, ::-1]
    found = [("x and y swapped", *rough_places(flat, swapped))]
    if not flat.is_geographic:
        degrees = CRS.from_epsg(4326)
        found.append(("x and y read as degrees of longitude and latitude (EPSG:4326)", *rough_places(degrees, xy)))
        latitude_first = "x and y read as degrees of latitude and longitude (EPSG:4326, swapped)"
        found.append((latitude_first, *rough_places(degrees, swapped)))
    for given, order in ((xy, ""), (swapped, " and x and y swapped")):
        found += [(words + order, lon, lat) for words, lon, lat in _other_readings(flat, given, near)]
    return [(words, lon, lat) for words, lon, lat in found if (np.isfinite(lon) & np.isfinite(lat)).any()]


def _other_readings(crs: CRS, xy: Float[np.ndarray, "points 2"], near: tuple[float, float]) -> Iterator[Reading]:
    if crs.is_geographic:
        yield "the other sign of x", *rough_places(crs, xy * [-1, 1])
        yield "the other sign of y", *rough_places(crs, xy * [1, -1])
        yield "the other signs of x and y", *rough_places(crs, -xy)
        unit_m, zones = 1.0, [utm_zone(*near)]
    else:
        unit_m, zones = crs.axis_info[0].unit_conversion_factor, _zones(crs, near)
        if unit_m == 1:
            yield "x and y read as feet", *rough_places(crs, xy * FOOT_M)
        else:
            yield "x and y read as metres", *rough_places(crs, xy / unit_m)
    for zone in zones:
        name = zone.name.removeprefix("WGS 84 / ")
        yield f"{name} (EPSG:{zone.to_epsg()})", *rough_places(zone, xy * unit_m)
        if unit_m != 1:
            yield f"{name} (EPSG:{zone.to_epsg()}) in metres", *rough_places(zone, xy)


def _zones(crs: CRS, near: tuple[float, float]) -> list[CRS]:
    """Return the UTM zones beside a CRS's own, that of the other hemisphere, and that of a place."""
    found = []
    if crs.utm_zone is not None:
        number, side = int(crs.utm_zone[:-1]), crs.utm_zone[-1]
        others = [((number - 2) % 60 + 1, side), (number % 60 + 1, side), (number, "S" if side == "N" else "N")]
        found = [CRS.from_epsg((32600 if side == "N" else 32700) + number) for number, side in others]
    place = utm_zone(*near)
    return found if place in found else [*found, place]


def _codes_around(xy: Float[np.ndarray, "points 2"], near: tuple[float, float]) -> Iterator[Reading]:
    """Yield the points in every projected CRS that EPSG has for a place: a state plane or a strip one off."""
    around = AreaOfInterest(*near, *near)
    for entry in query_crs_info("EPSG", PJType.PROJECTED_CRS, around, contains=True):
        crs = CRS(f"EPSG:{entry.code}")
        yield describe(crs), *rough_places(crs, xy)


def rough_places(crs: CRS, xy: Float[np.ndarray, "points 2"]) -> tuple[np.ndarray, np.ndarray]:
    """Return longitude and latitude in the CRS's own datum: within 500 m or so of WGS 84."""
    if crs.is_geographic:
        fits = (np.abs(xy) <= [180, 90]).all(axis=1)
        return np.where(fits, xy[:, 0], np.nan), np.where(fits, xy[:, 1], np.nan)
    try:
        way = Transformer.from_crs(crs, crs.geodetic_crs, always_xy=True)
    except ProjError:  # of a CRS whose method PROJ does not know: no reading
        return np.full(len(xy), np.nan), np.full(len(xy), np.nan)
    lon, lat = way.transform(xy[:, 0], xy[:, 1])
    return np.where(np.isfinite(lon), lon, np.nan), np.where(np.isfinite(lat), lat, np.nan)
