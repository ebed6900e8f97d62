"""XMP: the XML packet in which drones keep attitude, relative altitude, RTK and calibration.

Makers choose prefixes freely, so names are told by their namespace: `drone-dji:`, `Camera:` (Pix4D and senseFly, whose
tags have one meaning), `drone-parrot:`. A namespace that is not known keeps the prefix that the packet gives it; Autel
writes DJI's names under `drone:`. Only simple values and lists are read, not structures within structures.
"""

import io
import re
import xml.etree.ElementTree as Xml

_RDF = "{http://www.w3.org/1999/02/22-rdf-syntax-ns#}"
_PREFIX_OF = {
    "http://www.dji.com/drone-dji/1.0/": "drone-dji",
    "http://pix4d.com/camera/1.0/": "Camera",
    "http://pix4d.com/camera/1.0": "Camera",
    "http://ns.sensefly.com/Camera/1.0/": "Camera",
    "http://www.parrot.com/drone-parrot/1.0/": "drone-parrot",
    "http://ns.adobe.com/tiff/1.0/": "tiff",
    "http://ns.adobe.com/exif/1.0/": "exif",
    "http://ns.adobe.com/exif/1.0/aux/": "aux",
    "http://ns.adobe.com/xap/1.0/": "xmp",
}
_ATTRIBUTE = re.compile(r"""([\w-]+:\w+)\s*=\s*["']([^"'<>]*)["']""")
_ELEMENT = re.compile(r"<([\w-]+:\w+)>([^<>]*)</\1\s*>")


class BrokenXmp(ValueError):
    """A packet that is no well-formed XML, with what plain text search found in it."""

    def __init__(self, cause: str, found: dict[str, str]) -> None:
        super().__init__(cause)
        self.found = found


def parse_xmp(packet: bytes) -> dict[str, str]:
    """Return the values of an XMP packet by prefixed name; lists are joined by commas.

    Entities, by which XML can blow up memory or read other files, are refused. Raises `BrokenXmp` for what is no XML.

    >>> parse_xmp(b'<r xmlns:d="http://www.dji.com/drone-dji/1.0/"><d:RtkFlag>50</d:RtkFlag></r>')
    {'drone-dji:RtkFlag': '50'}
    """
    from defusedxml import DefusedXmlException
    from defusedxml.ElementTree import iterparse

    packet = packet.strip(b"\x00 \r\n\t")
    prefixes: dict[str, str] = {}
    found: dict[str, str] = {}
    try:
        for event, item in iterparse(io.BytesIO(packet), events=("start-ns", "start", "end")):
            if event == "start-ns":
                prefixes.setdefault(item[1], item[0])
            elif event == "start":
                for key, value in item.attrib.items():
                    _keep(found, prefixes, key, value)
            else:
                text = _text(item)
                if text is not None:
                    _keep(found, prefixes, item.tag, text)
    except (Xml.ParseError, DefusedXmlException, UnicodeDecodeError, LookupError) as error:
        text = packet.decode("utf-8", "replace")
        pairs = [*_ATTRIBUTE.findall(text), *_ELEMENT.findall(text)]
        raise BrokenXmp(str(error) or type(error).__name__, dict(reversed(pairs))) from error
    return found


def _keep(found: dict[str, str], prefixes: dict[str, str], key: str, value: str) -> None:
    """Add a value under its prefixed name; the first of two stays, and RDF's own names are passed over."""
    uri, _, name = key.rpartition("}")
    if not uri or key.startswith(_RDF) or uri.endswith("XML/1998/namespace") or not value.strip():
        return
    uri = uri[1:]
    found.setdefault(f"{_PREFIX_OF.get(uri, prefixes.get(uri, ''))}:{name}", value.strip())


def _text(element: Xml.Element) -> str | None:
    """Return the text of a simple element, or of a list's entries; None for a structure."""
    children = list(element)
    if not children:
        return element.text
    if len(children) == 1 and children[0].tag in (f"{_RDF}Seq", f"{_RDF}Bag", f"{_RDF}Alt"):
        entries = [entry.text or "" for entry in children[0]]
        return ",".join(entry.strip() for entry in entries) if not any(len(entry) for entry in children[0]) else None
    return None
