"""OpenSfM's reconstructions read: the published one, jaxba's own, every kind of camera, and broken ones."""

import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from blocks import SIZE_PX, flown_block, project
from scipy.spatial.transform import Rotation

from jaxba._errors import JaxbaError
from jaxba.io import read_opensfm, read_reconstruction, write_opensfm
from jaxba.scene import Reconstruction

WIDTH, HEIGHT = 1200, 900


def pixels(found: Reconstruction) -> np.ndarray:
    """Pixels that a reconstruction's points have in their images, by the published formulas."""
    block = found.block
    rotation = Rotation.from_quat(block.quaternion, scalar_first=True)[block.observation_image]
    in_cam = rotation.apply(block.points_m[block.observation_point]) + block.translation_m[block.observation_image]
    return project(block.camera_model, block.camera_parameters[block.camera_index[block.observation_image]], in_cam)


def test_published_reconstruction_has_the_residuals_of_opensfm(data_dir: Path):
    """OpenSfM: u = focal (1 + k1 r^2 + k2 r^4) x / z in units of the longer side, minus x and y of the tracks."""
    folder = data_dir / "opensfm" / "berlin"
    found = read_opensfm(folder)
    block = found.block
    assert (block.num_images, block.num_points, block.num_observations) == (3, 1430, 3082)
    (content,) = json.loads((folder / "reconstruction_example.json").read_text())
    expected = {}
    for line in (folder / "tracks_example.csv").read_text().splitlines()[1:]:
        image, track, _, x, y, *_ = line.split("\t")
        if image not in content["shots"] or track not in content["points"]:
            continue
        shot = content["shots"][image]
        camera = content["cameras"][shot["camera"]]
        turn, _ = cv2.Rodrigues(np.array(shot["rotation"]))
        point = turn @ content["points"][track]["coordinates"] + shot["translation"]
        plane = point[:2] / point[2]
        r2 = plane @ plane
        off = camera["focal"] * (1 + r2 * (camera["k1"] + camera["k2"] * r2)) * plane - [float(x), float(y)]
        expected[image, track] = off
    off = (pixels(found) - block.observation_xy_px) / found.unit_px[block.observation_image, None]
    names = [found.names[k] for k in block.observation_image]
    ids = [found.point_ids[k] for k in block.observation_point]
    assert len(expected) == 3082
    for name, point, mine in zip(names, ids, off, strict=True):
        assert mine == pytest.approx(expected[name, point], abs=1e-12)


def small(kind: dict[str, Any], **fields: Any) -> dict[str, Any]:
    camera = {"width": WIDTH, "height": HEIGHT, **kind}
    shots = {
        name: {"rotation": [0.1 * k, 0.02, 0.3], "translation": [0.5 * k, 0, 5], "camera": "one"}
        for k, name in enumerate(("a b.jpg", "b.jpg"))
    }
    points = {str(k): {"coordinates": [k - 1.0, 0.5 * k, 0.1], "color": [1.0, 2, 300]} for k in range(3)}
    return {"cameras": {"one": camera}, "shots": shots, "points": points} | fields


TRACKS = "OPENSFM_TRACKS_VERSION_v2\n" + "".join(
    f"{name}\t{k}\t{k}\t0.0{k}\t-0.1\t0.001\t1\t2\t3\t-1\t-1\n"
    for name in ("a b.jpg", "b.jpg", "c.jpg")
    for k in range(4)
)


def written(folder: Path, content: Any, tracks: str = TRACKS) -> Path:
    (folder / "reconstruction.json").write_text(json.dumps(content))
    (folder / "tracks.csv").write_text(tracks)
    return folder


PERSPECTIVE = {"projection_type": "perspective", "focal": 0.8, "k1": -0.1, "k2": 0.02}
LENS = {"focal_x": 0.8, "focal_y": 0.81, "c_x": 0.01, "c_y": -0.02, "k1": -0.1}
BROWN = {"projection_type": "brown", **LENS, "k2": 0.02, "p1": 0.001, "p2": -0.002, "k3": 0.003}
FISHEYE = {"projection_type": "fisheye_opencv", **LENS, "k2": 0.02, "k3": 0.001, "k4": -0.002}
KINDS = {
    "perspective": (PERSPECTIVE, [-0.1, 0.02, 0, 0, 0]),
    "brown": (BROWN, [-0.1, 0.02, 0.001, -0.002, 0.003]),
    "radial": ({"projection_type": "radial", **LENS, "k2": 0.02}, [-0.1, 0.02, 0, 0, 0]),
    "simple_radial": ({"projection_type": "simple_radial", **LENS}, [-0.1, 0, 0, 0, 0]),
    "fisheye_opencv": (FISHEYE, [-0.1, 0.02, 0.001, -0.002]),
    "fisheye": ({"projection_type": "fisheye", "focal": 0.8, "k1": -0.1, "k2": 0.02}, [-0.1, 0.02, 0, 0]),
}


