"""COLMAP's text models read: a real one, jaxba's own, and broken ones."""

from pathlib import Path

import numpy as np
import pytest
from blocks import MODELS, SIZE_PX, flown_block, project
from scipy.spatial.transform import Rotation

from jaxba._errors import JaxbaError
from jaxba.io import read_colmap_text, write_colmap_text


def test_real_model_has_its_published_figures(data_dir: Path):
    model = read_colmap_text(data_dir / "colmap" / "lund_door")
    block = model.block
    assert (block.num_images, block.num_points, block.num_observations) == (12, 11384, 73327)
    assert model.names[0] == "DSC_0001.JPG"
    assert model.size_px.tolist() == [[1296, 1936]]
    rotation = Rotation.from_quat(block.quaternion, scalar_first=True)[block.observation_image]
    in_cam = rotation.apply(block.points_m[block.observation_point]) + block.translation_m[block.observation_image]
    pixel = project("SIMPLE_RADIAL", block.camera_parameters[block.camera_index[block.observation_image]], in_cam)
    error = np.linalg.norm(pixel - block.observation_xy_px, axis=1)
    mean = np.bincount(block.observation_point, error) / np.bincount(block.observation_point)
    assert mean.mean() == pytest.approx(0.355, abs=5e-4)


@pytest.mark.parametrize("camera", MODELS)
def test_written_block_reads_back_exactly(tmp_path: Path, camera: str):
    flown = flown_block(camera)
    block = flown.block
    names = [photo.name.replace(" ", "_") for photo in flown.registered]
    write_colmap_text(tmp_path, block, names, np.array([SIZE_PX] * 2), flown.point_error_px)
    model = read_colmap_text(tmp_path)
    assert model.names == tuple(names)
    assert np.array_equal(model.error_px, flown.point_error_px)
    assert model.block.camera_model == block.camera_model
    for name in ("image_index", "translation_m", "camera_parameters", "camera_index", "points_m", "rgb"):
        assert np.array_equal(getattr(model.block, name), getattr(block, name)), name
    np.testing.assert_allclose(model.block.quaternion, block.quaternion, rtol=0, atol=1e-15)  # of unit length again
    order = np.argsort(block.observation_image, kind="stable")
    for name in ("observation_image", "observation_point", "observation_xy_px"):
        assert np.array_equal(getattr(model.block, name), getattr(block, name)[order]), name


CAMERAS = "1 PINHOLE 100 80 90 90 50 40\n"
IMAGES = "# header\n1 1 0 0 0 0 0 5 1 a b.jpg\n10 20 7 11 21 -1\n2 1 0 0 0 0 0 5 1 b.jpg\n\n"
POINTS = "7 1 2 3 255 0 9 0.5 1 0\n"


def write_model(folder: Path, **changes: tuple[str, str]) -> None:
    for name, text in (("cameras", CAMERAS), ("images", IMAGES), ("points3D", POINTS)):
        (folder / f"{name}.txt").write_text(text.replace(*changes.get(name, ("", ""))))


def test_keypoints_without_a_point_and_images_without_keypoints_are_passed_over(tmp_path: Path):
    write_model(tmp_path)
    model = read_colmap_text(tmp_path)
    assert model.names == ("a b.jpg", "b.jpg")
    assert model.block.observation_xy_px.tolist() == [[10, 20]]
    assert model.block.num_images == 2


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"cameras": ("PINHOLE", "THIN_PRISM_FISHEYE")}, r"cameras\.txt, line 1: camera model THIN_PRISM"),
        ({"cameras": (" 40\n", "\n")}, r"cameras\.txt, line 1: 3 parameters, but PINHOLE has 4"),
        ({"cameras": ("90 90", "90 x")}, r"cameras\.txt, line 1: damaged .*export the model again"),
        ({"cameras": ("40\n", "40\n2 SIMPLE_PINHOLE 100 80 90 50 40\n")}, "has PINHOLE, SIMPLE_PINHOLE; convert"),
        ({"cameras": (CAMERAS, "# none\n")}, "cameras of one model are needed, it has none"),
        ({"images": (" 5 1 a", " 5 3 a")}, r"images\.txt, line 2: image 1 has camera 3"),
        ({"images": ("20 7", "20 8")}, r"images\.txt, line 2: image 1 sees point 8, which points3D"),
        ({"images": ("11 21 -1", "11 21")}, r"images\.txt, line 2: damaged .*come in threes"),
        ({"images": ("10 20 7", "10 2o 7")}, r"images\.txt, line 2: damaged .*2o"),
        ({"images": (" a b.jpg", "")}, r"images\.txt, line 2: damaged \(9 fields of 10"),
        ({"images": (IMAGES, "# none\n")}, r"images\.txt: holds no image"),
        ({"points3D": ("255", "green")}, r"points3D\.txt, line 1: damaged"),
        ({"points3D": (POINTS, "7 1 2\n")}, r"points3D\.txt, line 1: damaged"),
        ({"points3D": (POINTS, "")}, r"points3D\.txt: is empty"),
    ],
)
def test_broken_model_is_named_with_its_place(tmp_path: Path, changes: dict, message: str):
    write_model(tmp_path, **changes)
    with pytest.raises(JaxbaError, match=message):
        read_colmap_text(tmp_path)


def test_missing_file_is_named(tmp_path: Path):
    with pytest.raises(JaxbaError, match=r"cameras\.txt: no such file"):
        read_colmap_text(tmp_path)
