"""What a text means as a CRS: one reading for headers of lists, options and parameters, and the code of what is read.

A PROJ string or WKT that says what an EPSG code says is that code: then it has the code's area of use, and two lists
that write one CRS in two ways agree. PROJ compares datum, projection, its numbers and units; the order of axes does not
count here, since x is always east. A code costs about 0.1 s the first time.
"""

import re
from functools import lru_cache

from pyproj import CRS
from pyproj.exceptions import CRSError

from jaxba._errors import JaxbaError

_UTM = re.compile(r"WGS[ _]*84\s*/?\s*UTM\s*(?:zone\s*)?(\d{1,2})\s*([NS])", re.IGNORECASE)
_INIT = re.compile(r"\+?init=(\w+):(\w+)", re.IGNORECASE)
_IDLE = re.compile(r"\+(no_defs|wktext|type=crs)\b", re.IGNORECASE)
_NO_DATUM = ("unknown", "not specified", "not_specified", "undefined", "unspecified")
_LIKELY = 70
"""PROJ's confidence, in percent, that a code has the same projection and ellipsoid, whatever names and datum are."""


def crs_of_text(text: str, before: str, no_crs: str) -> CRS:
    """Return the CRS that a text means: a code such as `EPSG:32615` or `32615`, `WGS84 UTM 15N`, WKT, a PROJ string.

    - `before`: what stands before the text in messages, such as `geo.txt line 1: ` or `crs.target_crs=`.
    - `no_crs`: the rest of the message for a text that is no CRS: that it is none, and what to give.

    Raises `JaxbaError` for what is no CRS, and for what names an ellipsoid and no datum.

    >>> crs_of_text("+init=epsg:32615", "geo.txt line 1: ", "").name
    'WGS 84 / UTM zone 15N'
    """
    named = f"{before}{shown(text)!r}"
    try:
        crs = CRS.from_user_input(_in_todays_words(text.strip(), named))
    except CRSError:
        raise JaxbaError(f"{named} {no_crs}") from None
    _refuse_without_datum(crs, named)
    return crs


@lru_cache(maxsize=256)
def authority_code(crs: CRS) -> str | None:
    """Return `EPSG:32615`, or `EPSG:32615+5773` of a compound CRS; None where no code says the same.

    >>> authority_code(CRS("+proj=utm +zone=15 +datum=WGS84"))
    'EPSG:32615'
    """
    if crs.is_bound:  # its own transformation is no part of any code
        return None
    if authority := crs.to_authority(min_confidence=100):
        return ":".join(authority)
    if crs.is_compound:
        parts = [authority_code(part) for part in crs.sub_crs_list]
        if all(part is not None and part.startswith("EPSG:") for part in parts):
            return "EPSG:" + "+".join(part.removeprefix("EPSG:") for part in parts if part)
        return None
    return next((code for code in _likely(crs) if CRS(code).equals(crs, ignore_axis_order=True)), None)


def shown(text: str, longest: int = 120) -> str:
    """Return a text of a length that a message can repeat, in characters."""
    return text if len(text) <= longest else text[: longest - 3] + "..."


def horizontal_part(crs: CRS) -> CRS:
    """Return the CRS of x and y alone."""
    return crs.sub_crs_list[0].to_2d() if crs.is_compound else crs.to_2d()


def unbound(crs: CRS) -> CRS:
    """Return the CRS of x and y without a transformation that is tied to it (`+towgs84`, BOUNDCRS)."""
    flat = horizontal_part(crs)
    return flat.source_crs if flat.is_bound and flat.source_crs is not None else flat


def likely_codes(crs: CRS) -> tuple[str, ...]:
    """Return EPSG's codes with the same projection and ellipsoid, whatever the datum, the widest first."""
    return _likely(unbound(crs))


def utm_code(crs: CRS) -> str | None:
    """Return the code on WGS 84 of the UTM zone that a CRS has, on whatever ellipsoid, in whatever unit."""
    zone = unbound(crs).utm_zone
    return f"EPSG:{(32600 if zone.endswith('N') else 32700) + int(zone[:-1])}" if zone else None


def _in_todays_words(text: str, named: str) -> str:
    """Return a text in which a code is written as PROJ writes it today; it warns of `+init=`."""
    if utm := _UTM.fullmatch(text):
        zone = int(utm[1])
        if not 1 <= zone <= 60:
            raise JaxbaError(f"{named}: UTM zone {zone} does not exist; give one from 1 to 60.")
        return f"EPSG:{(32600 if utm[2].upper() == 'N' else 32700) + zone}"
    if init := _INIT.search(text):
        code = f"{init[1].upper()}:{init[2].upper()}"
        if _IDLE.sub("", _INIT.sub("", text, count=1)).strip():
            raise JaxbaError(
                f"{named}: '{init[0]}' is a code in PROJ's old notation, here with further words; "
                f"write {code} if it is what is meant, or a PROJ string without init."
            )
        return code
    if re.fullmatch(r"[A-Za-z]+:[\w+]+", text):
        return text.upper()
    return f"EPSG:{text}" if text.isdigit() else text


def _refuse_without_datum(crs: CRS, named: str) -> None:
    """Raise where x and y are tied to an ellipsoid alone: its place against WGS 84 is known to some 100 m only."""
    flat = horizontal_part(crs)
    if flat.is_bound or not _lacks_datum(flat):
        return
    codes = ["EPSG:4326" if flat.is_geographic else utm_code(flat), *_likely(flat)]
    codes = [code for code in codes if code and not _lacks_datum(CRS(code))]
    such = ", ".join(f"{code} ({CRS(code).name})" for code in list(dict.fromkeys(codes))[:3])
    raise JaxbaError(
        f"{named} names an ellipsoid and no datum, so where it lies on earth is not known; write the code of the CRS"
        f"{f', such as {such}' if such else ''}, or add the datum to a PROJ string: +datum=WGS84, +datum=NAD83, or "
        "+towgs84= with its numbers."
    )


def _lacks_datum(crs: CRS) -> bool:
    geodetic = crs.geodetic_crs
    if geodetic is None or geodetic.is_bound or geodetic.datum is None:
        return False
    return geodetic.datum.name.lower().startswith(_NO_DATUM)


@lru_cache(maxsize=256)
def _likely(crs: CRS) -> tuple[str, ...]:
    codes = [f"EPSG:{entry.code}" for entry in crs.list_authority(auth_name="EPSG", min_confidence=_LIKELY)]
    return tuple(sorted(codes, key=_extent_deg2, reverse=True))


def _extent_deg2(code: str) -> float:
    """Return how wide an area a code is for: of several, that of a continent is likelier meant than a country's."""
    area = CRS(code).area_of_use
    if area is None:
        return 0.0
    return ((area.east - area.west) % 360) * (area.north - area.south)
