"""Local, geodetic and projected coordinates against closed formulas, published figures and themselves."""

import time
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from pyproj import CRS, Proj

from jaxba._errors import JaxbaError
from jaxba.geo import (
    geodetic_from_local,
    grid_from_local,
    local_frame,
    local_from_geodetic,
    local_from_projected,
    projected_from_local,
)
from jaxba.scene import LocalFrame

A, F = 6378137.0, 1 / 298.257223563
GRS80_F = 1 / 298.257222101


def frame_at(longitude: float, latitude: float, crs: str, height: float = 100.0, datum: str = "unknown") -> LocalFrame:
    place = np.array([longitude]), np.array([latitude]), np.array([height])
    return local_frame(CRS(crs), *place, datum, "as declared")


def ecef(longitude_deg, latitude_deg, height_m):
    lon, lat = np.radians(longitude_deg), np.radians(latitude_deg)
    e2 = F * (2 - F)
    n = A / np.sqrt(1 - e2 * np.sin(lat) ** 2)
    across = (n + height_m) * np.cos(lat)
    return np.stack([across * np.cos(lon), across * np.sin(lon), (n * (1 - e2) + height_m) * np.sin(lat)], axis=-1)


def enu(frame: LocalFrame, longitude_deg, latitude_deg, height_m):
    """East, north, up by the closed formula: geodetic to earth-centred, difference, rotation."""
    lon, lat = np.radians(frame.longitude_deg), np.radians(frame.latitude_deg)
    east = [-np.sin(lon), np.cos(lon), 0]
    north = [-np.sin(lat) * np.cos(lon), -np.sin(lat) * np.sin(lon), np.cos(lat)]
    up = [np.cos(lat) * np.cos(lon), np.cos(lat) * np.sin(lon), np.sin(lat)]
    origin = ecef(frame.longitude_deg, frame.latitude_deg, frame.height_m)
    return (ecef(longitude_deg, latitude_deg, height_m) - origin) @ np.array([east, north, up]).T


def transverse_mercator(longitude_deg, latitude_deg, middle_deg, scale, flattening, false_east, false_north):
    """Easting and northing by Krueger's series in n to the fourth order (Karney 2011, eqs. 7 to 12 and 35)."""
    lat, lam = np.radians(latitude_deg), np.radians(longitude_deg - middle_deg)
    n = flattening / (2 - flattening)
    e = np.sqrt(flattening * (2 - flattening))
    tau = np.tan(lat)
    sigma = np.sinh(e * np.arctanh(e * tau / np.hypot(1, tau)))
    tau = tau * np.hypot(1, sigma) - sigma * np.hypot(1, tau)
    xi, eta = np.arctan2(tau, np.cos(lam)), np.arcsinh(np.sin(lam) / np.hypot(tau, np.cos(lam)))
    alpha = [
        n / 2 - 2 * n**2 / 3 + 5 * n**3 / 16 + 41 * n**4 / 180,
        13 * n**2 / 48 - 3 * n**3 / 5 + 557 * n**4 / 1440,
        61 * n**3 / 240 - 103 * n**4 / 140,
        49561 * n**4 / 161280,
    ]
    x = eta + sum(a * np.cos(2 * j * xi) * np.sinh(2 * j * eta) for j, a in enumerate(alpha, 1))
    y = xi + sum(a * np.sin(2 * j * xi) * np.cosh(2 * j * eta) for j, a in enumerate(alpha, 1))
    rectifying = A / (1 + n) * (1 + n**2 / 4 + n**4 / 64)
    return false_east + scale * rectifying * x, false_north + scale * rectifying * y


def around(frame: LocalFrame, count: int = 50, spread_m: float = 500.0) -> np.ndarray:
    return np.random.default_rng(0).uniform(-spread_m, spread_m, (count, 3)) * [1, 1, 0.1]


