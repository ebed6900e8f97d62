"""COLMAP's sparse models, text, as blocks: what `write_colmap_text` wrote, or COLMAP itself."""

import os
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int

from jaxba._errors import JaxbaError
from jaxba.io._read import read_bytes
from jaxba.scene import Block

_COUNTS = {
    "SIMPLE_PINHOLE": 3, "PINHOLE": 4, "SIMPLE_RADIAL": 4, "RADIAL": 5, "OPENCV": 8, "OPENCV_FISHEYE": 8,
    "FULL_OPENCV": 12,
}  # fmt: skip
_NO_POINT = -1


@dataclass(frozen=True, kw_only=True, eq=False)
class ColmapModel:
    """A model's block, its images by IMAGE_ID, its points by POINT3D_ID, and what a block does not hold.

    - `names`: of the images. `size_px`: width and height of each camera's. `error_px`: of each point as the file has
      it. `block.image_index` is IMAGE_ID - 1, `block.camera_names` the CAMERA_IDs; the world is any frame and scale.
    """

    block: Block
    names: tuple[str, ...]
    size_px: Int[np.ndarray, "cameras 2"]
    error_px: Float[np.ndarray, " points"]


def read_colmap_text(folder: str | os.PathLike[str]) -> ColmapModel:
    """Return the model in `cameras.txt`, `images.txt` and `points3D.txt`; keypoints without a point are passed over.

    Raises:
        JaxbaError: a file is missing or damaged, ids contradict each other, or cameras are of a model that jaxba has
            not, or of several.
    """
    path = Path(folder)
    model, camera_ids, parameters, size_px = _cameras(path / "cameras.txt")
    point_ids, points, rgb, error_px = _points(path / "points3D.txt")
    row_of_point = {point_id: row for row, point_id in enumerate(point_ids)}
    row_of_camera = {camera_id: row for row, camera_id in enumerate(camera_ids)}
    images = []
    for place, head, keypoints in _image_lines(path / "images.txt"):
        with _Damage(place):
            fields, numbers = head.split(maxsplit=9), keypoints.split()
            image_id, camera_id = int(fields[0]), int(fields[8])
            xy = np.array([numbers[0::3], numbers[1::3]], dtype=float).T.reshape(-1, 2)
            ids = [int(word) for word in numbers[2::3]]
        if camera_id not in row_of_camera:
            raise JaxbaError(f"{place}: image {image_id} has camera {camera_id}, which cameras.txt lacks.")
        seen = [k for k, point_id in enumerate(ids) if point_id != _NO_POINT]
        unknown = [ids[k] for k in seen if ids[k] not in row_of_point]
        if unknown:
            raise JaxbaError(f"{place}: image {image_id} sees point {unknown[0]}, which points3D.txt lacks.")
        rows = np.array([row_of_point[ids[k]] for k in seen], dtype=np.int64)
        images.append((image_id, fields[1:8], row_of_camera[camera_id], fields[9], xy[seen], rows))
    if not images:
        raise JaxbaError(f"{path / 'images.txt'}: holds no image; export the model again.")
    images.sort(key=lambda image: image[0])
    ids, poses, cameras, names, xy, rows = zip(*images, strict=True)
    pose = np.array(poses, dtype=float)
    block = Block(
        image_index=np.array(ids, dtype=np.int64) - 1,
        quaternion=pose[:, :4] / np.linalg.norm(pose[:, :4], axis=1, keepdims=True),
        translation_m=pose[:, 4:],
        camera_model=model,
        camera_names=tuple(str(camera_id) for camera_id in camera_ids),
        camera_parameters=parameters,
        camera_index=np.array(cameras, dtype=np.int64),
        points_m=points,
        track_index=np.arange(len(points)),
        rgb=rgb,
        observation_image=np.repeat(np.arange(len(ids)), [len(r) for r in rows]),
        observation_point=np.concatenate(rows),
        observation_xy_px=np.concatenate(xy),
        is_georeferenced=False,
    )
    return ColmapModel(block=block, names=names, size_px=size_px, error_px=error_px)


