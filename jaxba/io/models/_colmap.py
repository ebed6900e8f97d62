"""Blocks as COLMAP's sparse models, binary and text: cameras, images, points3D.

The world is the block's (local east, north, up in metres where it has a place on earth), poses are `cam_from_world`
and pixels have the centre of the first one at (0.5, 0.5): all as in COLMAP, so nothing is converted, and a reader finds
the same reprojection errors. Text holds the shortest decimals that read back as the same float64.

`IMAGE_ID` is the photo's place in the list of photos, from 1; `CAMERA_ID` and `POINT3D_ID` are rows, from 1. A photo's
`POINTS2D` are its observations in the block's order. Text ends a name at its first space: spaces become `%20` there.

Format: COLMAP's documentation, "Output Format"; the binary one: `src/colmap/scene/reconstruction_io_binary.cc`.
"""

import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int

from jaxba._atomic import cannot_write, write_atomically
from jaxba._errors import JaxbaError
from jaxba.scene import Block

_MODEL_IDS = {
    "SIMPLE_PINHOLE": 0, "PINHOLE": 1, "SIMPLE_RADIAL": 2, "RADIAL": 3, "OPENCV": 4, "OPENCV_FISHEYE": 5,
    "FULL_OPENCV": 6,
}  # fmt: skip
_POINT2D = np.dtype([("x", "<f8"), ("y", "<f8"), ("point3d_id", "<u8")])
_POINT3D = np.dtype(
    [("id", "<u8"), ("xyz", "<f8", 3), ("rgb", "u1", 3), ("error", "<f8"), ("length", "<u8")]
)  # packed: 51 bytes
_TRACK = np.dtype([("image_id", "<u4"), ("point2d", "<u4")])
FILES = ("cameras", "images", "points3D")


def write_colmap_binary(
    folder: str | os.PathLike[str],
    block: Block,
    names: Sequence[str],
    size_px: Int[np.ndarray, "cameras 2"],
    error_px: Float[np.ndarray, " points"],
) -> None:
    """Write `cameras.bin`, `images.bin` and `points3D.bin` into a folder, which is made.

    - `names`: of the registered images. `size_px`: width and height of each camera's images.
    - `error_px`: mean reprojection error of each point.

    Raises:
        JaxbaError: a camera model that COLMAP has not; or a file cannot be written.
    """
    model = _model(block, names, size_px)
    cameras = [np.array([len(model.parameters)], "<u8").tobytes()]
    for row, (parameters, (width, height)) in enumerate(zip(model.parameters, size_px, strict=True)):
        cameras.append(np.array([row + 1, _MODEL_IDS[model.name]], "<i4").tobytes())
        cameras.append(np.array([width, height], "<u8").tobytes() + parameters.astype("<f8").tobytes())
    images = [np.array([block.num_images], "<u8").tobytes()]
    poses = np.concatenate([block.quaternion, block.translation_m], axis=1).astype("<f8")
    points2d = np.empty(block.num_observations, _POINT2D)
    points2d["x"], points2d["y"] = block.observation_xy_px[model.by_image].T
    points2d["point3d_id"] = block.observation_point[model.by_image] + 1
    for row, name in enumerate(names):
        first, last = model.image_offsets[row : row + 2]
        images.append(np.array([model.image_id[row]], "<u4").tobytes() + poses[row].tobytes())
        images.append(np.array([block.camera_index[row] + 1], "<u4").tobytes() + name.encode() + b"\0")
        images.append(np.array([last - first], "<u8").tobytes() + points2d[first:last].tobytes())
    points = np.array([block.num_points], "<u8").tobytes() + _points3d(block, model, error_px)
    for file_name, content in zip(FILES, (b"".join(cameras), b"".join(images), points), strict=True):
        _write(folder, f"{file_name}.bin", content)


def write_colmap_text(
    folder: str | os.PathLike[str],
    block: Block,
    names: Sequence[str],
    size_px: Int[np.ndarray, "cameras 2"],
    error_px: Float[np.ndarray, " points"],
) -> None:
    """Write `cameras.txt`, `images.txt` and `points3D.txt` into a folder, which is made; arguments: see above.

    Raises:
        JaxbaError: a camera model that COLMAP has not, a photo's name that text cannot hold; or a file cannot be
            written.
    """
    model = _model(block, names, size_px)
    num_images, num_points = block.num_images, block.num_points
    cameras = [
        "# Camera list with one line of data per camera:\n#   CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]\n"
        f"# Number of cameras: {len(model.parameters)}\n"
    ]
    for row, (parameters, (width, height)) in enumerate(zip(model.parameters, size_px, strict=True)):
        cameras.append(f"{row + 1} {model.name} {width} {height} {_numbers(parameters)}\n")
    images = [
        "# Image list with two lines of data per image:\n"
        "#   IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME\n#   POINTS2D[] as (X, Y, POINT3D_ID)\n"
        f"# Number of images: {num_images}, mean observations per image: {block.num_observations / num_images!r}\n"
    ]
    xy, point_id = block.observation_xy_px[model.by_image].tolist(), block.observation_point[model.by_image].tolist()
    seen = [f"{x!r} {y!r} {point + 1}" for (x, y), point in zip(xy, point_id, strict=True)]
    for row, name in enumerate(names):
        pose = _numbers(np.concatenate([block.quaternion[row], block.translation_m[row]]))
        first, last = model.image_offsets[row : row + 2]
        images.append(f"{model.image_id[row]} {pose} {block.camera_index[row] + 1} {text_name(name)}\n")
        images.append(" ".join(seen[first:last]) + "\n")
    points = [
        "# 3D point list with one line of data per point:\n"
        "#   POINT3D_ID, X, Y, Z, R, G, B, ERROR, TRACK[] as (IMAGE_ID, POINT2D_IDX)\n"
        f"# Number of points: {num_points}, mean track length: {block.num_observations / max(num_points, 1)!r}\n"
    ]
    track = [f"{image} {index}" for image, index in zip(model.track_image.tolist(), model.track_index, strict=True)]
    columns = block.points_m.tolist(), block.rgb.tolist(), np.asarray(error_px, float).tolist()
    for row, (xyz, rgb, error) in enumerate(zip(*columns, strict=True)):
        first, last = model.point_offsets[row : row + 2]
        point = f"{row + 1} {_numbers(xyz)} {rgb[0]} {rgb[1]} {rgb[2]} {error!r}"
        points.append(f"{point} {' '.join(track[first:last])}\n")
    for file_name, lines in zip(FILES, (cameras, images, points), strict=True):
        _write(folder, f"{file_name}.txt", "".join(lines).encode())


