"""Cameras as GeoPackage and GeoJSON: a point with height for each photo, and what the adjustment says of it.

The GeoPackage is in the target CRS. GeoJSON is longitude, latitude (WGS 84) and height, which RFC 7946 prescribes.
GDAL writes both into memory, and the bytes then go to the disk whole or not at all; its clock is set to a fixed date,
so the same cameras give the same bytes.
"""

import contextlib
import io
import os
from collections.abc import Iterator
from typing import Any

import numpy as np
from jaxtyping import Float

from jaxba._errors import JaxbaError
from jaxba.io._atomic import write_atomically
from jaxba.io._crs import CrsText
from jaxba.io._sites import Sites

LAYER = "cameras"
_DATE = "2000-01-01T00:00:00.000Z"
_WGS_84 = "EPSG:4326"


def write_geopackage(
    path: str | os.PathLike[str], sites: Sites, xyz: Float[np.ndarray, "photos 3"], crs: CrsText
) -> None:
    """Write the layer `cameras` as GeoPackage; `xyz` are x, y, z in the CRS.

    Raises:
        JaxbaError: a place that is not finite, a CRS that GDAL does not know; or the file cannot be written.
    """
    options = {"IDENTIFIER": LAYER, "DESCRIPTION": crs.height_note}
    with _fixed_date():
        _write(path, sites, xyz, driver="GPKG", crs=crs.text, layer_options=options)


def write_geojson(
    path: str | os.PathLike[str], sites: Sites, geodetic: Float[np.ndarray, "photos 3"], *, description: str = ""
) -> None:
    """Write the cameras as GeoJSON; `geodetic` are longitude, latitude (degrees, WGS 84) and height (metres).

    `description`: for readers, e.g. what heights are above.

    Raises:
        JaxbaError: a place that is not finite or no longitude and latitude; or the file cannot be written.
    """
    # nine decimals of a degree are a tenth of a millimetre
    options = {"RFC7946": "YES", "COORDINATE_PRECISION": "9", "DESCRIPTION": description}
    _write(path, sites, geodetic, driver="GeoJSON", crs=_WGS_84, layer_options=options)


def _write(
    path: str | os.PathLike[str],
    sites: Sites,
    places: Float[np.ndarray, "photos 3"],
    *,
    driver: str,
    crs: str,
    layer_options: dict[str, str],
) -> None:
    import shapely
    from pyogrio import raw
    from pyogrio.errors import DataLayerError, DataSourceError

    label = os.fspath(path)
    bad = np.flatnonzero(~np.isfinite(places).all(axis=1))
    if bad.size:
        raise JaxbaError(f"{label}: not written, {sites.name[bad[0]]} has no finite place; leave it out.")
    columns = _columns(sites)
    buffer = io.BytesIO()
    try:
        raw.write(
            buffer,
            shapely.to_wkb(shapely.points(places), output_dimension=3, flavor="iso"),
            list(columns.values()),
            np.array(list(columns), dtype=object),
            layer=LAYER,
            driver=driver,
            geometry_type="Point Z",
            crs=crs,
            layer_options={name: value for name, value in layer_options.items() if value},
        )
    except (DataSourceError, DataLayerError, RuntimeError) as error:
        raise JaxbaError(f"{label}: not written, GDAL says {error}; check the CRS and the places.") from error
    with write_atomically(path) as file:
        file.write(buffer.getvalue())


def _columns(sites: Sites) -> dict[str, np.ndarray]:
    columns: dict[str, Any] = {
        "name": np.array(sites.name, object),
        "camera": np.array(sites.camera, object),
        "registered": sites.is_registered,
    }
    for axis, column in zip("enu", sites.std_m.T, strict=True):
        columns[f"std_{axis}_m"] = column
    for axis, column in zip("enu", sites.gnss_residual_m.T, strict=True):
        columns[f"gnss_residual_{axis}_m"] = column
    for angle, column in zip(("yaw", "pitch", "roll"), sites.attitude_deg.T, strict=True):
        columns[f"{angle}_deg"] = column
    columns["heading_deg"] = sites.heading_deg
    columns["num_observations"] = sites.num_observations.astype(np.int32)
    columns["median_error_px"] = sites.median_error_px
    columns["reason"] = np.array(sites.reason, object)
    return {name: np.ascontiguousarray(column) for name, column in columns.items()}


@contextlib.contextmanager
def _fixed_date() -> Iterator[None]:
    import pyogrio

    before = pyogrio.get_gdal_config_option("OGR_CURRENT_DATE")
    pyogrio.set_gdal_config_options({"OGR_CURRENT_DATE": _DATE})
    try:
        yield
    finally:
        pyogrio.set_gdal_config_options({"OGR_CURRENT_DATE": before})
