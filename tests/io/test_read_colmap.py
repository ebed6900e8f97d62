"""COLMAP's text models read: a real one, jaxba's own, and broken ones."""

from pathlib import Path

import numpy as np
import pycolmap
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
        ({"images": ("11 21 -1", "11 21")}, r"images\.txt, line 3: damaged .*come in threes"),
        ({"images": ("10 20 7", "10 2o 7")}, r"images\.txt, line 3: damaged .*2o"),
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


TWO_IMAGES = "1 1 0 0 0 0 0 5 1 a.jpg\n10 20 7 11 21 8\n2 1 0 0 0 -1 0 5 1 b.jpg\n12 22 7 13 23 8\n"
TWO_POINTS = "7 1 2 3 255 0 9 0.5 1 0 2 0\n8 2 2 3 255 0 9 0.5 1 1 2 1\n"


def write_two(folder: Path, *, encoding: str = "utf-8", **files: str) -> None:
    given = {"cameras": CAMERAS, "images": TWO_IMAGES, "points3D": TWO_POINTS, **files}
    for name, text in given.items():
        (folder / f"{name}.txt").write_bytes(text.encode(encoding))


def poses(folder: Path) -> dict[str, list[float]]:
    """Return quaternion, scalar first, and translation of each image."""
    model = read_colmap_text(folder)
    return {
        name: [*rotation, *translation]
        for name, rotation, translation in zip(
            model.names, model.block.quaternion, model.block.translation_m, strict=True
        )
    }


@pytest.mark.parametrize(
    "images",
    [
        TWO_IMAGES,
        f"# header\n\n{TWO_IMAGES}\n\n",
        TWO_IMAGES.replace("2 1 0", "\n \t\n# words\n\n2 1 0"),
        TWO_IMAGES.replace("\n", "\r\n"),
        TWO_IMAGES.replace("\n2 1", "\n3 1 0 0 0 0 0 5 1 c.jpg\n\n\n2 1"),  # no keypoints, then a blank line
    ],
)
def test_blank_lines_are_passed_over_where_colmap_does_so(tmp_path: Path, images: str):
    write_two(tmp_path, images=images)
    peer = pycolmap.Reconstruction(str(tmp_path))
    model = read_colmap_text(tmp_path)
    assert model.names == tuple(peer.images[k].name for k in sorted(peer.images))
    seen = [(point.xy.tolist(), point.point3D_id) for k in sorted(peer.images) for point in peer.images[k].points2D]
    assert model.block.observation_xy_px.tolist() == [xy for xy, _ in seen]
    assert [7 + k for k in model.block.observation_point] == [point for _, point in seen]
    for name, pose in poses(tmp_path).items():
        (found,) = (image for image in peer.images.values() if image.name == name)
        x, y, z, w, *translation = found.cam_from_world().params
        assert pose == [w, x, y, z, *translation]


@pytest.mark.parametrize("encoding", ["utf-8-sig", "utf-16"])
def test_byte_order_marks_are_passed_over(tmp_path: Path, encoding: str):
    write_two(tmp_path, encoding=encoding)
    assert read_colmap_text(tmp_path).names == ("a.jpg", "b.jpg")


def test_a_point_twice_in_an_image_is_taken_where_its_track_says_so_and_images_that_were_taken_out_are_not_missed(
    tmp_path: Path,
):
    track = TWO_POINTS.replace("0.5 1 0 2 0", "0.5 1 0 2 0 1 1").replace("0.5 1 1 2 1", "0.5 2 1 5 0")
    write_two(tmp_path, images=TWO_IMAGES.replace("21 8", "21 7"), points3D=track)
    assert read_colmap_text(tmp_path).block.observation_point.tolist() == [0, 0, 0, 1]
    write_two(tmp_path, points3D="7 1 2 3 255 0 9 0.5\n8 2 2 3 255 0 9 0.5\n")  # no tracks, as some programs write it
    assert read_colmap_text(tmp_path).block.observation_point.tolist() == [0, 1, 0, 1]


