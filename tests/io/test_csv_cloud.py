"""CSV clouds as the standard library's csv and json read them."""

import csv
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from blocks import flown_cloud
from pyproj import CRS

from jaxba._errors import JaxbaError
from jaxba.io import CLOUD_COLUMNS, CrsText, cloud_frame, write_csv_cloud
from jaxba.io._read_cloud import read_csv_cloud

UTM = CrsText(
    text="EPSG:32615", name="WGS 84 / UTM zone 15N", unit="metre", height_unit="metre", height_note="ellipsoid."
)


def rows(path: Path) -> list[dict[str, str]]:
    with open(path, newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file))


def test_every_column_is_there_to_a_thousandth(tmp_path: Path):
    cloud = replace(flown_cloud((565_000.0, 5_184_000.0, 210.0)), std_m=np.full((flown_cloud().num_points, 3), 0.01))
    write_csv_cloud(tmp_path / "cloud.csv", cloud, UTM)
    table = rows(tmp_path / "cloud.csv")
    wanted = "X Y Z PointID error_px track_length std_x_m std_y_m std_z_m R G B EPSG"
    assert list(table[0]) == wanted.split()
    xyz = np.array([[float(row[axis]) for axis in "XYZ"] for row in table])
    np.testing.assert_allclose(xyz, cloud.xyz, rtol=0, atol=0.0005 + 1e-9)
    assert [int(row["PointID"]) for row in table] == cloud.point_id.tolist()
    assert [int(row["track_length"]) for row in table] == cloud.track_length.tolist()
    np.testing.assert_allclose([float(row["error_px"]) for row in table], cloud.error_px, rtol=0, atol=0.00051)
    assert [[int(row[c]) for c in "RGB"] for row in table] == cloud.rgb.tolist()
    assert {row["std_z_m"] for row in table} == {"0.010"}
    assert {row["EPSG"] for row in table} == {"32615"}


def test_sidecar_says_what_the_numbers_are(tmp_path: Path):
    write_csv_cloud(tmp_path / "cloud.csv", flown_cloud(), UTM)
    note = json.loads((tmp_path / "cloud.csv.json").read_text())
    assert (note["EPSG"], note["unit"], note["heights"]) == (32615, "metre", "ellipsoid.")
    assert note["points"] == len(rows(tmp_path / "cloud.csv"))
    assert CRS(note["wkt"]) == CRS(32615)
    assert list(note["columns"]) == list(rows(tmp_path / "cloud.csv")[0])


def test_compound_crs_has_both_codes(tmp_path: Path):
    write_csv_cloud(tmp_path / "cloud.csv", flown_cloud(), replace(UTM, text="EPSG:32615+5773"))
    assert rows(tmp_path / "cloud.csv")[0]["EPSG"] == "32615+5773"
    note = json.loads((tmp_path / "cloud.csv.json").read_text())
    assert (note["EPSG"], note["code"]) == (None, "32615+5773")
    assert CRS(note["wkt"]).is_compound


def test_without_a_crs_the_code_is_empty_and_unknown_sigmas_too(tmp_path: Path):
    write_csv_cloud(tmp_path / "cloud.csv", flown_cloud(), None)
    first = rows(tmp_path / "cloud.csv")[0]
    assert (first["EPSG"], first["std_x_m"]) == ("", "")
    note = json.loads((tmp_path / "cloud.csv.json").read_text())
    assert note["EPSG"] is None
    assert "without a place on earth" in note["crs"]


@pytest.mark.parametrize("unknown", [(2,), (0, 1), (1,), (0, 1, 2)])
def test_each_axis_has_its_sigma_where_it_is_known(tmp_path: Path, unknown: tuple[int, ...]):
    cloud = flown_cloud()
    std_m = np.tile([0.011, 0.012, 0.013], (cloud.num_points, 1))
    std_m[3:, list(unknown)] = np.nan
    write_csv_cloud(tmp_path / "cloud.csv", replace(cloud, std_m=std_m), UTM)
    table = rows(tmp_path / "cloud.csv")
    cells = np.array([[row[f"std_{axis}_m"] for axis in "xyz"] for row in table])
    assert cells[:3].tolist() == [["0.011", "0.012", "0.013"]] * 3
    for axis, text in enumerate(("0.011", "0.012", "0.013")):
        assert set(cells[3:, axis]) == {"" if axis in unknown else text}
    np.testing.assert_array_equal(read_csv_cloud(tmp_path / "cloud.csv").cloud.std_m, std_m)


def test_cloud_without_points_is_refused(tmp_path: Path):
    cloud = flown_cloud()
    empty = replace(cloud, **{name: getattr(cloud, name)[:0] for name in vars(cloud)})
    with pytest.raises(JaxbaError, match=r"cloud\.csv: not written, the cloud has no points"):
        write_csv_cloud(tmp_path / "cloud.csv", empty, None)


def test_the_table_is_what_is_written(tmp_path: Path):
    cloud = replace(flown_cloud(), std_m=np.full((flown_cloud().num_points, 3), 0.0123))
    write_csv_cloud(tmp_path / "cloud.csv", cloud, UTM)
    written, table = pd.read_csv(tmp_path / "cloud.csv"), cloud_frame(cloud, UTM)
    assert list(table.columns) == list(written.columns) == list(CLOUD_COLUMNS)
    np.testing.assert_allclose(written.to_numpy(float), table.to_numpy(float), rtol=0, atol=0.0005 + 1e-9)
