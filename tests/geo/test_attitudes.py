"""Attitudes in the local frame, their sigmas about the camera's axes, and placeholders that are none."""

import numpy as np
import pytest
from pyproj import CRS
from scipy.spatial.transform import Rotation

from jaxba.geo import local_attitudes, local_frame, local_from_geodetic
from jaxba.scene import Attitude, cam_from_enu

FRAME = local_frame(CRS("EPSG:32615"), np.array([-92.0]), np.array([46.8]), np.array([0.0]))
TILT, YAW = np.radians(2.0), np.radians(5.0)


def attitudes(given, longitude=None, latitude=None):
    longitude = np.full(len(given), -92.0) if longitude is None else np.asarray(longitude)
    latitude = np.full(len(given), 46.8) if latitude is None else np.asarray(latitude)
    return local_attitudes(FRAME, given, longitude, latitude, tilt_std_rad=TILT, yaw_std_rad=YAW)


def test_at_the_origin_the_rotation_is_that_of_the_angles():
    given = Attitude(yaw_deg=30.0, pitch_deg=-60.0, roll_deg=10.0)
    quaternion, _, _ = attitudes([given, None])
    rotation = Rotation.from_quat(quaternion[0], scalar_first=True).as_matrix()
    np.testing.assert_allclose(rotation, cam_from_enu(given), rtol=0, atol=1e-12)
    assert np.isnan(quaternion[1]).all()


def test_away_from_the_origin_north_and_up_are_those_of_the_place():
    """A camera that looks down and north at a place sees the local frame's points there along its own axes."""
    given = Attitude(yaw_deg=0.0, pitch_deg=-90.0, roll_deg=0.0)
    lon, lat = -91.8, 46.9
    quaternion, _, _ = attitudes([given], [lon], [lat])
    steps = local_from_geodetic(
        FRAME, np.array([lon, lon, lon]), np.array([lat, lat + 1e-5, lat]), np.array([0, 0, 1.0])
    )
    north, up = steps[1] - steps[0], steps[2] - steps[0]
    rotation = Rotation.from_quat(quaternion[0], scalar_first=True).as_matrix()
    # 1e-6: a step of 1 m in coordinates of 2e4 m
    np.testing.assert_allclose(rotation @ north / np.linalg.norm(north), [0, -1, 0], rtol=0, atol=1e-6)
    np.testing.assert_allclose(rotation @ up, [0, 0, -1], rtol=0, atol=1e-6)
    # meridians converge by the difference of longitude times the sine of latitude
    assert np.arctan2(north[0], north[1]) == pytest.approx(-np.radians(0.2) * np.sin(np.radians(46.85)), rel=1e-2)


@pytest.mark.parametrize(
    ("pitch_deg", "axis"),
    [(-90.0, 2), (0.0, 1)],  # looking down yaw turns about the viewing axis, looking ahead about the image's columns
)
def test_yaw_is_worse_than_tilt_about_the_axis_that_is_vertical(pitch_deg: float, axis: int):
    _, std_rad, _ = attitudes([Attitude(yaw_deg=77.0, pitch_deg=pitch_deg, roll_deg=0.0)])
    expected = np.full(3, TILT)
    expected[axis] = YAW
    np.testing.assert_allclose(std_rad[0], expected, rtol=1e-9)


def test_zero_attitudes_are_a_placeholder_and_equal_ones_have_no_yaw():
    lon = -92.0 + 1e-4 * np.arange(6)
    zero = [Attitude(yaw_deg=0.0, pitch_deg=0.0, roll_deg=0.0)] * 6
    quaternion, std_rad, notes = attitudes(zero, lon)
    assert np.isnan(quaternion).all() and np.isnan(std_rad).all()
    assert notes == ("Attitudes are zero in all 6 photos that have one: a placeholder, none is used.",)
    same = [Attitude(yaw_deg=10.0, pitch_deg=-90.0, roll_deg=0.0)] * 6
    quaternion, std_rad, notes = attitudes(same, lon)
    assert np.isfinite(quaternion).all()
    np.testing.assert_allclose(std_rad, [[TILT, TILT, np.pi]] * 6, rtol=1e-9)
    assert "a setting rather than a measurement? Their yaw is not used." in notes[0]
    assert attitudes(same)[2] == ()  # from one place