@pytest.mark.parametrize(
    ("name", "old", "new", "message"),
    [
        ("images", "1 1 0 0 0 0", "1 0 0 0 0 0", r"images\.txt, line 1: image 1 has a quaternion of zeros"),
        ("images", "2 1 0 0 0 -1", "2 -0 0 0.0 0 -1", r"images\.txt, line 3: image 2 has a quaternion of zeros"),
        ("images", "1 1 0 0", "1 1 nan 0", r"images\.txt, line 1: damaged \(nan is not a finite"),
        ("images", "0 -1 0 5", "0 -1 inf 5", r"images\.txt, line 3: damaged \(inf is not a finite"),
        ("images", "10 20", "nan 20", r"images\.txt, line 2: damaged \(nan is not a finite"),
        ("images", "13 23", "13 -inf", r"images\.txt, line 4: damaged \(-inf is not a finite"),
        ("images", "\n2 1", "\n1 1", r"images\.txt, line 3: image 1 is in .*images\.txt, line 1 already"),
        (
            "images",
            "21 8",
            "21 7",
            r"images\.txt, line 1: image 1 sees point 7 twice, at keypoint 1, which",
        ),
        (
            "images",
            "11 21 8",
            "11 21 8 12 22 8",
            r"images\.txt, line 1: image 1 sees point 8 twice, at keypoint 2, which",
        ),
        ("images", "11 21 8", "11 21 8 12 22 -2", r"images\.txt, line 1: image 1 sees point -2, which points3D"),
        ("images", "b.jpg\n12 22 7 13 23 8", "b.jpg\n", r"has keypoint 0 of image 2, which has 0 \(.*line 3"),
        ("cameras", CAMERAS, CAMERAS * 2, r"cameras\.txt, line 2: camera 1 is in .*cameras\.txt, line 1 already"),
        ("cameras", "90 90", "90 nan", r"cameras\.txt, line 1: damaged \(nan is not a finite"),
        ("points3D", "8 2 2", "7 2 2", r"points3D\.txt, line 2: point 7 is in .*points3D\.txt, line 1 already"),
        ("points3D", "8 2 2", "8 nan 2", r"points3D\.txt, line 2: damaged \(nan is not a finite"),
        ("points3D", "7 1 2 3", "7 1 2 1e999", r"points3D\.txt, line 1: damaged \(1e999 is not a finite"),
        ("points3D", "255 0 9 0.5 1 0", "256 0 9 0.5 1 0", r"points3D\.txt, line 1: damaged"),
        ("points3D", "1 1 2 1", "1 1 2 7", r"line 2: the track of point 8 has keypoint 7 of image 2, which has 2"),
        ("points3D", "1 1 2 1", "1 1 2 -1", r"line 2: the track of point 8 has keypoint -1 of image 2, which has 2"),
        (
            "points3D",
            "1 1 2 1",
            "1 1 2 0",
            r"line 2: the track of point 8 has keypoint 0 of image 2, which is of point 7",
        ),
        ("points3D", "1 1 2 1", "1 1 2 1 2 1", r"line 2: the track of point 8 lists a keypoint twice"),
        (
            "points3D",
            "1 1 2 1",
            "1 1",
            r"images\.txt, line 3: image 2 sees point 8, at keypoint 1, which the point's tr",
        ),
        ("points3D", "1 1 2 1", "1 1 2", r"points3D\.txt, line 2: damaged"),
    ],
)
def test_numbers_and_ids_that_contradict_each_other_are_refused_by_line(
    tmp_path: Path, name: str, old: str, new: str, message: str
):
    whole = {"cameras": CAMERAS, "images": TWO_IMAGES, "points3D": TWO_POINTS}[name]
    assert old in whole
    write_two(tmp_path, **{name: whole.replace(old, new, 1)})
    with pytest.raises(JaxbaError, match=message):
        read_colmap_text(tmp_path)


def test_a_quaternion_of_any_length_is_one_of_unit_length(tmp_path: Path):
    write_two(tmp_path, images=TWO_IMAGES.replace("1 1 0 0 0", "1 3e300 0 0 4e300").replace("2 1 0", "2 5e-320 0"))
    assert poses(tmp_path)["a.jpg"][:4] == [0.6, 0, 0, 0.8] and poses(tmp_path)["b.jpg"][:4] == [1, 0, 0, 0]


RIGS = "# rigs\n1 2 CAMERA 1 CAMERA 2 1 0.6 0 0 0.8 -1 0 5\n"
FRAMES = "1 1 1 0 0 0 0 0 5 2 CAMERA 1 1 CAMERA 2 2\n"
RIGGED = {
    "cameras": CAMERAS + CAMERAS.replace("1 PIN", "2 PIN"),
    "images": TWO_IMAGES.replace("2 1 0 0 0 -1 0 5 1", "2 0.6 0 0 0.8 -1 0 10 2"),
    "rigs": RIGS,
    "frames": FRAMES,
}


