"""Surveyed points on WGS 84: any CRS, units of heights, surfaces that heights are above, and usual mistakes."""

import numpy as np
import pytest
from pyproj import Transformer

from jaxba._errors import JaxbaError
from jaxba.geo import elsewhere, heights_above, surveyed_points

UTM = np.array([[576308.6, 5183424.7, 198.0], [576408.6, 5183400.0, 199.0]])


def surveyed(crs: str, xyz: np.ndarray = UTM, **options):
    return surveyed_points([crs] * len(xyz), xyz, name="gcp_list.txt", **options)


def test_places_are_those_of_pyproj():
    found = surveyed("EPSG:32615")
    lon, lat = Transformer.from_crs(32615, 4326, always_xy=True).transform(*UTM[:, :2].T)
    np.testing.assert_allclose([found.longitude_deg, found.latitude_deg], [lon, lat], atol=1e-9)
    assert found.crs == "EPSG:32615" and found.height_datum == "unknown"


def test_a_proj_string_is_named_by_the_code_of_its_zone():
    assert surveyed("+proj=utm +zone=15 +datum=WGS84 +units=m +no_defs").crs == "EPSG:32615"


def test_heights_are_taken_for_the_photos_and_this_is_said():
    found = surveyed("EPSG:32615", photos_datum="ellipsoidal")
    assert found.height_datum == "ellipsoidal" and "for the same as the photos'" in found.notes[-1]
    assert found.is_datum_assumed
    declared = surveyed("EPSG:32615", photos_datum="ellipsoidal", height_datum="EPSG:5773")
    assert declared.height_datum == "EPSG:5773" and not declared.notes and not declared.is_datum_assumed
    assert not surveyed("EPSG:32615+5773").is_datum_assumed


def test_feet_of_a_crs_are_feet_in_height_too():
    lon, lat = -92.0, 46.8
    x, y = Transformer.from_crs(4326, 26849, always_xy=True).transform(lon, lat)  # Minnesota North, US feet
    found = surveyed("EPSG:26849", np.array([[x, y, 1000.0]]))
    np.testing.assert_allclose(found.height_m, 1000 * 1200 / 3937)
    assert any("unit of z" in note and "US survey foot" in note for note in found.notes)


def test_compound_crs_says_what_heights_are_above():
    assert surveyed("EPSG:32615+5773").height_datum == "EPSG:5773"
    with pytest.raises(JaxbaError, match=r"several surfaces"):
        surveyed_points(["EPSG:32615+5773", "EPSG:32615+5703"], UTM, name="gcp_list.txt")


def test_heights_above_two_surfaces_are_never_mixed():
    found = surveyed("EPSG:32615+5773")
    assert heights_above("EPSG:5773", found, "gcp_list.txt")[0].tolist() == [198.0, 199.0]
    with pytest.raises(JaxbaError, match=r"what leads from one to the other is not known.*crs.height_datum=EPSG:5773"):
        heights_above("unknown", found, "gcp_list.txt")
    with pytest.raises(JaxbaError, match=r"EGM96 height \(EPSG:5773\), and the photos' above the WGS 84 ellipsoid"):
        heights_above("ellipsoidal", found, "gcp_list.txt")  # the grid is not installed, and PROJ alone would keep z


def test_points_outside_their_crs_are_refused():
    with pytest.raises(JaxbaError, match=r"does not contain the survey.*Swap x and y"):
        surveyed("EPSG:32615", UTM[:, [1, 0, 2]])
    with pytest.raises(JaxbaError, match=r"Swap x and y|has no place"):
        surveyed("+proj=utm +zone=11 +datum=WGS84", np.array([[3811198.11, 235269.88, 0.0]]))


def test_usual_mistakes_are_undone_one_by_one():
    xy = UTM[:, :2]
    found = {words: (lon[0], lat[0]) for words, lon, lat in elsewhere("EPSG:32614", xy, (-92.0, 46.8))}
    np.testing.assert_allclose(found["UTM zone 15N (EPSG:32615)"], [-92.0, 46.8], atol=1e-3)
    swapped = elsewhere("EPSG:4326", np.array([[46.8, -89.0]]), (-89.0, 46.8))
    assert swapped[0][0] == "x and y swapped" and (swapped[0][1][0], swapped[0][2][0]) == (-89.0, 46.8)