@pytest.mark.parametrize("kind", KINDS)
def test_each_kind_of_camera_projects_as_opencv_does_with_its_coefficients(tmp_path: Path, kind: str):
    camera, distortion = KINDS[kind]
    found = read_reconstruction(written(tmp_path, small(camera)))
    block = found.block
    fx, fy = (WIDTH * camera.get(key, camera.get("focal", 0)) for key in ("focal_x", "focal_y"))
    cx, cy = (WIDTH * camera.get(key, 0) for key in ("c_x", "c_y"))
    matrix = np.array([[fx, 0, cx + WIDTH / 2], [0, fy, cy + HEIGHT / 2], [0, 0, 1]])
    rotation = Rotation.from_quat(block.quaternion, scalar_first=True)[block.observation_image]
    in_cam = rotation.apply(block.points_m[block.observation_point]) + block.translation_m[block.observation_image]
    zero = np.zeros(3)
    if "fisheye" in kind:
        expected, _ = cv2.fisheye.projectPoints(in_cam[:, None], zero, zero, matrix, np.array(distortion, float))
    else:
        expected, _ = cv2.projectPoints(in_cam[:, None], zero, zero, matrix, np.array(distortion, float))
    np.testing.assert_allclose(pixels(found), expected[:, 0], rtol=0, atol=1e-9)
    assert found.names == ("a b.jpg", "b.jpg")  # c.jpg is no shot, and track 3 no point
    assert block.num_observations == 6
    assert block.observation_xy_px[1].tolist() == [0.01 * WIDTH + WIDTH / 2, -0.1 * WIDTH + HEIGHT / 2]


def test_a_perspective_camera_beside_a_brown_one_is_one_of_its_model(tmp_path: Path):
    content = small(BROWN)
    content["cameras"]["two"] = {"width": WIDTH, "height": HEIGHT, **PERSPECTIVE}
    block = read_opensfm(written(tmp_path, content)).block
    assert block.camera_model == "OPENCV"
    assert block.camera_parameters[1].tolist() == [960, 960, 600, 450, -0.1, 0.02, 0, 0, 0]


def test_errors_that_older_versions_state_are_the_mean_length_of_each_point(tmp_path: Path):
    content = small(PERSPECTIVE)
    content["points"]["1"]["reprojection_errors"] = {"a b.jpg": [3e-4, 4e-4], "b.jpg": [0.0, 1e-3]}
    found = read_opensfm(written(tmp_path, content))
    assert found.point_error.tolist() == pytest.approx([np.nan, 7.5e-4, np.nan], nan_ok=True)
    assert (found.unit, found.unit_px.tolist()) == ("longer sides", [1200, 1200])


@pytest.mark.parametrize("version", [0, 1])
def test_older_tracks_are_read(tmp_path: Path, version: int):
    rows = [line.split("\t") for line in TRACKS.splitlines()[1:]]
    cut = [row[:9] if version else row[:5] + row[6:9] for row in rows]
    head = f"OPENSFM_TRACKS_VERSION_v{version}\n" if version else ""
    found = read_opensfm(written(tmp_path, small(PERSPECTIVE), head + "\n".join("\t".join(row) for row in cut)))
    assert found.block.num_observations == 6


def test_what_jaxba_writes_has_the_same_errors(tmp_path: Path):
    flown = flown_block("OPENCV with k3")
    block, side = flown.block, max(SIZE_PX)
    nothing = np.full((block.num_images, 3), np.nan)
    write_opensfm(tmp_path / "reconstruction.json", block, flown.registered, None, nothing, nothing)
    image, point = block.observation_image.tolist(), block.observation_point.tolist()
    normalised = ((block.observation_xy_px - np.array(SIZE_PX) / 2) / side).tolist()
    rows = [
        f"{flown.registered[i].name}\t{p + 1}\t0\t{x!r}\t{y!r}\t1\t0\t0\t0"
        for i, p, (x, y) in zip(image, point, normalised, strict=True)
    ]
    (tmp_path / "tracks.csv").write_text("OPENSFM_TRACKS_VERSION_v1\n" + "\n".join(rows), encoding="utf-8")
    found = read_opensfm(tmp_path)
    error = np.linalg.norm(pixels(found) - found.block.observation_xy_px, axis=1)
    mean = np.bincount(found.block.observation_point, error) / np.bincount(found.block.observation_point)
    np.testing.assert_allclose(mean, flown.point_error_px, rtol=0, atol=1e-9)  # points stand in the same order


