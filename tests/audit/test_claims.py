"""What files state beside what their own numbers give, by each program's definition."""

import dataclasses
from pathlib import Path

import cv2
import numpy as np
import pycolmap
import pytest

from benchmarks.audits import clean, written
from jaxba.audit._claims import check_claims
from jaxba.audit._faults import of_claims
from jaxba.io import read_bal, read_reconstruction, write_tile
from jaxba.scene import Reconstruction

CAMERAS = {
    "SIMPLE_RADIAL": [1280, 512, 384, 0.05],
    "OPENCV": [1280, 1281, 512, 384, 0.05, 0.01, 1e-3, -1e-3],
    "OPENCV_FISHEYE": [900, 901, 512, 384, 0.05, 0.01, 0, 0],
    "PINHOLE": [1280, 1281, 510, 386],
}


def figures(given: Reconstruction) -> dict[str, tuple[float | None, float]]:
    return {figure.name: (figure.stated, figure.recomputed) for figure in check_claims(given).figures}


def test_lund_door_has_the_error_that_colmap_states(data_dir: Path):
    given = read_reconstruction(data_dir / "colmap" / "lund_door")
    claims, found = check_claims(given), figures(given)
    stated, recomputed = found["mean reprojection error"]
    assert stated == pytest.approx(0.3549616, abs=1e-6)
    # the text rounds poses to six digits, which is some thousandths of a pixel
    assert recomputed == pytest.approx(stated, abs=1e-4)
    assert np.abs(given.point_error - claims.point_error).max() < 0.005
    assert found["points"] == (11384, 11384) and found["images"] == (12, 12) and found["cameras"] == (1, 1)
    assert found["mean track length"] == (6.4412333099086441, 73327 / 11384)
    assert found["mean observations per image"] == (6110.583333333333, 73327 / 12)
    assert of_claims(given, claims) == []


@pytest.mark.parametrize(
    ("camera", "text"),
    [("SIMPLE_RADIAL", True), ("OPENCV", False), ("OPENCV_FISHEYE", False), ("PINHOLE", True), ("PINHOLE", False)],
)
def test_models_of_colmaps_own_making_have_the_errors_that_it_states(tmp_path: Path, camera: str, text: bool):
    options = pycolmap.SyntheticDatasetOptions(
        num_rigs=2, num_frames_per_rig=3, num_points3D=80, track_length=4, camera_params=CAMERAS[camera],
        camera_model_id=getattr(pycolmap.CameraModelId, camera),
    )  # fmt: skip
    model = pycolmap.synthesize_dataset(options)
    noise = pycolmap.SyntheticNoiseOptions(point2D_stddev=0.7, point3D_stddev=0.02)
    pycolmap.synthesize_noise(noise, model)
    model.update_point_3d_errors()
    given = read_reconstruction(written(tmp_path, model, text=text))
    claims = check_claims(given)
    stated, recomputed = figures(given)["mean reprojection error"]
    expected = model.compute_mean_reprojection_error()
    assert expected > 0.5
    assert (stated, recomputed) == pytest.approx((expected, expected), abs=1e-9)
    errors = [point.error for _, point in sorted(model.points3D.items())]
    np.testing.assert_allclose(claims.point_error, errors, rtol=0, atol=1e-9)
    assert of_claims(given, claims) == []


