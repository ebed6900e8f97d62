"""Cameras from the GeoPackage and the GeoJSON that jaxba writes, held against the columns that they must have."""

import os
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from jaxba._errors import JaxbaError
from jaxba.io._geopackage import LAYER
from jaxba.io._sites import SITE_COLUMNS


@dataclass(frozen=True, kw_only=True, eq=False)
class SitesFile:
    """Cameras, one row a photo.

    - `xyz`: in `crs`, a code or WKT as the file says; empty where it says none.
    - `is_registered`: the place is adjusted, else it is the measured one.
    - `median_error_px`: NaN where the photo is not registered.
    """

    name: tuple[str, ...]
    xyz: Float[np.ndarray, "photos 3"]
    is_registered: Bool[np.ndarray, " photos"]
    median_error_px: Float[np.ndarray, " photos"]
    crs: str


def read_sites(path: str | os.PathLike[str]) -> SitesFile:
    """Return the cameras that `write_geopackage` or `write_geojson` wrote.

    Raises:
        JaxbaError: the file cannot be read, has no layer `cameras`, or a column is missing or not known.
    """
    import shapely
    from pyogrio import raw
    from pyogrio.errors import DataLayerError, DataSourceError

    label = os.fspath(path)
    try:
        meta, _, geometry, columns = raw.read(label, layer=LAYER)
    except (DataSourceError, DataLayerError, ValueError) as error:
        raise JaxbaError(f"{label}: its layer {LAYER!r} cannot be read ({error}); export it again.") from error
    fields = [str(field) for field in meta["fields"]]
    missing = [name for name in SITE_COLUMNS if name not in fields]
    unknown = [name for name in fields if name not in SITE_COLUMNS]
    for names, what in ((missing, "is missing"), (unknown, "is not known")):
        if names:
            raise JaxbaError(
                f"{label}: column {', '.join(names)} {what}; expected are {', '.join(SITE_COLUMNS)}. Export it again."
            )
    table = dict(zip(fields, columns, strict=True))
    places = shapely.get_coordinates(shapely.from_wkb(geometry), include_z=True)
    if len(places) != len(table["name"]):
        raise JaxbaError(f"{label}: {len(table['name'])} cameras have {len(places)} places; export it again.")
    return SitesFile(
        name=tuple(map(str, table["name"])),
        xyz=np.asarray(places, float).reshape(-1, 3),
        is_registered=np.asarray(table["registered"]).astype(bool),
        median_error_px=np.asarray(table["median_error_px"], float),
        crs=meta["crs"] or "",
    )
