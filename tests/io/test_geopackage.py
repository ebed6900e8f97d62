"""Cameras in GeoPackage and GeoJSON as pyogrio, shapely, sqlite3 and json read them."""

import datetime
import json
import sqlite3
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyogrio
import pytest
import shapely
from blocks import flown_block
from pyproj import CRS
from scipy.spatial.transform import Rotation

from jaxba._errors import JaxbaError
from jaxba.io import SITE_COLUMNS, CrsText, Sites, make_sites, write_geojson, write_geopackage
from jaxba.io._sites import attitude_deg, heading_deg, omega_phi_kappa_deg
from jaxba.scene import Attitude, Reference, cam_from_enu

UTM = CrsText(text="EPSG:32615", name="", unit="metre", height_unit="metre", height_note="Heights: ellipsoidal.")
PLACE = np.array([565_000.0, 5_184_000.0, 210.0])


def sites() -> Sites:
    flown = flown_block()
    count = len(flown.photos)
    xyz = np.arange(3.0 * count).reshape(-1, 3)
    std = np.ones((count, 3))
    xyz[3], std[6, 2] = np.nan, np.inf
    reference = Reference(
        frame=None, xyz_m=xyz, std_m=std, quaternion=np.full((count, 4), np.nan), attitude_std_rad=std,
        is_used=np.ones(count, bool), height_above_ground_m=np.full(count, np.nan),
    )  # fmt: skip
    residual = np.full((6, 3), 0.25)
    residual[2] = np.nan
    return make_sites(
        flown.block, flown.photos, reference, std_m=np.full((6, 3), 0.125), gnss_residual_m=residual,
        error_px=flown.error_px, grid_from_local=np.tile(np.eye(3), (6, 1, 1)),
    )  # fmt: skip


def table(path: Path) -> tuple[dict, dict, np.ndarray]:
    meta, _, geometry, columns = pyogrio.raw.read(path)
    return meta, dict(zip(meta["fields"].tolist(), columns, strict=True)), shapely.from_wkb(geometry)


def test_geopackage_holds_every_placed_photo_with_what_is_known_of_it(tmp_path: Path):
    made, flown = sites(), flown_block()
    write_geopackage(tmp_path / "cameras.gpkg", made, made.xyz_m + PLACE, UTM)
    meta, columns, points = table(tmp_path / "cameras.gpkg")
    assert CRS(meta["crs"]) == CRS(32615)
    assert meta["geometry_type"] == "Point Z"
    xyz = shapely.get_coordinates(points, include_z=True)
    rows = [0, 1, 2, 3, 4, 6]  # of the block's images: photo 3 has no place at all
    np.testing.assert_allclose(xyz[rows], flown.block.centers_m + PLACE, rtol=0, atol=1e-9)
    np.testing.assert_allclose(xyz[5] - PLACE, [18, 19, 20])
    assert columns["name"].tolist() == [photo.name for i, photo in enumerate(flown.photos) if i != 3]
    assert columns["registered"].tolist() == [True, True, True, True, True, False, True]
    assert columns["camera"].tolist() == ["left"] * 3 + ["right"] * 4
    assert columns["reason"][5] == "blurred (its height is not known; the survey's stands in for it)"
    assert columns["reason"][0] == ""
    assert np.isnan(columns["std_e_m"][5]) and columns["std_u_m"][0] == 0.125
    assert np.isnan(columns["gnss_residual_n_m"][2]) and columns["gnss_residual_n_m"][0] == 0.25
    errors = [flown.error_px[flown.block.observation_image == row] for row in range(6)]
    assert columns["num_observations"][rows].tolist() == [len(e) for e in errors]
    np.testing.assert_allclose(columns["median_error_px"][rows], [np.median(e) for e in errors])


