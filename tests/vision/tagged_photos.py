"""Small photos with hand-made tags."""

import hashlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any
from xml.sax.saxutils import quoteattr

from PIL import ExifTags, Image
from PIL.TiffImagePlugin import IFDRational

from jaxba.scene import Photo, PhotoFile
from jaxba.vision import read_photo

NAMESPACES = {
    "drone-dji": "http://www.dji.com/drone-dji/1.0/",
    "drone": "http://www.autelrobotics.com/drone/1.0/",
    "drone-parrot": "http://www.parrot.com/drone-parrot/1.0/",
    "Camera": "http://pix4d.com/camera/1.0/",
    "sensefly": "http://ns.sensefly.com/Camera/1.0/",
    "tiff": "http://ns.adobe.com/tiff/1.0/",
    "exif": "http://ns.adobe.com/exif/1.0/",
}
NORTH_EAST: dict[int, Any] = {
    ExifTags.GPS.GPSLatitudeRef: "N",
    ExifTags.GPS.GPSLatitude: (IFDRational(47), IFDRational(30), IFDRational(36, 1)),
    ExifTags.GPS.GPSLongitudeRef: "E",
    ExifTags.GPS.GPSLongitude: (IFDRational(8), IFDRational(15), IFDRational(0)),
}
"""47.51 degrees north, 8.25 east."""


def xmp_packet(values: Mapping[str, str]) -> bytes:
    """Return a packet with the values as attributes, as drones write them."""
    spaces = " ".join(f'xmlns:{prefix}="{uri}"' for prefix, uri in NAMESPACES.items())
    words = " ".join(f"{name}={quoteattr(value)}" for name, value in values.items())
    rdf = "http://www.w3.org/1999/02/22-rdf-syntax-ns#"
    return (
        f'<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:RDF xmlns:rdf="{rdf}"><rdf:Description rdf:about="" {spaces} '
        f"{words}/></rdf:RDF></x:xmpmeta>"
    ).encode()


def write_photo(
    path: Path,
    size_px: tuple[int, int] = (400, 300),
    *,
    make: str = "",
    model: str = "",
    base: Mapping[int, Any] | None = None,
    exif: Mapping[int, Any] | None = None,
    gps: Mapping[int, Any] | None = None,
    xmp: Mapping[str, str] | bytes | None = None,
    gray: int = 128,
) -> PhotoFile:
    """Write a plain grey photo with these tags."""
    tags = Image.Exif()
    tags.update({ExifTags.Base.Make: make, ExifTags.Base.Model: model} if make or model else {})
    tags.update(base or {})
    if exif:
        tags.get_ifd(ExifTags.IFD.Exif).update(exif)
    if gps:
        tags.get_ifd(ExifTags.IFD.GPSInfo).update(gps)
    picture = Image.new("RGB", size_px, (gray, gray, gray))
    if xmp is None:
        picture.save(path, exif=tags)
    else:
        picture.save(path, exif=tags, xmp=xmp if isinstance(xmp, bytes) else xmp_packet(xmp))
    return file_of(path)


def file_of(path: Path, name: str | None = None) -> PhotoFile:
    return PhotoFile(name=name or path.name, path=path, sha256=hashlib.sha256(path.read_bytes()).hexdigest())


def tagged(folder: Path, size_px: tuple[int, int] = (400, 300), **tags: Any) -> Photo:
    """Return a photo with these tags, written and read back."""
    return read_photo(write_photo(folder / "photo.jpg", size_px, **tags))
