"""COLMAP models as COLMAP's own library reads them."""

from pathlib import Path

import numpy as np
import pycolmap
import pytest
from blocks import MODELS, SIZE_PX, flown_block

from jaxba._errors import JaxbaError
from jaxba.io import write_colmap_binary, write_colmap_text

SIZES = np.array([SIZE_PX, SIZE_PX])
WRITERS = {"binary": write_colmap_binary, "text": write_colmap_text}


def write_and_read(folder: Path, model: str, kind: str) -> tuple:
    flown = flown_block(model)
    names = [photo.name for photo in flown.registered]
    WRITERS[kind](folder / kind, flown.block, names, SIZES, flown.point_error_px)
    return flown, pycolmap.Reconstruction(str(folder / kind))


def errors_px(model: pycolmap.Reconstruction) -> np.ndarray:
    """Reprojection errors as COLMAP projects, by image id, then by place in the image."""
    errors = []
    for _, image in sorted(model.images.items()):
        for point in image.points2D:
            projected = image.project_point(model.points3D[point.point3D_id].xyz)
            errors.append(np.linalg.norm(projected - point.xy))
    return np.array(errors)


def stored(name: str, kind: str) -> str:
    """Text ends a name at a space."""
    return name.replace(" ", "%20") if kind == "text" else name


@pytest.mark.parametrize("kind", WRITERS)
@pytest.mark.parametrize("camera", MODELS)
def test_pycolmap_finds_the_same_reprojection_errors(tmp_path: Path, camera: str, kind: str):
    flown, model = write_and_read(tmp_path, camera, kind)
    order = np.argsort(flown.block.observation_image, kind="stable")
    # 1e-9: coordinates of some 1000 px, rounding of dozens of operations
    np.testing.assert_allclose(errors_px(model), flown.error_px[order], rtol=0, atol=1e-9)
    assert model.compute_mean_reprojection_error() == pytest.approx(flown.point_error_px.mean(), abs=1e-9)


@pytest.mark.parametrize("kind", WRITERS)
def test_pycolmap_finds_all_that_the_block_holds(tmp_path: Path, kind: str):
    flown, model = write_and_read(tmp_path, "OPENCV with k3", kind)
    block = flown.block
    assert model.num_images() == 6
    assert model.num_cameras() == 2
    assert model.num_points3D() == block.num_points
    assert model.compute_num_observations() == block.num_observations
    for row, (image_id, image) in enumerate(sorted(model.images.items())):
        assert image_id == block.image_index[row] + 1
        assert image.name == stored(flown.registered[row].name, kind)
        assert image.camera_id == block.camera_index[row] + 1
        np.testing.assert_allclose(image.projection_center(), block.centers_m[row], atol=1e-10)
    for row, (point_id, point) in enumerate(sorted(model.points3D.items())):
        assert point_id == row + 1
        assert point.xyz.tolist() == block.points_m[row].tolist()
        assert point.color.tolist() == block.rgb[row].tolist()
        assert point.error == flown.point_error_px[row]
        seen = {(model.image(e.image_id).name, *model.image(e.image_id).points2D[e.point2D_idx].xy.tolist())
                for e in point.track.elements}  # fmt: skip
        mine = np.flatnonzero(block.observation_point == row)
        names = [stored(flown.registered[i].name, kind) for i in block.observation_image[mine]]
        assert seen == {(n, *xy) for n, xy in zip(names, block.observation_xy_px[mine].tolist(), strict=True)}


@pytest.mark.parametrize(
    ("camera", "name"), [("OPENCV", "OPENCV"), ("OPENCV with k3", "FULL_OPENCV"), ("SIMPLE_RADIAL", "SIMPLE_RADIAL")]
)
def test_camera_has_its_model_size_and_parameters(tmp_path: Path, camera: str, name: str):
    flown, model = write_and_read(tmp_path, camera, "binary")
    written = model.camera(2)
    assert written.model.name == name
    assert (written.width, written.height) == SIZE_PX
    count = min(len(written.params), flown.block.camera_parameters.shape[1])
    assert written.params[:count].tolist() == flown.block.camera_parameters[1, :count].tolist()
    assert not np.any(written.params[count:])


