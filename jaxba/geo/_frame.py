"""The local frame of an adjustment, and the exact ways between it, WGS 84 and the target CRS, point by point.

    local  <- topocentric ->  WGS 84  <- the survey's operation, heights by their step ->  target CRS

Each point takes the whole way: an affine short cut would leave a CRS's scale, its meridian convergence and the earth's
curvature behind (8 cm of height a kilometre from the origin). A million points take about half a second.

Heights above mean sea level enter the topocentric formula as if above the ellipsoid. They come out the same, and the
horizontal scale is wrong by geoid height over earth's radius, at most 2e-5.
"""

from functools import lru_cache

import numpy as np
from jaxtyping import Float
from pyproj import CRS, Transformer
from pyproj.enums import TransformDirection

from jaxba._crs_text import authority_code
from jaxba._errors import JaxbaError
from jaxba.geo._extent import middle
from jaxba.geo._heights import HeightStep, height_step
from jaxba.geo._operation import Operation, horizontal_operation
from jaxba.scene import LocalFrame


def local_frame(
    crs: CRS,
    longitude_deg: Float[np.ndarray, " positions"],
    latitude_deg: Float[np.ndarray, " positions"],
    height_m: Float[np.ndarray, " positions"],
    height_datum: str = "unknown",
    declared: str = "by the photos' tags",
) -> LocalFrame:
    """Return the local frame near the middle (median) of a survey on WGS 84, for results in a target CRS.

    The origin is the middle to a thousandth of a degree (100 m): a photo more or less mostly leaves it where it is.

    - `height_m`: NaN where unknown. `height_datum`, `declared`: see `height_step`.

    Raises `JaxbaError` where no transformation, or none for the heights, leads to the target CRS.

    >>> place = np.array([-92.0]), np.array([46.8]), np.array([198.0])
    >>> frame = local_frame(CRS("EPSG:32615"), *place)
    >>> projected_from_local(frame, np.array([[0.0, 0.0, 10.0]])).round(1).tolist()
    [[576308.6, 5183424.7, 208.0]]
    """
    lon, lat = middle(longitude_deg, latitude_deg)
    heights = height_m[np.isfinite(height_m)]
    lon, lat, height = round(lon, 3), round(lat, 3), round(float(np.median(heights)), 3) if len(heights) else 0.0
    horizontal_operation(crs, lon, lat)
    step = height_step(crs, height_datum, declared, lon, lat, height)
    code = authority_code(crs)
    return LocalFrame(
        latitude_deg=lat,
        longitude_deg=lon,
        height_m=height,
        crs=code or crs.to_wkt(),
        epsg=int(code.removeprefix("EPSG:")) if code and code.startswith("EPSG:") and "+" not in code else None,
        crs_name=crs.name,
        unit=crs.axis_info[0].unit_name,
        height_note=step.note,
        height_datum=height_datum,
        height_unit=step.unit,
    )


def local_from_geodetic(
    frame: LocalFrame,
    longitude_deg: Float[np.ndarray, " points"],
    latitude_deg: Float[np.ndarray, " points"],
    height_m: Float[np.ndarray, " points"],
) -> Float[np.ndarray, "points 3"]:
    """Return east, north, up in metres of places on WGS 84 with heights in the frame's own system; NaN stays NaN."""
    return np.stack(_topocentric(frame).transform(longitude_deg, latitude_deg, height_m), axis=1)


def geodetic_from_local(frame: LocalFrame, xyz_m: Float[np.ndarray, "points 3"]) -> Float[np.ndarray, "points 3"]:
    """Return longitude, latitude (degrees, WGS 84) and height (metres, the frame's own system) of local points."""
    columns = np.asarray(xyz_m, dtype=float).T
    return np.stack(_topocentric(frame).transform(*columns, direction=TransformDirection.INVERSE), axis=1)


def projected_from_local(frame: LocalFrame, xyz_m: Float[np.ndarray, "points 3"]) -> Float[np.ndarray, "points 3"]:
    """Return x, y in the target CRS (east, north, its units) and z as the frame's `height_note` says; NaN stays NaN.

    Raises `JaxbaError` where the projection does not reach a point.
    """
    operation, step = _ways(frame)
    lon, lat, height = geodetic_from_local(frame, xyz_m).T
    x, y = operation.transformer.transform(lon, lat)
    if step.operation is None:
        z = height / step.unit_m
    else:
        z = step.operation.transformer.transform(lon, lat, height / step.source_unit_m)[2]
    return _checked(np.stack([x, y, z], axis=1), xyz_m, frame)


