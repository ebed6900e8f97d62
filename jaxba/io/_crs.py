"""A CRS as files name it: by code and by well-known text."""

from dataclasses import dataclass


@dataclass(frozen=True, kw_only=True)
class CrsText:
    """A CRS in words, for headers and sidecars.

    - `text`: an authority code such as `EPSG:32615` or `EPSG:32615+5773`, or WKT where there is none.
    - `name`, `unit`, `height_unit`: for people. `height_note`: what heights are above, in one sentence.
    """

    text: str
    name: str
    unit: str
    height_unit: str
    height_note: str

    @property
    def code(self) -> str:
        """What stands behind `EPSG:`, such as `32615` or `32615+5773`; empty for a CRS without a code."""
        return self.text.removeprefix("EPSG:") if self.text.startswith("EPSG:") else ""

    @property
    def epsg(self) -> int | None:
        """The one code of the CRS; None for a compound of two codes, and where there is none."""
        return int(self.code) if self.code.isdigit() else None

    def wkt(self) -> str:
        """Return well-known text (ISO 19162, WKT 2)."""
        from pyproj import CRS

        return CRS(self.text).to_wkt()

    def wkt1(self) -> str:
        """Return well-known text of OGC 01-009 (WKT 1), which LAS 1.4 asks for; WKT 2 where WKT 1 has no words."""
        from pyproj import CRS
        from pyproj.enums import WktVersion
        from pyproj.exceptions import CRSError

        crs = CRS(self.text)
        try:
            return crs.to_wkt(WktVersion.WKT1_GDAL)
        except CRSError:
            return crs.to_wkt()
