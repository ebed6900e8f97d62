"""OpenSfM's reconstruction, projected again by the formulas of OpenSfM's documentation."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from blocks import MODELS, SIZE_PX, Flown, flown_block
from scipy.spatial.transform import Rotation

from jaxba._errors import JaxbaError
from jaxba.io import write_opensfm
from jaxba.scene import LocalFrame

FRAME = LocalFrame(
    latitude_deg=46.8, longitude_deg=-92.0, height_m=198.0, crs="EPSG:32615", epsg=32615, crs_name="", unit="metre",
    height_note="",
)  # fmt: skip
NAN = np.full((6, 3), np.nan)


def written(folder: Path, flown: Flown, frame: LocalFrame | None = FRAME) -> dict:
    write_opensfm(folder / "reconstruction.json", flown.block, flown.registered, frame, NAN, NAN)
    (content,) = json.loads((folder / "reconstruction.json").read_text(encoding="utf-8"))
    return content


def opensfm_pixel(camera: dict, in_cam: np.ndarray) -> np.ndarray:
    """Normalised coordinates by "Geometric Models", then pixels with their origin in the first pixel's centre."""
    x, y, z = in_cam
    if camera["projection_type"] == "brown":
        x_n, y_n = x / z, y / z
        r2 = x_n**2 + y_n**2
        d_r = 1 + camera["k1"] * r2 + camera["k2"] * r2**2 + camera["k3"] * r2**3
        d_x = 2 * camera["p1"] * x_n * y_n + camera["p2"] * (r2 + 2 * x_n**2)
        d_y = 2 * camera["p2"] * x_n * y_n + camera["p1"] * (r2 + 2 * y_n**2)
        u = camera["focal_x"] * (d_r * x_n + d_x) + camera["c_x"]
        v = camera["focal_y"] * (d_r * y_n + d_y) + camera["c_y"]
    else:
        assert camera["projection_type"] == "fisheye_opencv"
        r = np.hypot(x, y)
        theta = np.arctan2(r, z)
        d = 1 + sum(camera[f"k{i}"] * theta ** (2 * i) for i in (1, 2, 3, 4))
        u = camera["focal_x"] * d * theta * x / r + camera["c_x"]
        v = camera["focal_y"] * d * theta * y / r + camera["c_y"]
    width, height = camera["width"], camera["height"]
    side = max(width, height)
    return np.array([side * u + (width - 1) / 2, side * v + (height - 1) / 2])


@pytest.mark.parametrize("model", MODELS)
def test_reprojection_errors_are_the_same(tmp_path: Path, model: str):
    flown = flown_block(model)
    content, block = written(tmp_path, flown), flown.block
    shots, cameras, points = content["shots"], content["cameras"], content["points"]
    found = []
    for image, point, xy in zip(block.observation_image, block.observation_point, block.observation_xy_px, strict=True):
        shot = shots[flown.registered[image].name]
        in_cam = Rotation.from_rotvec(shot["rotation"]).apply(points[str(point + 1)]["coordinates"])
        pixel = opensfm_pixel(cameras[shot["camera"]], in_cam + shot["translation"])
        found.append(np.linalg.norm(pixel + 0.5 - xy))
    # 1e-9: coordinates of some 1000 px, rounding of dozens of operations
    np.testing.assert_allclose(found, flown.error_px, rtol=0, atol=1e-9)


def test_keys_are_those_of_a_reconstruction_that_opensfm_wrote(tmp_path: Path, data_dir: Path):
    path = data_dir / "opensfm" / "berlin" / "reconstruction_example.json"
    (theirs,) = json.loads(path.read_text())
    ours = written(tmp_path, flown_block())
    assert set(ours) == {"cameras", "shots", "points", "reference_lla"} <= set(theirs)
    assert set(ours["reference_lla"]) == set(theirs["reference_lla"])
    shot, their_shot = (next(iter(content["shots"].values())) for content in (ours, theirs))
    assert set(shot) <= set(their_shot)
    point, their_point = (next(iter(content["points"].values())) for content in (ours, theirs))
    assert set(point) == set(their_point)
    assert all(isinstance(c, float) for c in point["color"])


def test_origin_sizes_and_colours_are_those_of_the_block(tmp_path: Path):
    flown = flown_block()
    content = written(tmp_path, flown)
    assert content["reference_lla"] == {"latitude": 46.8, "longitude": -92.0, "altitude": 198.0}
    assert {(c["width"], c["height"]) for c in content["cameras"].values()} == {SIZE_PX}
    assert set(content["cameras"]) == {"left", "right"}
    assert content["points"]["7"]["color"] == flown.block.rgb[6].tolist()
    assert "reference_lla" not in written(tmp_path, flown, frame=None)


def test_measured_position_is_the_shot_s(tmp_path: Path):
    flown = flown_block()
    gnss = NAN.copy()
    gnss[1] = 1, 2, 3
    path = tmp_path / "reconstruction.json"
    write_opensfm(path, flown.block, flown.registered, FRAME, gnss, np.full((6, 3), 1.5))
    shots = json.loads(path.read_text())[0]["shots"]
    assert [shot.get("gps_position") for shot in shots.values()] == [None, [1, 2, 3], None, None, None, None]
    assert [shot.get("gps_dop") for shot in shots.values()][1] == 1.5


def test_model_that_opensfm_has_not_is_refused(tmp_path: Path):
    flown = flown_block("SIMPLE_PINHOLE")
    block = replace(flown.block, camera_model="BAL")
    with pytest.raises(JaxbaError, match="camera model BAL: OpenSfM has none like it"):
        write_opensfm(tmp_path / "r.json", block, flown.registered, None, NAN, NAN)
