"""COLMAP's binary models read, beside COLMAP's own library, and broken ones."""

import shutil
import struct
from pathlib import Path

import numpy as np
import pycolmap
import pytest
from blocks import MODELS, SIZE_PX, flown_block

from jaxba._errors import JaxbaError
from jaxba.io import read_colmap, read_colmap_binary, read_colmap_text, write_colmap_binary

FILES = ("cameras", "images", "points3D")


def synthesized(folder: Path, camera: str = "SIMPLE_RADIAL", *, cameras: int = 1) -> pycolmap.Reconstruction:
    """Write a model of COLMAP's own making with noise in its pixels, and keypoints without a point."""
    parameters = {
        "SIMPLE_RADIAL": [1280, 512, 384, 0.05],
        "PINHOLE": [1280, 1281, 512, 384],
        "OPENCV": [1280, 1281, 512, 384, 0.05, 0.01, 1e-3, -1e-3],
        "OPENCV_FISHEYE": [1280, 1281, 512, 384, 0.05, 0.01, 0, 0],
    }
    options = pycolmap.SyntheticDatasetOptions(
        num_rigs=2, num_cameras_per_rig=cameras, num_frames_per_rig=3, num_points3D=60, track_length=4,
        camera_model_id=getattr(pycolmap.CameraModelId, camera), camera_params=parameters[camera],
    )  # fmt: skip
    made = pycolmap.synthesize_dataset(options)
    pycolmap.synthesize_noise(pycolmap.SyntheticNoiseOptions(point2D_stddev=0.5, point3D_stddev=0.01), made)
    made.update_point_3d_errors()
    folder.mkdir(parents=True, exist_ok=True)
    made.write_binary(str(folder))
    return made


@pytest.mark.parametrize("camera", ["SIMPLE_RADIAL", "PINHOLE", "OPENCV", "OPENCV_FISHEYE"])
@pytest.mark.parametrize("cameras", [1, 2])
def test_all_that_pycolmap_wrote_is_read(tmp_path: Path, camera: str, cameras: int):
    peer = synthesized(tmp_path, camera, cameras=cameras)
    model = read_colmap(tmp_path)
    block = model.block
    assert block.camera_model == camera
    assert block.num_observations == peer.compute_num_observations() == 240
    assert model.point_ids == tuple(sorted(peer.points3D))
    images = [image for _, image in sorted(peer.images.items())]
    assert model.names == tuple(image.name for image in images)
    for row, image in enumerate(images):
        x, y, z, w, *translation = image.cam_from_world().params
        np.testing.assert_allclose(block.quaternion[row], [w, x, y, z], rtol=0, atol=1e-15)
        assert block.translation_m[row].tolist() == pytest.approx(translation, abs=1e-14)
        camera_id = int(block.camera_names[block.camera_index[row]])
        assert camera_id == image.camera_id
        parameters = peer.camera(camera_id).params
        assert block.camera_parameters[block.camera_index[row]][: len(parameters)].tolist() == parameters.tolist()
    points = [point for _, point in sorted(peer.points3D.items())]
    assert block.points_m.tolist() == [point.xyz.tolist() for point in points]
    assert model.error_px.tolist() == [point.error for point in points]
    seen = [(row, p.point3D_id, *p.xy) for row, image in enumerate(images) for p in image.points2D if p.has_point3D()]
    ids = np.array(model.point_ids)[block.observation_point]
    assert list(zip(block.observation_image, ids, *block.observation_xy_px.T, strict=True)) == seen


@pytest.mark.parametrize("camera", MODELS)
def test_what_jaxba_writes_reads_back_exactly(tmp_path: Path, camera: str):
    flown = flown_block(camera)
    names = [photo.name for photo in flown.registered]
    write_colmap_binary(tmp_path, flown.block, names, np.array([SIZE_PX] * 2), flown.point_error_px)
    model = read_colmap(tmp_path)
    assert model.names == tuple(names)
    assert model.size_px.tolist() == [list(SIZE_PX)] * 2
    assert np.array_equal(model.error_px, flown.point_error_px)
    for name in ("image_index", "translation_m", "camera_parameters", "camera_index", "points_m", "rgb"):
        assert np.array_equal(getattr(model.block, name), getattr(flown.block, name)), name


def test_binary_is_read_where_both_forms_are_there_as_colmap_does(tmp_path: Path):
    made = synthesized(tmp_path)
    made.write_text(str(tmp_path))
    (tmp_path / "points3D.txt").write_text("nonsense")
    assert read_colmap(tmp_path).block.num_points == 60