def test_of_several_reconstructions_that_of_the_most_shots_is_taken_and_told(tmp_path: Path):
    one, two = small(PERSPECTIVE), small(PERSPECTIVE)
    del one["shots"]["b.jpg"]
    found = read_opensfm(written(tmp_path, [one, two]))
    assert len(found.names) == 2
    assert found.notes == ("reconstruction.json holds 2 reconstructions: that of 2 shots is taken, others have 1.",)


def broken(**change: Any) -> dict[str, Any]:
    return small(PERSPECTIVE, **change)


@pytest.mark.parametrize(
    ("content", "tracks", "message"),
    [
        (small({**PERSPECTIVE, "projection_type": "dual"}), TRACKS, r"json: camera one is of the kind 'dual', which"),
        (small({**PERSPECTIVE, "focal": None}), TRACKS, r"json: camera one has focal missing, where a finite number"),
        (small({**PERSPECTIVE, "focal": -1}), TRACKS, r"camera one has a focal length of -1, which is not above 0"),
        (small({**PERSPECTIVE, "k1": "x"}), TRACKS, r"camera one has k1 'x', where a finite number is needed"),
        (small({**PERSPECTIVE, "width": 0}), TRACKS, r"camera one is 0 x 900 pixels"),
        (broken(shots={}), TRACKS, r"json: shots is \{\}, where an object of shots by name"),
        (broken(points=[]), TRACKS, r"json: points is \[\], where an object"),
        (broken(shots={"a b.jpg": {"rotation": [0, 0], "translation": [0, 0, 1], "camera": "one"}}), TRACKS,
         r"json: shot a b\.jpg has rotation \[0, 0\], where 3 finite numbers"),
        (broken(shots={"a b.jpg": {"rotation": [0, 0, 0], "translation": [0, 0, 1], "camera": "two"}}), TRACKS,
         r"json: shot a b\.jpg has camera 'two', which its cameras lack"),
        (broken(points={"7": {"coordinates": [1, 2, 3]}}), TRACKS,
         r"tracks\.csv: no row of point 7 in the shots of reconstruction\.json \(1 of 1 points have none\)"),
        (broken(), TRACKS.replace("_v2", "_v9"), r"tracks\.csv, line 1: tracks of version '9'; jaxba reads"),
        (broken(), TRACKS.replace("\t-1\t-1\n", "\n", 1), r"line 2: 9 fields, where version 2 of the tracks has 11"),
        (broken(), TRACKS.replace("0.01", "nan", 1), r"tracks\.csv, line 3: x is 'nan', no image coordinate"),
        (broken(), TRACKS + TRACKS.splitlines()[1], r"tracks\.csv, line 14: track 0 has a b\.jpg in line 2 already"),
        ([], TRACKS, r"json: holds no list of reconstructions"),
    ],
)  # fmt: skip
def test_broken_files_are_named_with_field_and_value(tmp_path: Path, content: Any, tracks: str, message: str):
    with pytest.raises(JaxbaError, match=message):
        read_opensfm(written(tmp_path, content, tracks))


def test_missing_files_and_fisheyes_beside_others_are_named(tmp_path: Path):
    written(tmp_path, small(PERSPECTIVE))
    (tmp_path / "tracks.csv").unlink()
    with pytest.raises(JaxbaError, match=r"tracks\.csv: no such file; .* no tracks\*\.csv"):
        read_opensfm(tmp_path)
    (tmp_path / "reconstruction.json").write_text("[{")
    (tmp_path / "tracks.csv").write_text(TRACKS)
    with pytest.raises(JaxbaError, match=r"reconstruction\.json: is no JSON \(.*line 1 column"):
        read_opensfm(tmp_path)
    content = small(PERSPECTIVE)
    content["cameras"]["two"] = {"width": WIDTH, "height": HEIGHT, **FISHEYE}
    with pytest.raises(JaxbaError, match=r"camera two is fisheye_opencv and one is perspective; all cameras"):
        read_opensfm(written(tmp_path, content))
    with pytest.raises(JaxbaError, match=r"nowhere\.json: no such file"):
        read_reconstruction(tmp_path / "nowhere.json")
    (tmp_path / "empty").mkdir()
    with pytest.raises(JaxbaError, match=r"empty: holds neither a COLMAP model .* nor an OpenSfM"):
        read_reconstruction(tmp_path / "empty")