def test_berlin_has_the_mean_residual_of_opensfms_formula(data_dir: Path):
    """The same figure by OpenCV: residuals of the points' mean lengths in units of the longer side."""
    given = read_reconstruction(data_dir / "opensfm" / "berlin" / "reconstruction_example.json")
    block, side = given.block, 3264
    error = np.zeros(block.num_observations)
    f, cx, cy, k1, k2 = block.camera_parameters[0]
    matrix = np.array([[f, 0, cx], [0, f, cy], [0, 0, 1]])
    for k in range(block.num_images):
        mine = np.flatnonzero(block.observation_image == k)
        w, x, y, z = block.quaternion[k]
        turn = 2 * np.arctan2(np.linalg.norm([x, y, z]), w) * np.array([x, y, z]) / np.linalg.norm([x, y, z])
        points = block.points_m[block.observation_point[mine]]
        seen, _ = cv2.projectPoints(points, turn, block.translation_m[k], matrix, np.array([k1, k2, 0, 0]))
        error[mine] = np.linalg.norm(seen[:, 0] - block.observation_xy_px[mine], axis=1) / side
    mean = np.bincount(block.observation_point, error) / np.bincount(block.observation_point)
    found = figures(given)
    assert found["mean reprojection error"] == (None, pytest.approx(mean.mean(), rel=1e-9))
    assert found["mean residual"][1] == pytest.approx(error.mean(), rel=1e-9)
    assert found["mean residual in pixels"][1] == pytest.approx(side * error.mean(), rel=1e-9)
    assert found["mean reprojection error"][1] == pytest.approx(3.91852e-4, abs=1e-9)


@pytest.mark.parametrize(("name", "cost"), [("problem-21-11315", 4.413239e6), ("problem-49-7776", 8.509125e5)])
def test_bal_problems_have_their_published_cost(data_dir: Path, name: str, cost: float):
    given = read_reconstruction(data_dir / "bal" / f"{name}-pre.txt")
    assert figures(given)["cost"][1] == pytest.approx(cost, rel=1e-6)


def test_a_tile_of_a_bal_problem_has_its_cost(data_dir: Path, tmp_path: Path):
    path = data_dir / "bal" / "dubrovnik-3-7-pre.txt"
    write_tile(tmp_path / "tile.npz", read_bal(path))
    one, other = figures(read_reconstruction(path)), figures(read_reconstruction(tmp_path / "tile.npz"))
    assert one["cost"] == other["cost"]


def test_a_header_that_is_not_so_is_named_with_its_line(tmp_path: Path):
    written(tmp_path, clean(), text=True)
    path = tmp_path / "points3D.txt"
    said = "Number of points: 300, mean track length: 6"
    assert said in path.read_text()
    path.write_text(path.read_text().replace(said, "Number of points: 310, mean track length: 6.5"))
    given = read_reconstruction(tmp_path)
    found = {finding.figures["name"]: finding.figures for finding in of_claims(given, check_claims(given))}
    assert set(found) == {"points", "mean track length"}
    assert (found["points"]["stated"], found["points"]["recomputed"]) == (310, 300)
    assert found["mean track length"]["place"] == f"{path}, line 3"


def test_errors_that_are_of_another_state_of_the_model_are_named(tmp_path: Path):
    model = clean()
    written(tmp_path, model)
    given = read_reconstruction(tmp_path)
    assert of_claims(given, check_claims(given)) == []
    changed = given.point_error.copy()
    changed[7] += 0.3
    given = dataclasses.replace(given, point_error=changed)
    (finding,) = of_claims(given, check_claims(given))
    assert finding.kind == "point errors differ"
    figures_of = finding.figures
    assert (figures_of["count"], figures_of["num_stated"], figures_of["name"]) == (1, 300, given.point_ids[7])
    assert figures_of["stated"] - figures_of["recomputed"] == pytest.approx(0.3)


def test_points_behind_their_cameras_are_counted_by_image(tmp_path: Path):
    given = read_reconstruction(written(tmp_path, clean()))
    block = given.block
    points = block.points_m.copy()
    first = block.observation_image[np.flatnonzero(block.observation_point == 5)[0]]
    points[5] = 3 * block.centers_m[first] - 2 * points[5]
    given = dataclasses.replace(given, block=dataclasses.replace(block, points_m=points))
    claims = check_claims(given)
    (finding,) = [finding for finding in of_claims(given, claims) if finding.kind == "points behind"]
    assert given.names[first] in finding.figures["names"]
    assert finding.figures["points"] == 1
    assert finding.figures["count"] == claims.is_behind.sum() >= 1
