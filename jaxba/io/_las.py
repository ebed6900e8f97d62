"""Point cloud as LAS 1.4 or LAZ: CRS in the header, colours, millimetres.

LAS stores whole numbers: `coordinate = offset + scale * number`. Scale is 0.001 of the CRS's unit, the offset the whole
number of units nearest to the cloud's middle, so that a coordinate is off by half a scale at most wherever the cloud
lies. The CRS stands in the header as well-known text, compound with its heights where it is. Colours are 16 bits wide:
255 becomes 65535. Errors, track lengths and sigmas (NaN where not known) are extra dimensions. The date in the header
is the day of the flight, or none: the same cloud gives the same bytes.
"""

import datetime
import io
import os

import numpy as np

from jaxba._atomic import write_atomically
from jaxba._errors import JaxbaError
from jaxba.io._cloud import STD_COLUMNS, Cloud
from jaxba.io._crs import CrsText

SCALE = 0.001
_RGB_POINTS = 7  # LAS 1.4 point format with colours, the lowest that knows WKT and colours
_DATE_BYTES = slice(90, 94)  # of the header: day of the year and year, 16 bits each
_MOST = 2**31 - 1


def write_las(path: str | os.PathLike[str], cloud: Cloud, crs: CrsText, *, date: datetime.date | None = None) -> None:
    """Write a cloud, compressed where the name ends in `.laz`, whole or not at all; `date`: the day of the flight.

    Raises:
        JaxbaError: no points, coordinates that are not finite or more than 2147 km of units apart from the middle; or
            the file cannot be written.

    >>> import pathlib, tempfile, laspy
    >>> path = pathlib.Path(tempfile.mkdtemp(), "cloud.laz")
    >>> one = np.ones(1, int)
    >>> cloud = Cloud(xyz=np.array([[565000.001, 5184000.002, 210.003]]), rgb=np.zeros((1, 3), np.uint8),
    ...     point_id=one, track_length=one, error_px=np.array([0.25]), std_m=np.full((1, 3), np.nan))
    >>> crs = CrsText(text="EPSG:32615", name="", unit="metre", height_unit="metre", height_note="")
    >>> write_las(path, cloud, crs)
    >>> laspy.read(path).header.parse_crs().to_epsg()
    32615
    """
    import laspy
    from laspy.vlrs.known import WktCoordinateSystemVlr

    label = os.fspath(path)
    cloud.check(label)
    header = laspy.LasHeader(version="1.4", point_format=_RGB_POINTS)
    header.generating_software = "jaxba"
    header.system_identifier = "jaxba"
    header.creation_date = date or datetime.date.min  # laspy takes today for none
    header.scales = np.full(3, SCALE)
    header.offsets = np.round((cloud.xyz.min(axis=0) + cloud.xyz.max(axis=0)) / 2)
    number = np.round((cloud.xyz - header.offsets) / SCALE)
    far = np.flatnonzero((np.abs(number) > _MOST).any(axis=1))
    if far.size:
        raise JaxbaError(
            f"{label}: not written, point {cloud.point_id[far[0]]} at {cloud.xyz[far[0]].tolist()} lies too far from "
            f"the cloud's middle {header.offsets.tolist()} for millimetres ({far.size} such points); remove outliers."
        )
    header.vlrs.append(WktCoordinateSystemVlr(crs.wkt1()))
    header.global_encoding.wkt = True
    header.add_extra_dims(
        [
            laspy.ExtraBytesParams(name="error_px", type="float32", description="mean reprojection error"),
            laspy.ExtraBytesParams(name="track_length", type="uint16", description="images that show it"),
            laspy.ExtraBytesParams(name="point_id", type="uint32", description="as in the other files"),
            *(
                laspy.ExtraBytesParams(name=name, type="float32", description=f"sigma along local {axis}, metres")
                for name, axis in zip(STD_COLUMNS, ("east", "north", "up"), strict=True)
            ),
        ]
    )
    las = laspy.LasData(header)
    las.X, las.Y, las.Z = number.astype(np.int32).T
    las.red, las.green, las.blue = cloud.rgb.astype(np.uint16).T * 257
    las.return_number = np.ones(cloud.num_points, np.uint8)
    las.number_of_returns = np.ones(cloud.num_points, np.uint8)
    las["error_px"] = cloud.error_px.astype(np.float32)
    las["track_length"] = np.minimum(cloud.track_length, 2**16 - 1).astype(np.uint16)
    las["point_id"] = cloud.point_id.astype(np.uint32)
    for name, column in zip(STD_COLUMNS, cloud.std_m.T, strict=True):
        las[name] = column.astype(np.float32)
    buffer = io.BytesIO()
    las.write(buffer, do_compress=label.lower().endswith(".laz"))
    content = bytearray(buffer.getvalue())
    if date is None:
        content[_DATE_BYTES] = bytes(4)  # what is not used is zero (LAS 1.4 R15, 2)
    with write_atomically(path) as file:
        file.write(content)
