"""Which CRS holds a survey, which does not, and what the message says."""

import numpy as np
import pytest
from hypothesis import given, strategies as st
from pyproj import CRS

from jaxba._errors import JaxbaError
from jaxba.geo import parse_crs, target_crs, utm_zone

MINNESOTA = np.array([-92.0, -91.99, -91.98]), np.array([46.80, 46.81, 46.82])


@pytest.mark.parametrize(
    ("longitude", "latitude", "code"),
    [
        (-92.0, 46.8, 32615),
        (-83.3, 41.0, 32617),
        (151.2, -33.9, 32756),
        (-180.0, 10.0, 32601),
        (179.99, 10.0, 32660),
        (180.0, 10.0, 32601),
        (0.0, 0.0, 32631),
        (15.0, 85.0, 5041),
        (15.0, -85.0, 5042),
    ],
)
def test_proposed_zone_is_the_utm_zone_of_the_middle(longitude: float, latitude: float, code: int):
    assert target_crs(None, np.array([longitude] * 3), np.array([latitude] * 3)).to_epsg() == code


@given(st.floats(-179.9, 179.9), st.floats(-79.9, 83.9))
def test_proposed_zone_contains_every_place_by_its_own_area_of_use(longitude: float, latitude: float):
    proposed = utm_zone(longitude, latitude)
    assert target_crs(proposed.to_string(), np.array([longitude]), np.array([latitude])) == proposed


def test_the_middle_of_a_survey_across_the_180th_meridian_is_not_greenwich():
    assert target_crs(None, np.array([179.99, 179.998, -179.999]), np.full(3, -17.0)).to_epsg() == 32760


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("EPSG:4326", "is geographic: its axes are degrees"),
        ("EPSG:4979", "is geographic"),
        ("EPSG:4326+5773", "is geographic"),
        ("EPSG:4978", "is geocentric"),
        ("EPSG:5773", "is not projected, but vertical crs"),
        ("EPSG:32633", "does not contain the survey: it is for longitude 12 to 18, latitude 0 to 84"),
        ("EPSG:32633+5773", "does not contain the survey"),
        ("EPSG:32715", "does not contain the survey"),  # the right zone of the wrong hemisphere
        ("EPSG:26993", "does not contain the survey"),  # Minnesota South, which ends at 45.6 degrees north
        ("EPSG:2193", "does not contain the survey"),  # New Zealand
        ("EPSG:2225", "does not contain the survey"),  # California, US feet
        ("+proj=utm +zone=33 +datum=WGS84", "does not contain the survey"),  # states no area of use
        ("+proj=utm +zone=15 +datum=WGS84 +to_meter=0.7", "an unknown unit (unknown, 0.7 m)"),
        ("EPSG:2053", "axes that point west and south"),
    ],
)
def test_a_crs_that_does_not_fit_is_refused_with_the_zone_that_does(text: str, words: str):
    with pytest.raises(JaxbaError, match=r"EPSG:32615 \(WGS 84 / UTM zone 15N\) fits the survey") as error:
        target_crs(text, *MINNESOTA)
    assert words in str(error.value)
    assert f"crs.target_crs={text}" in str(error.value)


@pytest.mark.parametrize("text", ["", "EPSG:999999", "UTM", "32615 N"])
def test_what_is_no_crs_is_refused(text: str):
    with pytest.raises(JaxbaError, match="is no CRS that PROJ knows; give an EPSG code"):
        target_crs(text, *MINNESOTA)


@pytest.mark.parametrize(
    "text",
    [
        "EPSG:32615",
        "epsg:32615",
        "32615",
        "WGS84 UTM 15N",
        "EPSG:26915",
        "EPSG:26991",  # NAD83 / Minnesota North
        "EPSG:32615+5773",
        "EPSG:26849",  # NAD83 / Minnesota North (ftUS)
        "+proj=utm +zone=15 +datum=WGS84",
        "+proj=utm +zone=15 +datum=WGS84 +units=us-ft",
        CRS("EPSG:32615").to_wkt(),
    ],
)
def test_a_projected_crs_that_contains_the_survey_is_taken(text: str):
    assert target_crs(text, *MINNESOTA).is_projected


def test_a_survey_across_a_zone_border_may_use_the_zone_of_its_middle():
    across = np.array([-90.02, -90.01, -89.9]), np.full(3, 46.8)
    assert target_crs("EPSG:32615", *across).to_epsg() == 32615
    assert target_crs(None, *across).to_epsg() == 32615
    with pytest.raises(JaxbaError, match="1 of 3 positions outside"):
        target_crs("EPSG:32615", np.array([-90.02, -90.01, -89.0]), np.full(3, 46.8))


def test_an_area_of_use_across_the_180th_meridian_holds_both_sides():
    # EPSG:3832, WGS 84 / PDC Mercator, is for 98.69 east to 68 west
    for longitude in (179.9, -179.9):
        assert target_crs("EPSG:3832", np.array([longitude]), np.array([-17.0])).to_epsg() == 3832
    with pytest.raises(JaxbaError, match="does not contain"):
        target_crs("EPSG:3832", np.array([0.0]), np.array([10.0]))


def test_without_positions_the_kind_is_checked_and_the_place_is_not():
    none = np.zeros(0), np.zeros(0)
    assert target_crs("EPSG:32633", *none).to_epsg() == 32633
    with pytest.raises(JaxbaError, match=r"is geographic: its axes are degrees, not lengths. Give a projected CRS.$"):
        target_crs("EPSG:4326", *none)
    with pytest.raises(JaxbaError, match="no position proposes a CRS"):
        target_crs(None, *none)


def test_headers_of_control_files_are_read():
    assert parse_crs("WGS84 UTM 17N").to_epsg() == 32617
    assert parse_crs("WGS84 UTM 56S").to_epsg() == 32756
    assert parse_crs("+proj=utm +zone=10 +ellps=WGS84 +datum=WGS84 +units=m +no_defs").is_projected
