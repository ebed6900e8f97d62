"""Heights are declared or refused: what PROJ would hand through unchanged does not pass."""

import numpy as np
import pytest
from pyproj import CRS, Transformer

from jaxba._errors import JaxbaError
from jaxba.geo import geodetic_from_local, height_step, list_heights, local_frame, projected_from_local

GERMANY = 14.0, 50.0
MINNESOTA = -92.0, 46.8


def step(crs: str, datum: str, place: tuple[float, float] = MINNESOTA):
    return height_step(CRS(crs), datum, "as declared", *place, 100.0)


def test_proj_hands_a_height_through_where_the_grid_is_missing():
    """The trap that this module is there for; without it the refusals below would be idle."""
    z = Transformer.from_crs("EPSG:4979", "EPSG:32633+5773", always_xy=True).transform(*GERMANY, 100.0)[2]
    assert z == 100.0  # the geoid lies 44 m above the ellipsoid there


@pytest.mark.parametrize(
    ("crs", "place", "grid"),
    [
        ("EPSG:32633+5773", GERMANY, "us_nga_egm96_15.tif"),
        ("EPSG:25833+7837", GERMANY, "de_bkg_gcg2016.tif"),
        ("EPSG:26915+5703", MINNESOTA, "us_noaa_"),
        ("EPSG:6344+6360", MINNESOTA, "us_noaa_"),
    ],
)
def test_an_ellipsoidal_height_is_refused_where_the_geoid_grid_is_missing(crs, place, grid):
    with pytest.raises(JaxbaError, match=f"cannot be turned into .*install the grid {grid}.*leave the vertical part"):
        step(crs, "ellipsoidal", place)


def test_another_vertical_datum_is_refused_where_the_grid_is_missing():
    with pytest.raises(JaxbaError, match=r"above EGM96 height \(EPSG:5773\) cannot be turned into NAVD88 height"):
        step("EPSG:26915+5703", "EPSG:5773")


@pytest.mark.parametrize("datum", ["mean_sea_level", "unknown"])
def test_heights_above_no_named_datum_are_refused_with_what_to_declare(datum):
    with pytest.raises(
        JaxbaError, match=r"Declare them with crs.height_datum=EPSG:5773 if that is what they are above"
    ):
        step("EPSG:32615+5773", datum)
    with pytest.raises(JaxbaError, match=r"Declare them with crs.height_datum=ellipsoidal"):
        step(CRS("EPSG:32615").to_3d().to_wkt(), datum)


def test_the_declared_datum_passes_and_keeps_heights():
    found = step("EPSG:32615+5773", "EPSG:5773")
    assert found.operation is None
    assert found.note == "Heights are metre above EGM96 height, the datum of the photos, as declared."


def test_the_same_datum_in_us_feet_passes_in_its_unit():
    place = np.array([MINNESOTA[0]]), np.array([MINNESOTA[1]]), np.array([100.0])
    frame = local_frame(CRS("EPSG:26915+6360"), *place, "EPSG:5703", "as declared")
    assert frame.height_unit == "US survey foot"
    assert projected_from_local(frame, np.zeros((1, 3)))[0, 2] == pytest.approx(100 * 3937 / 1200, abs=1e-7)


def test_ellipsoidal_heights_go_to_a_three_dimensional_projected_crs():
    found = step(CRS("EPSG:32615").to_3d().to_wkt(), "ellipsoidal")
    assert found.operation is not None
    place = np.array([MINNESOTA[0]]), np.array([MINNESOTA[1]]), np.array([100.0])
    frame = local_frame(CRS("EPSG:32615").to_3d(), *place, "ellipsoidal", "as declared")
    local = np.array([[100.0, 200.0, 7.0]])
    assert projected_from_local(frame, local)[0, 2] == pytest.approx(geodetic_from_local(frame, local)[0, 2], abs=1e-9)


def test_without_a_vertical_part_heights_stay_and_the_note_says_above_what():
    for datum, words in (
        ("ellipsoidal", "Heights are metres above the WGS 84 ellipsoid, as declared;"),
        ("mean_sea_level", "Heights are metres above mean sea level (no geoid named), as declared;"),
        ("unknown", "Heights are metres above an unknown surface, as the photos have them;"),
        ("EPSG:5773", "Heights are metres above EGM96 height (EPSG:5773), as declared;"),
    ):
        found = step("EPSG:32615", datum)
        assert found.operation is None
        assert found.note.startswith(words)


@pytest.mark.parametrize(
    ("datum", "words"),
    [
        ("EPSG:32615", "is no vertical CRS"),
        ("EPSG:4979", "is no vertical CRS"),
        ("sea", "is no CRS that PROJ knows"),
        ("EPSG:5715", "its vertical axis points down"),  # mean sea level depth
    ],
)
def test_a_height_datum_that_is_none_is_refused(datum, words):
    with pytest.raises(JaxbaError, match=words):
        step("EPSG:32615", datum)


@pytest.mark.parametrize(
    ("crs", "metres", "above", "words"),
    [
        ("EPSG:26851", 1200 / 3937, None, "does not say the unit of z, so z is in that of x and y"),  # US feet
        ("EPSG:2222", 0.3048, None, "does not say the unit of z"),  # Arizona East, international feet
        ("+proj=utm +zone=15 +datum=WGS84 +units=us-ft", 1200 / 3937, None, "does not say the unit of z"),
        ("+proj=utm +zone=15 +ellps=GRS80 +towgs84=0,0,0 +units=ft", 0.3048, None, "does not say the unit of z"),
        ("EPSG:26851+6360", 1200 / 3937, "EPSG:6360", "has heights in US survey foot"),
        ("EPSG:26851+5703", 1.0, "EPSG:5703", ""),  # heights in metres beside x and y in feet
        ("EPSG:32615+6360", 1200 / 3937, "EPSG:6360", "has heights in US survey foot"),
        ("EPSG:32615+8228", 0.3048, "EPSG:8228", "has heights in foot"),
        ("EPSG:4326+6360", 1200 / 3937, "EPSG:6360", "has heights in US survey foot"),
        ("+proj=utm +zone=15 +datum=WGS84 +vunits=us-ft", 1200 / 3937, "ellipsoidal", "has heights in US survey foot"),
        ("EPSG:32615", 1.0, None, ""),
        ("EPSG:4326", 1.0, None, ""),
        ("EPSG:4979", 1.0, "ellipsoidal", ""),
        ("EPSG:32615+5773", 1.0, "EPSG:5773", ""),
    ],
)
def test_heights_of_every_list_are_in_the_unit_of_their_axis_or_of_x_and_y(crs, metres, above, words):
    height_m, found, notes = list_heights(crs, np.array([1000.0, np.nan, 1100.0]), "geo.txt")
    np.testing.assert_allclose(height_m, [1000 * metres, np.nan, 1100 * metres], rtol=1e-12)
    assert found == above and len(notes) == bool(words)
    assert not words or (words in notes[0] and f"is {1050 * metres:.2f} m." in notes[0])


def test_a_list_of_depths_is_refused():
    with pytest.raises(JaxbaError, match=r"geo.txt: EPSG:32615\+5715 .*points down; give a CRS with heights"):
        list_heights("EPSG:32615+5715", np.ones(1), "geo.txt")