def test_unknown_numbers_are_null_and_the_dates_are_fixed(tmp_path: Path):
    made = sites()
    write_geopackage(tmp_path / "cameras.gpkg", made, made.xyz_m + PLACE, UTM)
    with closing(sqlite3.connect(tmp_path / "cameras.gpkg")) as base:
        unknown = base.execute("select std_e_m, yaw_deg, median_error_px from cameras where registered = 0").fetchall()
        layers = base.execute("select table_name, description, last_change, srs_id from gpkg_contents").fetchall()
    assert unknown == [(None, None, None)]
    assert layers == [("cameras", "Heights: ellipsoidal.", "2000-01-01T00:00:00.000Z", 32615)]
    assert pyogrio.get_gdal_config_option("OGR_CURRENT_DATE") is None
    write_geopackage(tmp_path / "dated.gpkg", made, made.xyz_m + PLACE, UTM, date=datetime.date(2024, 5, 1))
    with closing(sqlite3.connect(tmp_path / "dated.gpkg")) as base:
        assert base.execute("select last_change from gpkg_contents").fetchall() == [("2024-05-01T00:00:00.000Z",)]


def test_every_column_is_described_and_the_file_is_whole(tmp_path: Path):
    made = sites()
    write_geopackage(tmp_path / "cameras.gpkg", made, made.xyz_m + PLACE, UTM)
    with closing(sqlite3.connect(tmp_path / "cameras.gpkg")) as base:
        said = base.execute("select column_name, description from gpkg_data_columns").fetchall()
        columns = [row[1] for row in base.execute("pragma table_info(cameras)")]
        extensions = {row[0] for row in base.execute("select extension_name from gpkg_extensions")}
        assert base.execute("pragma integrity_check").fetchall() == [("ok",)]
    assert dict(said) == SITE_COLUMNS and [name for name, _ in said] == columns[2:]  # after fid and geom
    assert "gpkg_schema" in extensions and list(table(tmp_path / "cameras.gpkg")[1]) == list(SITE_COLUMNS)
    for name, meaning in said:
        unit = {"m": "metres", "deg": "degrees", "px": "pixels"}.get(name.rsplit("_", 1)[-1])
        assert unit is None or unit in meaning, name


def test_same_cameras_give_the_same_bytes(tmp_path: Path):
    made = sites()
    for run in "ab":
        write_geopackage(tmp_path / f"{run}.gpkg", made, made.xyz_m + PLACE, UTM)
        write_geojson(tmp_path / f"{run}.geojson", made, np.ones((7, 3)))
    for kind in ("gpkg", "geojson"):
        assert (tmp_path / f"a.{kind}").read_bytes() == (tmp_path / f"b.{kind}").read_bytes()


@pytest.mark.parametrize("text", ["EPSG:32615+5773", "EPSG:2225", CRS("+proj=tmerc +lon_0=9 +ellps=GRS80").to_wkt()])
def test_geopackage_holds_compound_foot_and_custom_crs(tmp_path: Path, text: str):
    made = sites()
    write_geopackage(tmp_path / "cameras.gpkg", made, made.xyz_m + PLACE, replace(UTM, text=text))
    found, expected = CRS(table(tmp_path / "cameras.gpkg")[0]["crs"]), CRS(text)
    assert found.equals(expected, ignore_axis_order=True)
    if expected.is_compound:
        assert [part.to_epsg() for part in found.sub_crs_list] == [32615, 5773]


def test_geojson_is_longitude_latitude_height_on_wgs_84(tmp_path: Path):
    made = sites()
    geodetic = np.stack([np.linspace(-92.1, -92, 7), np.linspace(46.7, 46.8, 7), np.linspace(200, 260.0625, 7)], 1)
    write_geojson(tmp_path / "cameras.geojson", made, geodetic, description="Heights: ellipsoidal.")
    content = json.loads((tmp_path / "cameras.geojson").read_text())
    assert "crs" not in content  # RFC 7946, section 4
    assert content["description"] == "Heights: ellipsoidal."
    found = np.array([feature["geometry"]["coordinates"] for feature in content["features"]])
    np.testing.assert_allclose(found, geodetic, rtol=0, atol=1e-8)
    properties = [feature["properties"] for feature in content["features"]]
    assert [p["registered"] for p in properties].count(True) == 6
    assert properties[5]["std_e_m"] is None