def test_poses_that_follow_from_rigs_and_frames_are_read(tmp_path: Path):
    write_two(tmp_path, **RIGGED)
    assert poses(tmp_path)["b.jpg"] == pytest.approx([0.6, 0, 0, 0.8, -1, 0, 10])
    options = pycolmap.SyntheticDatasetOptions(num_rigs=2, num_cameras_per_rig=2, num_frames_per_rig=2, num_points3D=3)
    peer = pycolmap.synthesize_dataset(options)
    folder = tmp_path / "peer"
    folder.mkdir()
    peer.write_text(str(folder))
    found = poses(folder)
    assert len(found) == 8
    for image in peer.images.values():
        x, y, z, w, *translation = image.cam_from_world().params
        assert found[image.name] == pytest.approx([w, x, y, z, *translation])
    write_two(tmp_path, **(RIGGED | {"frames": "# none\n"}))  # then COLMAP takes the poses of images.txt
    assert poses(tmp_path)["b.jpg"] == pytest.approx([0.6, 0, 0, 0.8, -1, 0, 10])


@pytest.mark.parametrize(
    ("name", "old", "new", "message"),
    [
        ("frames", "0 0 5 2", "0 1 5 2", r"images\.txt, line 1: the pose of image 1 does not follow .*shifted by 1;"),
        (
            "images",
            "2 0.6 0 0 0.8",
            "2 1 0 0 0",
            r"line 3: the pose of image 2 does not follow .*turned by 106 degrees",
        ),
        ("rigs", "-1 0 5", "-1.5 0 5", r"line 3: the pose of image 2 does not follow .*shifted by 0\.5;"),
        (
            "rigs",
            "CAMERA 2 1 0.6 0 0 0.8 -1 0 5",
            "CAMERA 2 0",
            r"frames\.txt, line 1: camera 2 of image 2 has no place",
        ),
        ("rigs", " 1 0.6 0 0 0.8", " 1 0 0 0 0", r"rigs\.txt, line 2: damaged \(0 0 0 0 -1 0 5 is no quaternion"),
        ("rigs", "-1 0 5", "-1 0", r"rigs\.txt, line 2: damaged"),
        ("rigs", RIGS, RIGS + RIGS, r"rigs\.txt, line 4: rig 1 is in .*line 2 already"),
        ("frames", "1 1 1", "1 3 1", r"frames\.txt, line 1: frame 1 is of rig 3, which rigs\.txt lacks"),
        ("frames", "2 CAMERA 1 1 CAMERA 2 2", "1 CAMERA 1 1", r"images\.txt, line 3: image 2 is in no frame"),
        ("frames", "CAMERA 2 2", "CAMERA 1 2", r"images\.txt, line 3: image 2 has camera 2, and 1 in .*frames"),
        ("frames", "CAMERA 2 2", "CAMERA 2 1", r"images\.txt, line 1: image 1 has camera 1, and 2 in .*frames"),
        ("frames", "CAMERA 2 2", "CAMERA 2", r"frames\.txt, line 1: damaged"),
    ],
)
def test_poses_that_do_not_follow_from_rigs_and_frames_are_refused(
    tmp_path: Path, name: str, old: str, new: str, message: str
):
    assert old in RIGGED[name]
    write_two(tmp_path, **(RIGGED | {name: RIGGED[name].replace(old, new, 1)}))
    with pytest.raises(JaxbaError, match=message):
        read_colmap_text(tmp_path)


@pytest.mark.parametrize(("there", "missing"), [("rigs", "frames"), ("frames", "rigs")])
def test_rigs_without_frames_are_refused(tmp_path: Path, there: str, missing: str):
    write_two(tmp_path, **{there: RIGGED[there]})
    with pytest.raises(JaxbaError, match=rf"{missing}\.txt: no such file beside {there}\.txt"):
        read_colmap_text(tmp_path)


def test_missing_file_is_named(tmp_path: Path):
    with pytest.raises(JaxbaError, match=r"cameras\.txt: no such file"):
        read_colmap_text(tmp_path)