def test_topocentric_figures_are_those_of_the_epsg_guidance_note():
    # IOGP 373-7-2, geographic/topocentric conversions (EPSG method 9837), its example
    frame = frame_at(5.0, 55.0, "EPSG:32631", 200.0)
    longitude, latitude = 2 + 7 / 60 + 46.38 / 3600, 53 + 48 / 60 + 33.82 / 3600
    xyz = local_from_geodetic(frame, np.array([longitude]), np.array([latitude]), np.array([73.0]))
    # 0.2 m: the example's angles are given to 0.01 seconds
    np.testing.assert_allclose(xyz[0], [-189013.869, -128642.040, -4220.171], rtol=0, atol=0.2)


@settings(deadline=None, max_examples=60)
@given(
    st.floats(-179, 179),
    st.floats(-79, 83),
    st.floats(-100, 5000),
    st.tuples(*[st.floats(-20000, 20000)] * 2, st.floats(-500, 500)),
)
def test_local_coordinates_are_those_of_the_closed_formula_and_come_back(longitude, latitude, height, xyz):
    frame = LocalFrame(
        latitude_deg=latitude, longitude_deg=longitude, height_m=height, crs="EPSG:32631", epsg=None, crs_name="",
        unit="metre", height_note="",
    )  # fmt: skip
    local = np.array([xyz])
    geodetic = geodetic_from_local(frame, local)
    # 1e-6 m: PROJ's way from earth-centred to geodetic coordinates stops at 1e-7 m
    np.testing.assert_allclose(enu(frame, *geodetic.T), local, rtol=0, atol=1e-6)
    np.testing.assert_allclose(local_from_geodetic(frame, *geodetic.T), local, rtol=0, atol=1e-6)


@pytest.mark.parametrize(
    ("crs", "longitude", "latitude", "arguments"),
    [
        ("EPSG:32615", -92.0, 46.8, (-93.0, 0.9996, F, 500e3, 0.0)),
        ("EPSG:32756", 151.2, -33.9, (153.0, 0.9996, F, 500e3, 10e6)),
        ("EPSG:2193", 175.0, -40.0, (173.0, 0.9996, GRS80_F, 1600e3, 10e6)),  # its own order is northing, easting
    ],
)
def test_projected_coordinates_are_those_of_kruegers_series_east_first(crs, longitude, latitude, arguments):
    frame = frame_at(longitude, latitude, crs)
    local = around(frame)
    lon, lat, height = geodetic_from_local(frame, local).T
    expected = np.stack([*transverse_mercator(lon, lat, *arguments), height], axis=1)
    # 1e-5 m: the series is cut after the fourth order
    np.testing.assert_allclose(projected_from_local(frame, local), expected, rtol=0, atol=1e-5)


@pytest.mark.parametrize(
    ("crs", "longitude", "latitude", "near"),
    [
        ("EPSG:31467", 9.0, 50.0, (3.5e6, 5.54e6)),  # Gauss-Krueger: northing first, zone number in the easting
        ("EPSG:3035", 10.0, 52.0, (4.321e6, 3.21e6)),  # northing first
        ("EPSG:32661", 0.0, 86.0, (2.0e6, 1.556e6)),  # polar, northing first
        ("EPSG:5041", 0.0, 86.0, (2.0e6, 1.556e6)),  # polar, easting first
    ],
)
def test_x_is_easting_whatever_the_order_of_the_crs(crs, longitude, latitude, near):
    # 2 km: enough to tell the axes apart
    np.testing.assert_allclose(
        projected_from_local(frame_at(longitude, latitude, crs), np.zeros((1, 3)))[0, :2], near, rtol=0, atol=2e3
    )


