"""A JPEG with the tags that a drone writes: EXIF, and an XMP packet in DJI's words.

Numbers in EXIF are ratios of whole numbers. Latitude and longitude are degrees, minutes and millionths of a second
(0.03 mm), heights tenths of a millimetre. The same picture and tags give the same bytes.
"""

import io
import xml.sax.saxutils
from dataclasses import dataclass
from fractions import Fraction

import numpy as np
from jaxtyping import UInt8
from PIL import ExifTags, Image
from PIL.TiffImagePlugin import IFDRational

from jaxba.scene import Attitude

_SECOND_PARTS, _METRE_PARTS = 1_000_000, 10_000
_CENTIMETRES = 3  # EXIF's code of the focal plane's unit
_XMP = """<?xpacket begin="\ufeff" id="W5M0MpCehiHzreSzNTczkc9d"?>
<x:xmpmeta xmlns:x="adobe:ns:meta/">
 <rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#">
  <rdf:Description rdf:about=""
    xmlns:tiff="http://ns.adobe.com/tiff/1.0/"
    xmlns:drone-dji="http://www.dji.com/drone-dji/1.0/"
{attributes}/>
 </rdf:RDF>
</x:xmpmeta>
<?xpacket end="w"?>"""


@dataclass(frozen=True, kw_only=True)
class PhotoTags:
    """What is written beside the picture.

    - `make`, `model`: of the camera. `time`: `2024:06:01 10:00:00`.
    - `focal_mm`, `sensor_width_mm`, `focal_35mm`: focal length, width that the image's columns span, and equivalent.
    - `latitude_deg`, `longitude_deg`, `altitude_m`: WGS 84; the height goes where photos keep theirs.
    - `relative_altitude_m`: above take-off. `gimbal`, `flight`: attitudes of camera and aircraft.
    - `std_h_m`, `std_v_m`: of the position. `is_rtk`: from a fixed RTK solution, which states them as DJI does.
    """

    make: str
    model: str
    time: str
    focal_mm: float
    focal_35mm: int
    sensor_width_mm: float
    latitude_deg: float
    longitude_deg: float
    altitude_m: float
    relative_altitude_m: float
    gimbal: Attitude
    flight: Attitude
    std_h_m: float
    std_v_m: float
    is_rtk: bool


def jpeg_with_tags(picture: UInt8[np.ndarray, "height width 3"], tags: PhotoTags, *, quality: int = 92) -> bytes:
    """Return a JPEG file of a picture (blue, green, red) with EXIF and XMP.

    >>> level = Attitude(yaw_deg=0.0, pitch_deg=0.0, roll_deg=0.0)
    >>> tags = PhotoTags(
    ...     make="jaxba", model="simulated", time="2024:06:01 10:00:00", focal_mm=11.06, focal_35mm=29,
    ...     sensor_width_mm=13.2, latitude_deg=44.9, longitude_deg=-93.2, altitude_m=310.0, relative_altitude_m=70.0,
    ...     gimbal=level, flight=level, std_h_m=0.03, std_v_m=0.05, is_rtk=True,
    ... )
    >>> jpeg_with_tags(np.zeros((6, 8, 3), np.uint8), tags)[:2].hex()
    'ffd8'
    """
    height, width = picture.shape[:2]
    file = io.BytesIO()
    Image.fromarray(np.ascontiguousarray(picture[..., ::-1])).save(
        file, "JPEG", quality=quality, exif=_exif(tags, width, height), xmp=_xmp(tags).encode()
    )
    return file.getvalue()


