"""Cameras as GeoPackage and GeoJSON: a point with height for each photo, and what the adjustment says of it.

The GeoPackage is in the target CRS, and describes its columns in the table `gpkg_data_columns`. GeoJSON is longitude,
latitude (WGS 84) and height, which RFC 7946 prescribes. GDAL writes both into memory, and the bytes then go to the disk
whole or not at all; its clock is set to the day of the flight, so the same cameras give the same bytes.
"""

import contextlib
import datetime
import io
import os
import sqlite3
from collections.abc import Iterator
from typing import Any

import numpy as np
from jaxtyping import Float

from jaxba._atomic import write_atomically
from jaxba._errors import JaxbaError
from jaxba.io._crs import CrsText
from jaxba.io._sites import SITE_COLUMNS, Sites

LAYER = "cameras"
_NO_DATE = datetime.date(2000, 1, 1)  # the format must have one
# OGC 12-128r19, annex F.9 (schema extension)
_DESCRIBE = """
CREATE TABLE gpkg_data_columns (table_name TEXT NOT NULL, column_name TEXT NOT NULL, name TEXT, title TEXT,
 description TEXT, mime_type TEXT, constraint_name TEXT,
 CONSTRAINT pk_gdc PRIMARY KEY (table_name, column_name), CONSTRAINT gdc_tn UNIQUE (table_name, name));
CREATE TABLE gpkg_data_column_constraints (constraint_name TEXT NOT NULL, constraint_type TEXT NOT NULL, value TEXT,
 min NUMERIC, min_is_inclusive BOOLEAN, max NUMERIC, max_is_inclusive BOOLEAN, description TEXT,
 CONSTRAINT gdcc_ntv UNIQUE (constraint_name, constraint_type, value));
INSERT INTO gpkg_extensions (table_name, column_name, extension_name, definition, scope) VALUES
 ('gpkg_data_columns', NULL, 'gpkg_schema', 'http://www.geopackage.org/spec121/#extension_schema', 'read-write'),
 ('gpkg_data_column_constraints', NULL, 'gpkg_schema', 'http://www.geopackage.org/spec121/#extension_schema',
  'read-write');
"""
_WGS_84 = "EPSG:4326"


def write_geopackage(
    path: str | os.PathLike[str],
    sites: Sites,
    xyz: Float[np.ndarray, "photos 3"],
    crs: CrsText,
    *,
    date: datetime.date | None = None,
) -> None:
    """Write the layer `cameras` as GeoPackage; `xyz` are x, y, z in the CRS, `date` the day of the flight.

    Raises:
        JaxbaError: a place that is not finite, a CRS that GDAL does not know; or the file cannot be written.
    """
    options = {"IDENTIFIER": LAYER, "DESCRIPTION": crs.height_note}
    with _dated(date or _NO_DATE):
        content = _written(path, sites, xyz, driver="GPKG", crs=crs.text, layer_options=options)
    with write_atomically(path) as file:
        file.write(_described(content))


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
    content = _written(path, sites, geodetic, driver="GeoJSON", crs=_WGS_84, layer_options=options)
    with write_atomically(path) as file:
        file.write(content)


def _described(content: bytes) -> bytes:
    """Return a GeoPackage with what each column of its layer is."""
    rows = [(LAYER, name, meaning) for name, meaning in SITE_COLUMNS.items()]
    with contextlib.closing(sqlite3.connect(":memory:")) as base:
        base.deserialize(content)
        base.executescript(_DESCRIBE)
        base.executemany("INSERT INTO gpkg_data_columns (table_name, column_name, description) VALUES (?, ?, ?)", rows)
        base.commit()
        return base.serialize()


def _written(
    path: str | os.PathLike[str],
    sites: Sites,
    places: Float[np.ndarray, "photos 3"],
    *,
    driver: str,
    crs: str,
    layer_options: dict[str, str],
) -> bytes:
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
    return buffer.getvalue()


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
    for angle, column in zip(("omega", "phi", "kappa"), sites.omega_phi_kappa_deg.T, strict=True):
        columns[f"{angle}_deg"] = column
    columns["num_observations"] = sites.num_observations.astype(np.int32)
    columns["median_error_px"] = sites.median_error_px
    columns["reason"] = np.array(sites.reason, object)
    return {name: np.ascontiguousarray(column) for name, column in columns.items()}


@contextlib.contextmanager
def _dated(date: datetime.date) -> Iterator[None]:
    """Set GDAL's clock to a day while the block runs."""
    import pyogrio

    before = pyogrio.get_gdal_config_option("OGR_CURRENT_DATE")
    pyogrio.set_gdal_config_options({"OGR_CURRENT_DATE": f"{date.isoformat()}T00:00:00.000Z"})
    try:
        yield
    finally:
        pyogrio.set_gdal_config_options({"OGR_CURRENT_DATE": before})
