"""Positions in any CRS come to WGS 84 each by itself; sigmas follow what is stated; heights are of one system."""

import numpy as np
import pytest
from geo_photos import photo, place
from pyproj import Transformer

from jaxba._errors import JaxbaError
from jaxba.geo import measured_positions
from jaxba.scene import Position


def at(east_m: float = 0.0, north_m: float = 0.0, **fields) -> Position:
    x, y = place(east_m, north_m)
    return Position(x=x, y=y, **fields)


@pytest.mark.parametrize("crs", ["EPSG:32615", "EPSG:26849", "WGS84 UTM 15N", "EPSG:3857"])
def test_projected_positions_come_back_to_their_longitude_and_latitude(crs: str):
    text = "EPSG:32615" if crs.startswith("WGS84") else crs
    lon, lat = np.array([place(100 * k, 50 * k) for k in range(4)]).T
    # NAD83 and WGS 84 are taken as one by the operation that is installed, as PROJ does here
    x, y = Transformer.from_crs("EPSG:4326", text, always_xy=True).transform(lon, lat)
    photos = [photo(k, Position(crs=crs, x=x[k], y=y[k], z_m=100.0)) for k in range(4)]
    measured = measured_positions(photos)
    # 1e-11 degrees: a micrometre
    np.testing.assert_allclose(measured.longitude_deg, lon, rtol=0, atol=1e-11)
    np.testing.assert_allclose(measured.latitude_deg, lat, rtol=0, atol=1e-11)


def test_a_geographic_crs_with_latitude_first_still_has_longitude_for_x():
    x, y = place(0, 0)
    for crs in ("EPSG:4326", "EPSG:4979", "EPSG:4269"):  # all three name latitude first
        measured = measured_positions([photo(0, Position(crs=crs, x=x, y=y))])
        # 1e-9: 4269 is NAD83, which the installed operation takes for WGS 84
        assert measured.longitude_deg[0] == pytest.approx(x, abs=1e-9)
        assert measured.latitude_deg[0] == pytest.approx(y, abs=1e-9)


def test_a_shift_of_datum_is_told_with_its_accuracy_and_the_grid_that_would_be_better():
    measured = measured_positions([photo(0, Position(crs="EPSG:31467", x=3.5e6, y=5.54e6))])
    assert "accuracy 3 m; the best operation needs the grid de_adv_BETA2007.tif, which is not installed" in "".join(
        measured.notes
    )
    assert measured_positions([photo(0, Position(crs="EPSG:32615", x=5e5, y=5e6))]).notes == ()


@pytest.mark.parametrize(("x", "y"), [(0.0, 0.0), (np.nan, 46.8), (-92.0, 91.0), (-181.0, 46.8), (-92.0, np.inf)])
def test_coordinates_that_are_none_are_missing(x: float, y: float):
    measured = measured_positions([photo(0, Position(x=x, y=y, z_m=5.0)), photo(1, at()), photo(2, None)])
    assert np.isnan(measured.longitude_deg).tolist() == [True, False, True]
    assert np.isnan(measured.height_m[0])
    assert np.isnan(measured.std_m[2]).all()


@pytest.mark.parametrize(
    ("fields", "std_m"),
    [
        ({}, (3.0, 3.0, 5.0)),
        ({"fix": "single"}, (3.0, 3.0, 5.0)),
        ({"fix": "differential"}, (1.0, 1.0, 2.0)),
        ({"fix": "rtk_float"}, (0.5, 0.5, 1.0)),
        ({"fix": "rtk_fixed"}, (0.03, 0.03, 0.06)),
        ({"fix": "rtk_fixed", "std_h_m": 0.01, "std_v_m": 0.02}, (0.03, 0.03, 0.06)),
        ({"fix": "rtk_fixed", "std_h_m": 0.1, "std_v_m": 0.15}, (0.1, 0.1, 0.15)),
        ({"std_h_m": 1.5}, (1.5, 1.5, 3.0)),
        ({"std_v_m": 1.5}, (3.0, 3.0, 1.5)),
        ({"std_h_m": 0.0, "std_v_m": 0.0}, (3.0, 3.0, 5.0)),
        ({"z_m": None}, (3.0, 3.0, np.inf)),
    ],
)
def test_sigma_is_the_stated_one_or_follows_the_fix(fields: dict, std_m: tuple[float, float, float]):
    measured = measured_positions([photo(0, at(**{"z_m": 100.0, **fields}))])
    assert tuple(measured.std_m[0]) == std_m


def test_heights_above_two_surfaces_are_refused_unless_declared():
    photos = [photo(0, at(z_m=1.0, height_kind="ellipsoidal")), photo(1, at(z_m=1.0, height_kind="mean_sea_level"))]
    with pytest.raises(
        JaxbaError, match=r"above different surfaces.*the WGS 84 ellipsoid: 1 \(p000.jpg, ...\), mean sea"
    ):
        measured_positions(photos)
    declared = measured_positions(photos, height_datum="ellipsoidal")
    assert (declared.height_datum, declared.declared) == ("ellipsoidal", "as declared")
    assert "declared as ellipsoidal, though the photos' tags say" in declared.notes[0]


def test_heights_that_do_not_say_are_taken_with_those_that_do_and_it_is_said():
    photos = [photo(0, at(z_m=1.0, height_kind="ellipsoidal")), photo(1, at(z_m=1.0)), photo(2, at())]
    measured = measured_positions(photos)
    assert measured.height_datum == "ellipsoidal"
    assert "Some heights do not say what they are above; all are taken as ellipsoidal" in measured.notes[0]
    assert measured_positions(photos).is_datum_assumed and not measured_positions(photos[:1]).is_datum_assumed
    assert measured_positions(photos[1:]).height_datum == "unknown" and measured_positions(photos[1:]).is_datum_assumed
    assert not measured_positions(photos[1:], height_datum="ellipsoidal").is_datum_assumed


def test_a_compound_crs_of_positions_declares_their_vertical_datum():
    positions = [Position(crs="EPSG:32615+5773", x=5e5 + k, y=5e6, z_m=100.0) for k in range(2)]
    assert measured_positions([photo(k, p) for k, p in enumerate(positions)]).height_datum == "EPSG:5773"
    x, y = place(0, 0)
    assert measured_positions([photo(0, Position(crs="EPSG:4979", x=x, y=y, z_m=1.0))]).height_datum == "ellipsoidal"


@pytest.mark.parametrize("crs", ["EPSG:5773", "EPSG:4978", "nonsense"])
def test_a_crs_of_positions_that_is_none_is_refused_with_the_photo(crs: str):
    with pytest.raises(JaxbaError, match=r"p000.jpg \(EXIF\)"):
        measured_positions([photo(0, Position(crs=crs, x=1.0, y=2.0))])


def test_times_are_read_in_both_notations_and_the_order_stands_in_where_one_is_missing():
    photos = [photo(0, at(), time_s=0.0), photo(1, at(), time_s=61.5)]
    assert np.diff(measured_positions(photos).time_s) == pytest.approx([61.5])
    assert measured_positions([*photos, photo(2, at())]).time_s.tolist() == [0, 1, 2]