@pytest.mark.parametrize("kind", WRITERS)
def test_same_block_gives_the_same_bytes(tmp_path: Path, kind: str):
    for run in "ab":
        write_and_read(tmp_path / run, "OPENCV", kind)
    files = sorted(path.name for path in (tmp_path / "a" / kind).iterdir())
    assert len(files) == 3
    for name in files:
        assert (tmp_path / "a" / kind / name).read_bytes() == (tmp_path / "b" / kind / name).read_bytes()


@pytest.mark.parametrize("kind", WRITERS)
def test_real_model_keeps_its_reprojection_errors(data_dir: Path, tmp_path: Path, kind: str):
    """Block from a COLMAP model, written again: the errors are those that COLMAP finds in the original."""
    from dataclasses import replace

    original = pycolmap.Reconstruction(str(data_dir / "colmap" / "lund_door"))
    images = [image for _, image in sorted(original.images.items())]
    point_ids = sorted(original.points3D)
    row_of = {point_id: row for row, point_id in enumerate(point_ids)}
    seen = [(i, row_of[p.point3D_id], p.xy) for i, image in enumerate(images) for p in image.points2D
            if p.has_point3D()]  # fmt: skip
    points = [original.points3D[point_id] for point_id in point_ids]
    poses = [image.cam_from_world() for image in images]
    camera = original.camera(1)
    block = replace(
        flown_block().block,
        image_index=np.array([image.image_id - 1 for image in images]),
        quaternion=np.array([pose.rotation.quat[[3, 0, 1, 2]] for pose in poses]),
        translation_m=np.array([pose.translation for pose in poses]),
        camera_model=camera.model.name, camera_names=("door",), camera_parameters=camera.params[None],
        camera_index=np.zeros(len(images), np.int64), points_m=np.array([p.xyz for p in points]),
        track_index=np.arange(len(points)), rgb=np.array([p.color for p in points]),
        observation_image=np.array([s[0] for s in seen]), observation_point=np.array([s[1] for s in seen]),
        observation_xy_px=np.array([s[2] for s in seen]), is_georeferenced=False, unregistered=(),
    )  # fmt: skip
    size = np.array([[camera.width, camera.height]])
    error = np.array([p.error for p in points])
    WRITERS[kind](tmp_path, block, [image.name for image in images], size, error)
    again = pycolmap.Reconstruction(str(tmp_path))
    original.update_point_3d_errors()
    again.update_point_3d_errors()
    expected = np.array([original.points3D[p].error for p in point_ids])
    # 1e-9: see above
    np.testing.assert_allclose([p.error for _, p in sorted(again.points3D.items())], expected, rtol=0, atol=1e-9)
    assert again.num_points3D() == 11384
    assert again.compute_mean_reprojection_error() == pytest.approx(0.355, abs=5e-4)


@pytest.mark.parametrize("kind", WRITERS)
def test_model_that_colmap_has_not_is_refused(tmp_path: Path, kind: str):
    from dataclasses import replace

    block = replace(flown_block("SIMPLE_PINHOLE").block, camera_model="BAL")
    with pytest.raises(JaxbaError, match="camera model BAL: COLMAP has none like it; choose one of SIMPLE_PINHOLE"):
        WRITERS[kind](tmp_path, block, ["a"] * 6, SIZES, np.zeros(block.num_points))
    with pytest.raises(JaxbaError, match="COLMAP's files cannot hold this name"):
        WRITERS[kind](tmp_path, flown_block().block, ["a\nb"] * 6, SIZES, np.zeros(block.num_points))


def test_folder_that_cannot_be_made_is_named(tmp_path: Path):
    (tmp_path / "file").touch()
    flown = flown_block()
    with pytest.raises(JaxbaError, match=r"file.* (cannot be made|not written)"):
        write_colmap_text(tmp_path / "file", flown.block, ["a"] * 6, SIZES, flown.point_error_px)