def test_us_survey_feet_are_1200_over_3937_metres_and_heights_stay_metres():
    metric, feet = frame_at(-122.0, 41.0, "EPSG:26941"), frame_at(-122.0, 41.0, "EPSG:2225")  # California zone 1
    local = around(feet)
    in_feet, in_metres = projected_from_local(feet, local), projected_from_local(metric, local)
    # 2e-4 m: the false easting is defined as 6561666.667 feet, which is 2000000.0001 m
    np.testing.assert_allclose(in_feet[:, :2] * (1200 / 3937), in_metres[:, :2], rtol=0, atol=2e-4)
    np.testing.assert_allclose(
        np.diff(in_feet[:, :2], axis=0) * 0.3048006096, np.diff(in_metres[:, :2], axis=0), atol=1e-6
    )
    np.testing.assert_allclose(in_feet[:, 2], geodetic_from_local(feet, local)[:, 2], rtol=0, atol=1e-9)
    assert feet.unit == "US survey foot"
    assert feet.height_unit == "metre"
    assert "Heights are metres (x and y are in US survey foot) above an unknown surface" in feet.height_note


@pytest.mark.parametrize(
    ("crs", "longitude", "latitude", "datum"),
    [
        ("EPSG:32615", -92.0, 46.8, "unknown"),
        ("EPSG:2225", -122.0, 41.0, "mean_sea_level"),
        ("EPSG:26915+6360", -92.0, 46.8, "EPSG:5703"),
        ("EPSG:2193", 175.0, -40.0, "ellipsoidal"),
        ("EPSG:31467", 9.0, 50.0, "unknown"),
        ("EPSG:27700", -1.0, 52.0, "unknown"),
        ("EPSG:3857", 9.0, 50.0, "unknown"),
        (CRS("EPSG:25832").to_3d().to_wkt(), 9.0, 50.0, "ellipsoidal"),
    ],
)
def test_projected_coordinates_come_back(crs, longitude, latitude, datum):
    frame = frame_at(longitude, latitude, crs, datum=datum)
    local = around(frame, spread_m=5000.0)
    # 1e-6 m: northings of 5e6 m keep 1e-9 m, and PROJ's projections stop at 1e-10 rad
    back = local_from_projected(frame, projected_from_local(frame, local))
    np.testing.assert_allclose(back, local, rtol=0, atol=1e-6)


def test_each_point_is_transformed_by_itself():
    """An affine map fitted at the corners misses the middle by the earth's curvature and the projection's scale."""
    frame = frame_at(-90.1, 46.8, "EPSG:32615")
    grid = np.stack([*np.meshgrid([-4000.0, 0.0, 4000.0], [-4000.0, 0.0, 4000.0]), np.zeros((3, 3))], -1).reshape(-1, 3)
    rows = np.column_stack([np.ones(9), grid[:, :2]])
    projected = projected_from_local(frame, grid)
    affine = rows @ np.linalg.lstsq(rows, projected, rcond=None)[0]
    assert np.abs(projected - affine)[:, 2].max() > 1.0  # 4 km: 1.26 m of curvature
    assert np.abs(projected - affine)[:, :2].max() > 0.05


def test_the_origin_is_the_median_and_the_frame_names_its_crs():
    lon, lat = np.array([-92.0, -91.99, -91.98, -80.0]), np.array([46.8, 46.81, 46.82, 30.0])
    frame = local_frame(CRS("EPSG:32615"), lon, lat, np.array([100.0, np.nan, 120.0, 110.0]))
    assert (frame.longitude_deg, frame.latitude_deg, frame.height_m) == (-91.985, 46.805, 110.0)
    assert (frame.crs, frame.epsg, frame.crs_name, frame.unit) == (
        "EPSG:32615", 32615, "WGS 84 / UTM zone 15N", "metre",
    )  # fmt: skip
    compound = frame_at(-92.0, 46.8, "EPSG:26915+5703", datum="EPSG:5703")
    assert (compound.crs, compound.epsg) == ("EPSG:26915+5703", None)
    custom = frame_at(-92.0, 46.8, "+proj=utm +zone=15 +datum=WGS84 +units=us-ft")
    assert CRS(custom.crs).is_projected
    assert custom.epsg is None


