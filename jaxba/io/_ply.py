"""Point cloud as binary PLY (little-endian): coordinates in full doubles, colours, errors, sigmas (NaN: not known).

Coordinates are those of the target CRS, not shifted. Programs that read them as float32 round a northing of some
5,000,000 m to half a metre: load with a global shift (CloudCompare proposes one), or take the LAZ file, which has an
offset of its own. Comments in the header name the CRS.
"""

import os

import numpy as np

from jaxba._atomic import write_atomically
from jaxba.io._cloud import STD_COLUMNS, Cloud
from jaxba.io._crs import CrsText

VERTEX = np.dtype(
    [(name, "<f8") for name in "xyz"]
    + [(name, "u1") for name in ("red", "green", "blue")]
    + [("error_px", "<f4"), ("track_length", "<i4"), ("point_id", "<i4")]
    + [(name, "<f4") for name in STD_COLUMNS]
)
PLY_TYPES = {"<f8": "double", "|u1": "uchar", "<f4": "float", "<i4": "int"}


def write_ply(path: str | os.PathLike[str], cloud: Cloud, crs: CrsText | None) -> None:
    """Write a cloud as binary PLY, whole or not at all; `crs` None: local coordinates.

    Raises:
        JaxbaError: no points, coordinates that are not finite; or the file cannot be written.

    >>> import pathlib, tempfile
    >>> path = pathlib.Path(tempfile.mkdtemp(), "cloud.ply")
    >>> one = np.ones(1, int)
    >>> cloud = Cloud(xyz=np.array([[1.0, 2, 3]]), rgb=np.zeros((1, 3), np.uint8), point_id=one, track_length=one,
    ...     error_px=np.array([0.25]), std_m=np.full((1, 3), np.nan))
    >>> write_ply(path, cloud, None)
    >>> path.read_bytes()[:36]
    b'ply\\nformat binary_little_endian 1.0\\n'
    """
    cloud.check(os.fspath(path))
    vertices = np.empty(cloud.num_points, VERTEX)
    for name, column in zip("xyz", cloud.xyz.T, strict=True):
        vertices[name] = column
    for name, column in zip(("red", "green", "blue"), cloud.rgb.T, strict=True):
        vertices[name] = column
    for name in ("error_px", "track_length", "point_id"):
        vertices[name] = getattr(cloud, name)
    for name, column in zip(STD_COLUMNS, cloud.std_m.T, strict=True):
        vertices[name] = column
    place = "local coordinates without a place on earth"
    if crs is not None:
        code = f"EPSG:{crs.code} " if crs.code else ""
        place = f"{code}{crs.name}; unit {crs.unit}, of heights {crs.height_unit}"
    header = [
        "ply",
        "format binary_little_endian 1.0",
        f"comment crs {' '.join(place.split())}".encode("ascii", "replace").decode(),
        f"element vertex {cloud.num_points}",
        *(f"property {PLY_TYPES[VERTEX[name].str]} {name}" for name in VERTEX.names or ()),
        "end_header",
    ]
    with write_atomically(path) as file:
        file.write("".join(f"{line}\n" for line in header).encode("ascii"))
        file.write(vertices.tobytes())
