"""A CRS without a code is judged by place as one with a code: PROJ strings, WKT, bound CRSs, in any unit."""

import re

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from pyproj import CRS

from jaxba._errors import JaxbaError
from jaxba.geo import describe, parse_crs, surveyed_points, target_crs, utm_zone


def without_codes(wkt: str) -> str:
    """Return WKT without identifiers and areas of use."""
    wkt = re.sub(r',\s*(ID|AUTHORITY)\["EPSG","?\d+"?\]', "", wkt)
    return re.sub(r",\s*USAGE\[.*?BBOX\[[^\]]*\]\]", "", wkt, flags=re.S)


def forms(zone: int, side: str) -> dict[str, str]:
    """Return a WGS 84 / UTM zone in every way that names no code."""
    south, code = " +south" if side == "S" else "", (32600 if side == "N" else 32700) + zone
    crs, name = CRS.from_epsg(code), f"WGS 84 / UTM zone {zone}{side}"
    proj = f"+proj=utm +zone={zone}{south}"
    return {
        "PROJ": f"{proj} +datum=WGS84 +units=m +no_defs",
        "PROJ, zone alone": proj,
        "PROJ, as a transverse Mercator": (
            f"+proj=tmerc +lat_0=0 +lon_0={6 * zone - 183} +k=0.9996 +x_0=500000 +y_0={1e7 * (side == 'S'):g} "
            "+datum=WGS84"
        ),
        "PROJ, feet": f"{proj} +datum=WGS84 +units=us-ft",
        "PROJ, bound": f"{proj} +ellps=WGS84 +towgs84=0,0,0 +units=m +no_defs",
        "PROJ, bound, feet": f"{proj} +ellps=GRS80 +towgs84=0,0,0 +units=ft",
        "PROJ, other ellipsoid": f"{proj} +ellps=intl +towgs84=-87,-98,-121 +units=m",
        "init": f"+init=epsg:{code}",
        "WKT 1": without_codes(crs.to_wkt("WKT1_GDAL")),
        "WKT 1 of another name": without_codes(crs.to_wkt("WKT1_GDAL")).replace(name, "site"),
        "WKT 1 of ESRI": crs.to_wkt("WKT1_ESRI"),
        "WKT 2": without_codes(crs.to_wkt()),
        "WKT 2 of another name": without_codes(crs.to_wkt()).replace(name, "site"),
        "WKT 2, bound": CRS(f"{proj} +ellps=GRS80 +towgs84=0,0,0,0,0,0,0").to_wkt(),
        "WKT 2, with heights": without_codes(CRS(f"EPSG:{code}+5773").to_wkt()),
    }


@settings(max_examples=40)
@given(
    st.integers(1, 60),
    st.sampled_from("NS"),
    st.sampled_from(list(forms(1, "N"))),
    st.floats(0.05, 5.95),
    st.floats(1.0, 79.0),
    st.sampled_from(["right", "zone before", "zone after", "other side"]),
)
def test_a_zone_without_a_code_holds_its_own_places_alone(zone, side, form, into_zone, latitude, given_as):
    lon, lat = np.array([6 * zone - 186 + into_zone]), np.array([latitude if side == "N" else -latitude])
    other = {
        "right": (zone, side), "zone before": ((zone - 2) % 60 + 1, side), "zone after": (zone % 60 + 1, side),
        "other side": (zone, "S" if side == "N" else "N"),
    }[given_as]  # fmt: skip
    text = forms(*other)[form]
    if given_as == "right":
        assert target_crs(text, lon, lat).is_projected
        return
    with pytest.raises(JaxbaError) as error:
        target_crs(text, lon, lat)
    assert "does not contain the survey" in str(error.value)
    assert f"{describe(utm_zone(*lon, *lat))} fits the survey" in str(error.value)


@pytest.mark.parametrize("form", forms(1, "N"))
def test_what_a_code_says_is_that_code_and_what_it_nearly_says_is_named_after_it(form: str):
    said = describe(parse_crs(forms(33, "N")[form]))
    if "bound" in form or "feet" in form or "ellipsoid" in form:
        assert "a CRS without a name, projected as EPSG:" in said and "UTM zone 33N" in said
    else:
        assert said.startswith("EPSG:32633")


@pytest.mark.parametrize(
    ("text", "inside", "outside"),
    [
        # state planes, Gauss-Krueger zones and national grids, as PROJ strings
        (CRS("EPSG:26851").srs.replace("EPSG:26851", "+proj=lcc +lat_0=43 +lon_0=-94 +lat_1=45.2166666666667 "
         "+lat_2=43.7833333333333 +x_0=800000 +y_0=100000 +datum=NAD83 +units=m"), (-94.0, 44.5), (-94.0, 47.0)),
        ("+proj=tmerc +lat_0=0 +lon_0=9 +k=1 +x_0=3500000 +ellps=bessel +towgs84=598.1,73.7,418.2,0.202,0.045,-2.455,"
         "6.7 +units=m", (9.0, 50.0), (12.0, 50.0)),
        ("+proj=tmerc +lat_0=49 +lon_0=-2 +k=0.9996012717 +x_0=400000 +y_0=-100000 +ellps=airy +towgs84=446,-125,542,"
         "0.15,0.247,0.842,-20", (-5.0, 52.0), (8.5, 47.4)),
        # SWEREF 99 TM: the numbers of zone 33, and all of Sweden
        ("+proj=utm +zone=33 +ellps=GRS80 +towgs84=0,0,0,0,0,0,0 +units=m +no_defs", (20.0, 65.0), (8.5, 47.4)),
        # no code at all: by the central meridian, or the scale
        ("+proj=tmerc +lat_0=0 +lon_0=10 +k=1 +x_0=1000000 +datum=WGS84", (11.0, 50.0), (14.0, 50.0)),
        ("+proj=lcc +lat_1=45 +lat_2=46 +lat_0=45 +lon_0=-93 +datum=WGS84", (-94.0, 45.0), (8.0, 45.0)),
        ("+proj=stere +lat_0=45 +lon_0=10 +datum=WGS84", (11.0, 46.0), (60.0, 46.0)),
    ],
)  # fmt: skip
def test_other_projections_are_judged_by_their_codes_or_by_themselves(text: str, inside, outside):
    assert target_crs(text, *np.array(inside)[:, None]).is_projected
    with pytest.raises(JaxbaError, match="does not contain the survey"):
        target_crs(text, *np.array(outside)[:, None])


def test_control_in_a_crs_without_a_code_is_judged_alike():
    xyz = np.array([[484201.6, 4971854.0, 248.0]])
    for text in ("+proj=utm +zone=15 +south +datum=WGS84", "+proj=utm +zone=15 +south +ellps=WGS84 +towgs84=0,0,0"):
        assert surveyed_points([text], xyz, name="gcp.txt").latitude_deg[0] == pytest.approx(-45.4, abs=0.1)
    degrees = np.array([[-93.2, 44.9, 248.0]])
    for text in forms(15, "N").values():
        with pytest.raises(JaxbaError, match=r"gcp.txt: .*does not contain the survey"):
            surveyed_points([text], degrees, name="gcp.txt")
