"""PLY clouds as a reader sees them that knows nothing but the header."""

from pathlib import Path

import numpy as np
from blocks import flown_cloud

from jaxba.io import CrsText, write_ply

KINDS = {"double": "<f8", "float": "<f4", "uchar": "u1", "int": "<i4"}


def read_ply(path: Path) -> tuple[np.ndarray, list[str]]:
    head, _, body = path.read_bytes().partition(b"end_header\n")
    lines = head.decode("ascii").splitlines()
    assert lines[:2] == ["ply", "format binary_little_endian 1.0"]
    fields = [(line.split()[2], KINDS[line.split()[1]]) for line in lines if line.startswith("property")]
    count = next(int(line.split()[2]) for line in lines if line.startswith("element vertex"))
    vertices = np.frombuffer(body, np.dtype(fields))
    assert len(vertices) == count
    return vertices, [line for line in lines if line.startswith("comment")]


def test_points_come_back_exactly_with_colours_and_errors(tmp_path: Path):
    cloud = flown_cloud((565_000.0, 5_184_000.0, 210.0))
    crs = CrsText(text="EPSG:32615", name="WGS 84 / UTM zone 15N", unit="metre", height_unit="metre", height_note="")
    write_ply(tmp_path / "cloud.ply", cloud, crs)
    vertices, comments = read_ply(tmp_path / "cloud.ply")
    assert np.array_equal(np.stack([vertices[axis] for axis in "xyz"], 1), cloud.xyz)
    assert np.array_equal(np.stack([vertices[c] for c in ("red", "green", "blue")], 1), cloud.rgb)
    assert np.array_equal(vertices["error_px"], cloud.error_px.astype(np.float32))
    assert np.array_equal(vertices["point_id"], cloud.point_id)
    sigmas = np.stack([vertices[f"std_{axis}_m"] for axis in "xyz"], axis=1)
    np.testing.assert_array_equal(sigmas, cloud.std_m.astype(np.float32))
    assert comments == ["comment crs EPSG:32615 WGS 84 / UTM zone 15N; unit metre, of heights metre"]


def test_local_cloud_says_so_and_a_name_of_many_letters_stays_one_ascii_line(tmp_path: Path):
    write_ply(tmp_path / "cloud.ply", flown_cloud(), None)
    assert "without a place on earth" in read_ply(tmp_path / "cloud.ply")[1][0]
    crs = CrsText(text="PROJCRS", name="Gauß\nKrüger", unit="metre", height_unit="metre", height_note="")
    write_ply(tmp_path / "cloud.ply", flown_cloud(), crs)
    assert read_ply(tmp_path / "cloud.ply")[1] == ["comment crs Gau? Kr?ger; unit metre, of heights metre"]