@dataclass(frozen=True, eq=False)
class _Model:
    """A block in COLMAP's order.

    - `by_image`: observations sorted by image; those of image k are `image_offsets[k]:image_offsets[k + 1]`.
    - `track_image`, `track_index`: image id and place in its POINTS2D of each observation, sorted by point; those of
      point k are `point_offsets[k]:point_offsets[k + 1]`.
    """

    name: str
    parameters: Float[np.ndarray, "cameras parameters"]
    image_id: Int[np.ndarray, " images"]
    by_image: Int[np.ndarray, " observations"]
    image_offsets: list[int]
    track_image: Int[np.ndarray, " observations"]
    track_index: Int[np.ndarray, " observations"]
    point_offsets: list[int]


def _model(block: Block, names: Sequence[str], size_px: Int[np.ndarray, "cameras 2"]) -> _Model:
    for name in names:
        if "\n" in name or "\0" in name:
            raise JaxbaError(f"{name!r}: COLMAP's files cannot hold this name of a photo; rename it.")
    name, parameters = colmap_camera(block.camera_model, block.camera_parameters)
    by_image = np.argsort(block.observation_image, kind="stable")
    image_offsets = _offsets(block.observation_image, block.num_images)
    place = np.empty(block.num_observations, np.int64)
    place[by_image] = np.arange(block.num_observations) - image_offsets[block.observation_image[by_image]]
    by_point = np.argsort(block.observation_point, kind="stable")
    image_id = block.image_index.astype(np.int64) + 1
    return _Model(
        name,
        parameters,
        image_id,
        by_image,
        image_offsets.tolist(),
        image_id[block.observation_image[by_point]],
        place[by_point],
        _offsets(block.observation_point, block.num_points).tolist(),
    )


def colmap_camera(
    model: str, parameters: Float[np.ndarray, "cameras parameters"]
) -> tuple[str, Float[np.ndarray, "cameras colmap_parameters"]]:
    """Return COLMAP's name of a camera model and its parameters in COLMAP's order.

    OpenCV's model with a third radial term is COLMAP's FULL_OPENCV with the other terms zero.

    >>> colmap_camera("OPENCV", np.array([[800.0, 800, 320, 240, 0.1, 0, 0, 0, 0.01]]))[0]
    'FULL_OPENCV'
    """
    if model == "OPENCV":
        if np.any(parameters[:, 8]):
            return "FULL_OPENCV", np.concatenate([parameters, np.zeros((len(parameters), 3))], axis=1)
        return "OPENCV", parameters[:, :8]
    if model not in _MODEL_IDS:
        raise JaxbaError(f"camera model {model}: COLMAP has none like it; choose one of {', '.join(_MODEL_IDS)}.")
    return model, parameters


def text_name(name: str) -> str:
    """Return a photo's name as the text model has it.

    >>> text_name("line 2/DJI_0001.JPG")
    'line%202/DJI_0001.JPG'
    """
    return name.replace(" ", "%20")


def _points3d(block: Block, model: _Model, error_px: Float[np.ndarray, " points"]) -> bytes:
    """Return the records of all points: 51 bytes of the point, then 8 bytes for each image that shows it."""
    head = np.empty(block.num_points, _POINT3D)
    head["id"] = np.arange(1, block.num_points + 1)
    head["xyz"], head["rgb"], head["error"] = block.points_m, block.rgb, error_px
    lengths = np.diff(model.point_offsets)
    head["length"] = lengths
    track = np.empty(block.num_observations, _TRACK)
    track["image_id"], track["point2d"] = model.track_image, model.track_index
    out = np.empty(head.nbytes + track.nbytes, np.uint8)
    starts = np.arange(block.num_points) * _POINT3D.itemsize + np.asarray(model.point_offsets)[:-1] * _TRACK.itemsize
    is_head = np.zeros(out.size, bool)
    is_head[(starts[:, None] + np.arange(_POINT3D.itemsize)).ravel()] = True
    out[is_head] = head.view(np.uint8).ravel()
    out[~is_head] = track.view(np.uint8).ravel()
    return out.tobytes()


def _offsets(index: Int[np.ndarray, " n"], count: int) -> Int[np.ndarray, " offsets"]:
    return np.concatenate([[0], np.cumsum(np.bincount(index, minlength=count))]).astype(np.int64)


def _numbers(values: Sequence[float] | np.ndarray) -> str:
    return " ".join(repr(float(value)) for value in values)


def _write(folder: str | os.PathLike[str], name: str, content: bytes) -> None:
    try:
        Path(folder).mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise cannot_write(folder, error) from error
    with write_atomically(Path(folder) / name) as file:
        file.write(content)