def test_a_crs_without_a_datum_is_refused_rather_than_taken_for_wgs_84():
    with pytest.raises(JaxbaError, match="PROJ knows no transformation from WGS 84 to it; give a CRS that names its"):
        frame_at(-92.0, 46.8, "+proj=utm +zone=15 +ellps=GRS80")


def test_missing_points_stay_missing_and_unreachable_ones_are_named():
    frame = frame_at(-92.0, 46.8, "EPSG:32615")
    local = np.array([[0.0, 0, 0], [np.nan, np.nan, np.nan]])
    assert np.isnan(projected_from_local(frame, local)).tolist() == [[False] * 3, [True] * 3]
    assert projected_from_local(frame, np.zeros((0, 3))).shape == (0, 3)
    with pytest.raises(JaxbaError, match="1 points cannot be transformed between the local frame and WGS 84 / UTM"):
        local_from_projected(frame, np.array([[5e5, 5e6, 0.0], [1e300, 1e300, 0.0]]))


def test_a_million_points_take_seconds():
    frame = frame_at(-92.0, 46.8, "EPSG:32615")
    local = np.random.default_rng(0).uniform(-500, 500, (1_000_000, 3))
    started = time.perf_counter()
    projected_from_local(frame, local)
    assert time.perf_counter() - started < 10  # 0.5 s where nothing else runs


def test_equal_frames_give_equal_bytes():
    frame = frame_at(-92.0, 46.8, "EPSG:26915")
    local = around(frame)
    assert projected_from_local(frame, local).tobytes() == projected_from_local(replace(frame), local).tobytes()


@pytest.mark.parametrize(
    ("crs", "longitude", "latitude"),
    [
        ("EPSG:32615", -92.0, 46.8), ("EPSG:32615", -95.9, 44.9), ("EPSG:32733", 17.2, -33.9),
        ("EPSG:32633", 12.1, 78.2), ("EPSG:26851", -93.2, 44.9), ("EPSG:2056", 8.5, 47.4),
        ("EPSG:2154", 5.7, 45.2), ("EPSG:27700", -3.2, 55.9),
        ("+proj=tmerc +lon_0=9 +datum=WGS84 +units=us-ft", 9.9, 53.5),
    ],
)  # fmt: skip
def test_the_grid_is_turned_by_the_meridian_convergence_and_level_at_each_point(
    crs: str, longitude: float, latitude: float
):
    frame = frame_at(longitude, latitude, crs, datum="ellipsoidal")
    xyz_m = np.array([[0.0, 0.0, 0.0], [900.0, -400.0, 60.0], [-2000.0, 3000.0, 10.0]])
    found = grid_from_local(frame, xyz_m)
    np.testing.assert_allclose(found @ np.swapaxes(found, 1, 2), np.tile(np.eye(3), (3, 1, 1)), atol=1e-12)
    lon, lat, _ = geodetic_from_local(frame, xyz_m).T
    gamma = np.radians(Proj(crs).get_factors(lon, lat).meridian_convergence)
    for k in range(3):
        lam, phi = np.radians([lon[k], lat[k]])
        lam0, phi0 = np.radians([frame.longitude_deg, frame.latitude_deg])
        here, origin = (
            np.array([[-np.sin(a), np.cos(a), 0], [-np.sin(b) * np.cos(a), -np.sin(b) * np.sin(a), np.cos(b)],
                      [np.cos(b) * np.cos(a), np.cos(b) * np.sin(a), np.sin(b)]])
            for a, b in ((lam, phi), (lam0, phi0))
        )  # fmt: skip
        grid = np.array([[np.cos(gamma[k]), -np.sin(gamma[k]), 0], [np.sin(gamma[k]), np.cos(gamma[k]), 0], [0, 0, 1]])
        # 1e-5: the angle between the two ellipsoids of WGS 84 and the CRS's datum, and rounding of 1e-9 m over 1 m
        np.testing.assert_allclose(found[k], grid @ here @ origin.T, rtol=0, atol=1e-5)
