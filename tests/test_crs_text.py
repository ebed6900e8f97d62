"""What a text means as a CRS: codes, PROJ's old notation, and what names no datum."""

import warnings

import pytest

from jaxba._crs_text import authority_code, crs_of_text
from jaxba._errors import JaxbaError
from jaxba.geo import parse_crs
from jaxba.io import parse_control, parse_geotags

NO_DATUM = {
    "+proj=utm +zone=15 +ellps=GRS80 +units=m +no_defs": "EPSG:32615 (WGS 84 / UTM zone 15N), EPSG:26915 (NAD83 / UTM",
    "+proj=utm +zone=15 +ellps=WGS84": "EPSG:32615 (WGS 84 / UTM zone 15N)",
    "+proj=utm +zone=33 +south +ellps=intl": "EPSG:32733 (WGS 84 / UTM zone 33S)",
    "+proj=tmerc +lat_0=0 +lon_0=9 +k=1 +x_0=3500000 +ellps=bessel": "EPSG:5677 (DHDN / 3-degree Gauss-Kruger zone 3",
    "+proj=utm +zone=15 +a=6378137 +rf=298.257222101": "EPSG:32615",
    "+proj=longlat +ellps=WGS84": "EPSG:4326 (WGS 84)",
    "+proj=longlat +R=6371000": "EPSG:4326 (WGS 84)",
    "+proj=lcc +lat_1=45 +lat_2=47 +lat_0=46 +lon_0=-93 +ellps=clrk66": "write the code of the CRS, or add the datum",
    "EPSG:4019": "EPSG:4326 (WGS 84)",
    'GEOGCS["x",DATUM["unknown",SPHEROID["GRS 1980",6378137,298.257222101]],PRIMEM["Greenwich",0],'
    'UNIT["degree",0.0174532925199433]]': "EPSG:4326 (WGS 84)",
}


@pytest.mark.parametrize("text", NO_DATUM)
def test_an_ellipsoid_without_a_datum_is_refused_with_what_to_write(text: str):
    for read, where in (
        (lambda: parse_crs(text, "crs.target_crs"), "crs.target_crs='"),
        (lambda: parse_geotags(f"# a comment\n{text}\na.jpg 1 2"), "geo.txt line 2: '"),
        (lambda: parse_control(f"{text}\n1 2 3 4 5 a.jpg"), "gcp_list.txt line 1: '"),
    ):
        with pytest.raises(JaxbaError) as error:
            read()
        said = str(error.value)
        assert said.startswith(where + text[:40]) and "names an ellipsoid and no datum" in said
        assert NO_DATUM[text] in said and "+datum=WGS84" in said


@pytest.mark.parametrize(
    ("text", "code"),
    [
        ("+init=epsg:32615", "EPSG:32615"),
        ("init=EPSG:32615", "EPSG:32615"),
        ("+init=epsg:32615 +no_defs +type=crs", "EPSG:32615"),
        ("+init=epsg:4326", "EPSG:4326"),
        ("+init=IGNF:LAMB93", "IGNF:LAMB93"),
        ("epsg:32615+5773", "EPSG:32615+5773"),
        (" 32615 ", "EPSG:32615"),
        ("WGS84 UTM 15N", "EPSG:32615"),
        ("wgs 84 / utm zone 15s", "EPSG:32715"),
        ("+proj=longlat +datum=WGS84 +no_defs", "EPSG:4326"),
        ("+proj=longlat +datum=NAD83", "EPSG:4269"),
        ("+proj=utm +zone=15 +datum=NAD27", "EPSG:26715"),
        ("+proj=utm +zone=15 +datum=WGS84 +units=us-ft", None),
        ("+proj=utm +zone=15 +ellps=GRS80 +towgs84=0,0,0", None),
    ],
)
def test_every_notation_of_a_code_is_that_code_without_a_warning(text: str, code: str | None):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert authority_code(crs_of_text(text, "CRS=", "")) == code
        if code is not None:
            xy = "-93 45" if code == "EPSG:4326" or code == "EPSG:4269" else "484201 4971853"
            assert parse_geotags(f"{text}\na.jpg {xy}").entries[0].position.crs == code
            assert parse_control(f"{text}\n{xy} 3 4 5 a.jpg").points[0].crs == code
            assert parse_geotags(f"# {text}\nname,x,y\na.jpg,{xy.replace(' ', ',')}").entries[0].position.crs == code


@pytest.mark.parametrize("text", ["+init=epsg:32615 +units=us-ft", "+proj=utm +zone=15 +init=epsg:32615"])
def test_a_code_in_the_old_notation_with_further_words_is_refused(text: str):
    with pytest.raises(JaxbaError, match=r"old notation, here with further words; write EPSG:32615"):
        parse_crs(text, "crs.target_crs")


def test_a_utm_zone_that_does_not_exist_is_refused():
    with pytest.raises(JaxbaError, match=r"CRS='WGS84 UTM 61N': UTM zone 61 does not exist; give one from 1 to 60"):
        parse_crs("WGS84 UTM 61N")