def test_headers_of_a_text_are_its_claims(tmp_path: Path):
    made = synthesized(tmp_path / "binary")
    made.write_text(str(tmp_path))
    claims = {claim.name: claim.stated for claim in read_colmap(tmp_path).claims}
    assert claims == {
        "cameras": 2, "images": 6, "points": 60,
        "mean observations per image": made.compute_mean_observations_per_reg_image(),
        "mean track length": made.compute_mean_track_length(),
    }  # fmt: skip
    assert read_colmap(tmp_path / "binary").claims == ()


@pytest.mark.parametrize("name", [*FILES, "rigs", "frames"])
def test_a_file_cut_short_anywhere_is_named_with_the_record(tmp_path: Path, name: str):
    synthesized(tmp_path)
    path = tmp_path / f"{name}.bin"
    whole = path.read_bytes()
    for length in (3, 8 if name == "rigs" else 10, len(whole) // 2, len(whole) - 1):
        path.write_bytes(whole[:length])
        with pytest.raises(JaxbaError, match=rf"{name}\.bin, .*: truncated, [\d,]+ bytes are wanted at byte .*export"):
            read_colmap_binary(tmp_path)
    path.write_bytes(whole + b"\0")
    with pytest.raises(JaxbaError, match=rf"{name}\.bin: 1 bytes too many behind"):
        read_colmap_binary(tmp_path)


def changed(folder: Path, name: str, at: int, form: str, *values: float) -> None:
    data = bytearray((folder / f"{name}.bin").read_bytes())
    struct.pack_into(f"<{form}", data, at, *values)
    (folder / f"{name}.bin").write_bytes(bytes(data))


@pytest.mark.parametrize(
    ("name", "at", "form", "value", "message"),
    [
        ("cameras", 12, "i", 10, r"cameras\.bin, camera 1: camera model THIN_PRISM_FISHEYE; jaxba has"),
        ("cameras", 12, "i", 99, r"cameras\.bin, camera 1: camera model number 99; jaxba has"),
        ("cameras", 32, "d", np.nan, r"cameras\.bin, camera 1: its parameters hold nan"),
        ("images", 12, "d", np.inf, r"images\.bin, image 1: its pose hold inf"),
        ("images", 68, "I", 77, r"images\.bin, image 1: image \d has camera 77, which cameras\.bin lacks"),
        ("points3D", 16, "d", np.nan, r"points3D\.bin, point 1: its coordinates or error hold nan"),
        ("points3D", 59, "I", 99, r"images\.bin, image \d: image \d sees point \d+, at keypoint \d+, which"),
        ("points3D", 63, "I", 9999, r"points3D\.bin, point 1: the track of point \d+ has keypoint 9999 of image"),
        ("points3D", 8, "Q", 9999, r"images\.bin, image \d: image \d sees point \d+, which points3D\.bin lacks"),
        ("frames", 16, "d", 0.9, r"the pose of image \d does not follow from rigs\.bin and frames\.bin"),
    ],
)
def test_contradictions_and_bad_numbers_are_refused_by_record(
    tmp_path: Path, name: str, at: int, form: str, value: float, message: str
):
    synthesized(tmp_path)
    changed(tmp_path, name, at, form, value)
    with pytest.raises(JaxbaError, match=message):
        read_colmap_binary(tmp_path)


@pytest.mark.parametrize("ending", ["bin", "txt"])
@pytest.mark.parametrize("name", FILES)
def test_a_missing_file_of_the_three_is_named(tmp_path: Path, name: str, ending: str):
    synthesized(tmp_path / "all").write_text(str(tmp_path / "all"))
    for path in (tmp_path / "all").glob(f"*.{ending}"):
        shutil.copy(path, tmp_path)
    (tmp_path / f"{name}.{ending}").unlink()
    with pytest.raises(JaxbaError, match=rf"{name}\.{ending}: no such file beside \w+\.{ending}; a model has"):
        read_colmap(tmp_path)


def test_a_folder_that_is_no_model_is_named_with_what_one_holds(tmp_path: Path):
    with pytest.raises(JaxbaError, match=r"holds no COLMAP model, neither cameras\.bin.*sparse/0"):
        read_colmap(tmp_path)
    with pytest.raises(JaxbaError, match="no such folder"):
        read_colmap(tmp_path / "nowhere")


def test_real_text_model_written_as_binary_by_colmap_is_the_same(data_dir: Path, tmp_path: Path):
    folder = data_dir / "colmap" / "lund_door"
    pycolmap.Reconstruction(str(folder)).write_binary(str(tmp_path))
    text, binary = read_colmap_text(folder), read_colmap(tmp_path)
    assert np.array_equal(text.block.points_m, binary.block.points_m)
    assert np.array_equal(text.block.observation_xy_px, binary.block.observation_xy_px)
    assert np.array_equal(text.error_px, binary.error_px)