def grid_from_local(frame: LocalFrame, xyz_m: Float[np.ndarray, "points 3"]) -> Float[np.ndarray, "points 3 3"]:
    """Return the rotation from the local axes to those of the grid at each point; NaN where the grid is mirrored.

    The grid's axes are x and y of the target CRS at that point, level there, and up. Against local east, north, up of
    the origin they are turned by the meridian convergence, and tilted by the earth's curvature (0.009 degrees a
    kilometre). It is the rotation nearest to the Jacobian of the map, so scale and units drop out.

    >>> frame = local_frame(CRS("EPSG:32615"), np.array([-92.0]), np.array([46.8]), np.array([198.0]))
    >>> x, y = grid_from_local(frame, np.zeros((1, 3)))[0][:2, 0]
    >>> round(float(np.degrees(np.arctan2(y, x))), 4)  # grid north is 0.729 degrees east of true north
    0.729
    """
    at = np.repeat(np.asarray(xyz_m, float), 6, axis=0)
    steps = np.concatenate([np.eye(3), -np.eye(3)])
    around = projected_from_local(frame, at + np.tile(steps, (len(xyz_m), 1)))
    around[:, 2] = geodetic_from_local(frame, at + np.tile(steps, (len(xyz_m), 1)))[:, 2]  # level, whatever the geoid
    pairs = around.reshape(-1, 2, 3, 3)
    jacobian = np.swapaxes(pairs[:, 0] - pairs[:, 1], 1, 2) / 2
    known = np.asarray(np.isfinite(jacobian).all(axis=(1, 2)))
    u, _, vt = np.linalg.svd(np.where(known[:, None, None], jacobian, np.eye(3)))
    rotation = u @ vt
    return np.where((known & (np.linalg.det(rotation) > 0))[:, None, None], rotation, np.nan)


def local_from_projected(frame: LocalFrame, xyz: Float[np.ndarray, "points 3"]) -> Float[np.ndarray, "points 3"]:
    """Return local points of x, y, z in the target CRS and its units: the inverse of `projected_from_local`."""
    operation, step = _ways(frame)
    x, y, z = np.asarray(xyz, dtype=float).T
    lon, lat = operation.inverse(x, y)
    if step.operation is None:
        height = z * step.unit_m
    else:
        back = step.operation.transformer.transform(x, y, z, direction=TransformDirection.INVERSE)
        height = back[2] * step.source_unit_m
    return _checked(local_from_geodetic(frame, lon, lat, height), xyz, frame)


def _checked(
    result: Float[np.ndarray, "points 3"], given: Float[np.ndarray, "points 3"], frame: LocalFrame
) -> Float[np.ndarray, "points 3"]:
    failed = ~np.isfinite(result).all(axis=1) & np.isfinite(given).all(axis=1)
    if failed.any():
        row = int(np.argmax(failed))
        raise JaxbaError(
            f"{np.count_nonzero(failed)} points cannot be transformed between the local frame and {frame.crs_name}, "
            f"the first {np.asarray(given)[row].tolist()}: far outside the survey; remove them, or check the CRS."
        )
    return result


@lru_cache(maxsize=8)
def _topocentric(frame: LocalFrame) -> Transformer:
    origin = f"+lon_0={frame.longitude_deg!r} +lat_0={frame.latitude_deg!r} +h_0={frame.height_m!r}"
    return Transformer.from_pipeline(
        "+proj=pipeline +step +proj=unitconvert +xy_in=deg +xy_out=rad +step +proj=cart +ellps=WGS84 "
        f"+step +proj=topocentric +ellps=WGS84 {origin}"
    )


@lru_cache(maxsize=8)
def _ways(frame: LocalFrame) -> tuple[Operation, HeightStep]:
    crs = CRS(frame.crs)
    place = frame.longitude_deg, frame.latitude_deg
    return horizontal_operation(crs, *place), height_step(crs, frame.height_datum, "", *place, frame.height_m)