def _cameras(path: Path) -> tuple[str, list[int], Float[np.ndarray, "cameras n"], Int[np.ndarray, "cameras 2"]]:
    rows: dict[int, tuple[list[int], list[float]]] = {}
    models = set()
    for place, line in _lines(path):
        with _Damage(place):
            words = line.split()
            rows[int(words[0])] = [int(words[2]), int(words[3])], [float(word) for word in words[4:]]
            name = words[1]
        if name not in _COUNTS:
            raise JaxbaError(f"{place}: camera model {name}; jaxba has {', '.join(_COUNTS)}.")
        if len(words) != 4 + _COUNTS[name]:
            raise JaxbaError(f"{place}: {len(words) - 4} parameters, but {name} has {_COUNTS[name]}.")
        models.add(name)
    if len(models) != 1:
        found = ", ".join(sorted(models)) or "none"
        raise JaxbaError(f"{path}: cameras of one model are needed, it has {found}; convert them to one model.")
    ids, (model,) = sorted(rows), models
    parameters = np.array([rows[i][1] for i in ids])
    if model == "FULL_OPENCV":
        if np.any(parameters[:, 9:]):
            raise JaxbaError(f"{path}: FULL_OPENCV with k4, k5 or k6 other than 0 has no model here; refine without.")
        model, parameters = "OPENCV", parameters[:, :9]
    elif model == "OPENCV":
        parameters = np.pad(parameters, ((0, 0), (0, 1)))
    return model, ids, parameters, np.array([rows[i][0] for i in ids], dtype=np.int64)


def _points(path: Path) -> tuple[list[int], np.ndarray, np.ndarray, np.ndarray]:
    """Return ids in rising order, and coordinates, colours and errors by them."""
    rows = []
    for place, line in _lines(path):
        with _Damage(place):
            words = line.split(maxsplit=8)
            rgb = [int(word) for word in words[4:7]]
            rows.append((int(words[0]), [float(w) for w in words[1:4]], rgb, float(words[7])))
    if not rows:
        raise JaxbaError(f"{path}: holds no point; export the model again.")
    rows.sort(key=lambda row: row[0])
    ids, xyz, rgb, error = zip(*rows, strict=True)
    return list(ids), np.array(xyz), np.array(rgb).astype(np.uint8), np.array(error)


def _image_lines(path: Path) -> Iterator[tuple[str, str, str]]:
    """Yield the place, the first and the second line of each image, checked; the second may be empty."""
    lines = list(_lines(path, keep_empty=True))
    while lines and not lines[-1][1]:
        lines.pop()
    if len(lines) % 2:
        lines.append((lines[-1][0], ""))
    for (place, head), (_, keypoints) in zip(lines[0::2], lines[1::2], strict=True):
        with _Damage(place):
            fields = head.split(maxsplit=9)
            numbers = [float(word) for word in fields[:9]]
            count = len(keypoints.split())
            if len(fields) != 10 or count % 3 or not np.isfinite(numbers).all():
                raise ValueError(f"{len(fields)} fields of 10, {count} numbers of keypoints, which come in threes")
        yield place, head, keypoints


def _lines(path: Path, *, keep_empty: bool = False) -> Iterator[tuple[str, str]]:
    text = read_bytes(path).decode("utf-8", "replace")
    for number, line in enumerate(text.splitlines(), start=1):
        if not line.startswith("#") and (keep_empty or line.strip()):
            yield f"{path}, line {number}", line.strip()


class _Damage:
    """Turns what goes wrong with a line into an error that names it."""

    def __init__(self, place: str) -> None:
        self.place = place

    def __enter__(self) -> None:
        pass

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, _: object) -> None:
        if isinstance(error, ValueError | IndexError):
            raise JaxbaError(f"{self.place}: damaged ({error}); export the model again as text.") from error
