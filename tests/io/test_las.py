"""LAS and LAZ as laspy reads them: CRS, millimetres, colours."""

import datetime
from pathlib import Path

import laspy
import numpy as np
import pytest
from blocks import flown_cloud
from pyproj import CRS

from jaxba._errors import JaxbaError
from jaxba.io import CrsText, write_las

UTM = (565_000.0, 5_184_000.0, 210.0)


def crs_text(text: str) -> CrsText:
    return CrsText(text=text, name="", unit="metre", height_unit="metre", height_note="")


@pytest.mark.parametrize("name", ["cloud.las", "cloud.laz"])
@pytest.mark.parametrize("offset", [(0.0, 0.0, 0.0), UTM, (-2_500_000.5, 9_999_999.25, -400.0)])
def test_coordinates_keep_millimetres_wherever_the_cloud_lies(tmp_path: Path, name: str, offset: tuple):
    cloud = flown_cloud(offset)
    write_las(tmp_path / name, cloud, crs_text("EPSG:32615"))
    las = laspy.read(tmp_path / name)
    assert las.header.version == "1.4"
    assert las.header.are_points_compressed == name.endswith("laz")
    # half a scale, and the rounding of a coordinate of 1e7
    np.testing.assert_allclose(las.xyz, cloud.xyz, rtol=0, atol=0.0005 + 4e-9)
    assert np.all(las.header.offsets == np.round(las.header.offsets))
    assert las.header.scales.tolist() == [0.001] * 3
    np.testing.assert_allclose(las.header.mins, cloud.xyz.min(axis=0), atol=0.0006)
    np.testing.assert_allclose(las.header.maxs, cloud.xyz.max(axis=0), atol=0.0006)


def test_colours_errors_and_track_lengths_are_there(tmp_path: Path):
    cloud = flown_cloud(UTM)
    write_las(tmp_path / "cloud.laz", cloud, crs_text("EPSG:32615"))
    las = laspy.read(tmp_path / "cloud.laz")
    assert np.array_equal(np.stack([las.red, las.green, las.blue], 1), cloud.rgb.astype(int) * 257)
    assert las.red.max() > 65000
    np.testing.assert_allclose(las["error_px"], cloud.error_px, rtol=1e-7)  # float32
    assert np.array_equal(las["track_length"], cloud.track_length)
    assert np.array_equal(las["point_id"], cloud.point_id)
    sigmas = np.stack([las[f"std_{axis}_m"] for axis in "xyz"], axis=1)
    np.testing.assert_array_equal(sigmas, cloud.std_m.astype(np.float32))


@pytest.mark.parametrize("text", ["EPSG:32615", "EPSG:32615+5773", "EPSG:2225", "EPSG:6339+5703"])
def test_header_names_the_crs_with_its_heights(tmp_path: Path, text: str):
    write_las(tmp_path / "cloud.laz", flown_cloud(UTM), crs_text(text))
    header = laspy.read(tmp_path / "cloud.laz").header
    assert header.global_encoding.wkt
    found, expected = header.parse_crs(), CRS(text)
    assert found is not None
    if not expected.is_compound:
        assert found.to_epsg() == expected.to_epsg()
        return
    assert found.is_compound
    assert [part.to_epsg() for part in found.sub_crs_list] == [part.to_epsg() for part in expected.sub_crs_list]


def test_crs_without_a_code_is_kept_as_text(tmp_path: Path):
    proj = "+proj=tmerc +lat_0=0 +lon_0=-92 +k=1 +x_0=0 +y_0=0 +ellps=GRS80 +units=m"
    write_las(tmp_path / "cloud.laz", flown_cloud(), crs_text(CRS(proj).to_wkt()))
    found = laspy.read(tmp_path / "cloud.laz").header.parse_crs()
    assert found is not None
    assert found.coordinate_operation.params[1].value == -92


def test_same_cloud_gives_the_same_bytes(tmp_path: Path):
    for name in ("a.laz", "b.laz"):
        write_las(tmp_path / name, flown_cloud(UTM), crs_text("EPSG:32615"))
    assert (tmp_path / "a.laz").read_bytes() == (tmp_path / "b.laz").read_bytes()


@pytest.mark.parametrize("date", [None, datetime.date(2024, 2, 29), datetime.date(2025, 12, 31)])
@pytest.mark.parametrize("name", ["cloud.las", "cloud.laz"])
def test_the_date_is_that_of_the_flight_or_none(tmp_path: Path, name: str, date: datetime.date | None):
    write_las(tmp_path / name, flown_cloud(UTM), crs_text("EPSG:32615"), date=date)
    las = laspy.read(tmp_path / name)
    assert las.header.creation_date == date and len(las.points) == flown_cloud().num_points
    if date is None:
        assert (tmp_path / name).read_bytes()[90:94] == bytes(4)


def test_cloud_that_millimetres_cannot_hold_is_refused(tmp_path: Path):
    cloud = flown_cloud()
    cloud.xyz[0, 0], cloud.xyz[1, 0] = 3e6, -3e6
    with pytest.raises(JaxbaError, match=r"cloud\.laz: not written, point 1 at .* too far .*2 such points.*outliers"):
        write_las(tmp_path / "cloud.laz", cloud, crs_text("EPSG:32615"))
    cloud.xyz[:] = np.nan
    with pytest.raises(JaxbaError, match=r"point 1 holds NaN or infinity \(2\d\d such points\)"):
        write_las(tmp_path / "cloud.laz", cloud, crs_text("EPSG:32615"))
    assert list(tmp_path.iterdir()) == []