def _exif(tags: PhotoTags, width_px: int, height_px: int) -> Image.Exif:
    exif = Image.Exif()
    base, ifd, gps = ExifTags.Base, ExifTags.IFD, ExifTags.GPS
    exif[base.Make], exif[base.Model] = tags.make, tags.model
    exif[base.Orientation] = 1
    exif[base.Software] = "jaxba"
    exif[base.DateTime] = tags.time
    pixels_per_cm = Fraction(width_px * 10) / Fraction(str(tags.sensor_width_mm))
    exif.get_ifd(ifd.Exif).update(
        {
            base.ExifVersion: b"0232",
            base.DateTimeOriginal: tags.time,
            base.DateTimeDigitized: tags.time,
            base.FocalLength: _ratio(tags.focal_mm, 1000),
            base.FocalLengthIn35mmFilm: tags.focal_35mm,
            base.FocalPlaneXResolution: IFDRational(pixels_per_cm.numerator, pixels_per_cm.denominator),
            base.FocalPlaneYResolution: IFDRational(pixels_per_cm.numerator, pixels_per_cm.denominator),
            base.FocalPlaneResolutionUnit: _CENTIMETRES,
            base.ExifImageWidth: width_px,
            base.ExifImageHeight: height_px,
        }
    )
    exif.get_ifd(ifd.GPSInfo).update(
        {
            gps.GPSVersionID: bytes([2, 3, 0, 0]),
            gps.GPSLatitudeRef: "N" if tags.latitude_deg >= 0 else "S",
            gps.GPSLatitude: _sexagesimal(tags.latitude_deg),
            gps.GPSLongitudeRef: "E" if tags.longitude_deg >= 0 else "W",
            gps.GPSLongitude: _sexagesimal(tags.longitude_deg),
            gps.GPSAltitudeRef: bytes([0 if tags.altitude_m >= 0 else 1]),
            gps.GPSAltitude: _ratio(abs(tags.altitude_m), _METRE_PARTS),
            gps.GPSMapDatum: "WGS-84",
            gps.GPSHPositioningError: _ratio(tags.std_h_m, _METRE_PARTS),
        }
    )
    return exif


def _xmp(tags: PhotoTags) -> str:
    values = {
        "tiff:Make": tags.make,
        "tiff:Model": tags.model,
        "drone-dji:GpsStatus": "RTK" if tags.is_rtk else "GPS",
        "drone-dji:AltitudeType": "RtkAlt" if tags.is_rtk else "GpsFusionAlt",
        "drone-dji:GpsLatitude": f"{tags.latitude_deg:+.10f}",
        "drone-dji:GpsLongitude": f"{tags.longitude_deg:+.10f}",
        "drone-dji:AbsoluteAltitude": f"{tags.altitude_m:+.4f}",
        "drone-dji:RelativeAltitude": f"{tags.relative_altitude_m:+.3f}",
        "drone-dji:GimbalRollDegree": f"{tags.gimbal.roll_deg:+.2f}",
        "drone-dji:GimbalYawDegree": f"{tags.gimbal.yaw_deg:+.2f}",
        "drone-dji:GimbalPitchDegree": f"{tags.gimbal.pitch_deg:+.2f}",
        "drone-dji:FlightRollDegree": f"{tags.flight.roll_deg:+.2f}",
        "drone-dji:FlightYawDegree": f"{tags.flight.yaw_deg:+.2f}",
        "drone-dji:FlightPitchDegree": f"{tags.flight.pitch_deg:+.2f}",
    }
    if tags.is_rtk:
        values |= {
            "drone-dji:RtkFlag": "50",
            "drone-dji:RtkStdLon": f"{tags.std_h_m:.5f}",
            "drone-dji:RtkStdLat": f"{tags.std_h_m:.5f}",
            "drone-dji:RtkStdHgt": f"{tags.std_v_m:.5f}",
        }
    lines = [f"   {name}={xml.sax.saxutils.quoteattr(value)}" for name, value in values.items()]
    return _XMP.format(attributes="\n".join(lines))


def _sexagesimal(angle_deg: float) -> tuple[IFDRational, IFDRational, IFDRational]:
    parts = round(abs(angle_deg) * 3600 * _SECOND_PARTS)
    minutes, parts = divmod(parts, 60 * _SECOND_PARTS)
    return IFDRational(minutes // 60, 1), IFDRational(minutes % 60, 1), IFDRational(parts, _SECOND_PARTS)


def _ratio(value: float, parts: int) -> IFDRational:
    return IFDRational(round(value * parts), parts)