def test_photo_without_a_place_is_refused(tmp_path: Path):
    made = sites()
    with pytest.raises(JaxbaError, match=r"cameras\.gpkg: not written, DJI_0000\.JPG has no finite place"):
        write_geopackage(tmp_path / "cameras.gpkg", made, np.full((7, 3), np.nan), UTM)
    with pytest.raises(JaxbaError, match=r"cameras\.geojson: not written, GDAL says .*"):
        write_geojson(tmp_path / "cameras.geojson", made, made.xyz_m + PLACE)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("pitch", [-90.0, -89.0, -60.0, -20.0, 0.0, 30.0])
def test_attitude_is_that_of_which_the_rotation_was_made(pitch: float):
    rng = np.random.default_rng(0)
    for yaw, roll in rng.uniform(-170, 170, (20, 2)):
        roll = 0.0 if pitch == -90 else roll
        rotation = cam_from_enu(Attitude(yaw_deg=yaw, pitch_deg=pitch, roll_deg=roll))[None]
        np.testing.assert_allclose(attitude_deg(rotation)[0], [yaw, pitch, roll], atol=1e-6)


@pytest.mark.parametrize("pitch", [-90.0, -89.0, -45.0, -20.0])
def test_heading_is_yaw_without_roll_and_steady_straight_down(pitch: float):
    for yaw in (2.0, 90.0, 200.0, 357.0):
        rotation = cam_from_enu(Attitude(yaw_deg=yaw, pitch_deg=pitch, roll_deg=0.0))
        assert heading_deg(rotation[None])[0] == pytest.approx(yaw, abs=1e-9)
        leaning = Rotation.from_rotvec([0, np.radians(1), 0]).as_matrix() @ rotation
        assert heading_deg(leaning[None])[0] == pytest.approx(yaw, abs=1.5)


def test_omega_phi_kappa_are_those_of_scipy():
    rng = np.random.default_rng(0)
    angles = np.concatenate([rng.uniform(-180, 180, (50, 3)) * [1, 0.49, 1], rng.normal(0, 2, (50, 3)) * [1, 1, 90]])
    wanted = Rotation.from_euler("XYZ", angles, degrees=True)  # Rx(omega) Ry(phi) Rz(kappa)
    photo_from_cam = np.diag([1.0, -1.0, -1.0])
    found = omega_phi_kappa_deg(wanted.as_matrix() @ photo_from_cam)
    np.testing.assert_allclose(found, wanted.as_euler("XYZ", degrees=True), atol=1e-9)


@pytest.mark.parametrize("phi", [-90.0, 90.0])
@pytest.mark.parametrize("kappa", [-170.0, -20.0, 0.0, 95.0])
def test_a_photo_that_looks_along_the_grids_x_axis_has_angles_that_make_its_rotation(phi: float, kappa: float):
    wanted = Rotation.from_euler("XYZ", [0.0, phi, kappa], degrees=True).as_matrix()
    found = omega_phi_kappa_deg((wanted @ np.diag([1.0, -1.0, -1.0]))[None])[0]
    assert found[0] == 0.0
    again = Rotation.from_euler("XYZ", found, degrees=True).as_matrix()
    np.testing.assert_allclose(again, wanted, atol=1e-9)


@pytest.mark.parametrize("heading", [0.0, 63.0, 90.0, 200.0, 355.0])
def test_along_a_strip_that_looks_down_omega_and_phi_are_small_and_kappa_is_steady(heading: float):
    """Leaning by a degree to any side, where yaw and roll jump by tens of degrees."""
    down = cam_from_enu(Attitude(yaw_deg=heading, pitch_deg=-90.0, roll_deg=0.0))
    leaning = Rotation.from_rotvec(np.random.default_rng(1).uniform(-1, 1, (40, 3)) * [1, 1, 0.2], degrees=True)
    cam_from_world = leaning.as_matrix() @ down
    omega, phi, kappa = omega_phi_kappa_deg(np.swapaxes(cam_from_world, 1, 2)).T
    assert np.abs(omega).max() < 1.5 and np.abs(phi).max() < 1.5
    turned = (kappa + heading + 180) % 360 - 180  # kappa counts anticlockwise
    assert np.abs(turned).max() < 0.5 and np.ptp(attitude_deg(cam_from_world)[:, 0]) > 90
