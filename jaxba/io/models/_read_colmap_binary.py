"""COLMAP's binary sparse models: cameras.bin, images.bin, points3D.bin, and rigs.bin and frames.bin where they are.

All numbers are little-endian. Each file begins with a count of its records, 8 bytes.

    camera      id i4, model i4, width u8, height u8, parameters f8 each
    image       id u4, quaternion wxyz and translation f8 (7), camera u4, name and a zero byte,
                count u8, then of each keypoint x f8, y f8, point u8 (all ones: none)
    point       id u8, xyz f8 (3), rgb u1 (3), error f8, count u8, then of each view image u4, keypoint u4
    rig         id u4, count u4, then of each sensor kind i4, id u4, and of all but the first
                whether its pose is there u1 and the pose f8 (7)
    frame       id u4, rig u4, pose f8 (7), count u4, then of each datum kind i4, sensor u4, image u8

(u8 is of 8 bytes.) Format: COLMAP's documentation, "Output Format"; `src/colmap/scene/reconstruction_io_binary.cc`.
"""

import math
import os
import struct
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from jaxba._errors import JaxbaError
from jaxba.io._read import read_bytes
from jaxba.io.models._colmap_lines import claim
from jaxba.io.models._colmap_model import (
    NO_POINT,
    PARAMETERS,
    ColmapCamera,
    ColmapFiles,
    ColmapImage,
    ColmapModel,
    ColmapPoint,
    check_image,
    check_one_model,
    model_of,
)
from jaxba.io.models._colmap_rigs import CAMERA, Frame, Rigs, Transform, refuse_other_poses, rigs_files, transform_of

_MODELS = (
    "SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "OPENCV_FISHEYE", "FULL_OPENCV", "FOV",
    "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE", "THIN_PRISM_FISHEYE", "RAD_TAN_THIN_PRISM_FISHEYE", "SIMPLE_DIVISION",
    "DIVISION",
)  # fmt: skip
_KEYPOINT = np.dtype([("xy", "<f8", 2), ("point_id", "<u8")])
_VIEW = np.dtype([("image_id", "<u4"), ("keypoint", "<u4")])
_NO_POINT = 2**64 - 1
_KIND_CAMERA = 0


class _Bytes:
    """The bytes of a file, read from front to back; `what`: the record that is read, for messages."""

    def __init__(self, path: Path) -> None:
        self.path, self.data, self.at, self.what = path, read_bytes(path), 0, "the count of its records"

    @property
    def place(self) -> str:
        return f"{self.path}, {self.what}"

    def take(self, form: str) -> tuple:
        """Return numbers as `struct` reads them."""
        form = f"<{form}"
        start = self._skip(struct.calcsize(form))
        return struct.unpack_from(form, self.data, start)

    def rows(self, dtype: np.dtype, count: int) -> np.ndarray:
        """Return as many records of a type."""
        return np.frombuffer(self.data, dtype, count, self._skip(count * dtype.itemsize))

    def text(self) -> str:
        """Return the text up to a zero byte."""
        end = self.data.find(b"\0", self.at)
        if end < 0:
            raise self.truncated(len(self.data) - self.at + 1)
        start = self._skip(end + 1 - self.at)
        return self.data[start:end].decode("utf-8", "replace")

    def end(self) -> None:
        """Raise where there are bytes left."""
        left = len(self.data) - self.at
        if left:
            raise JaxbaError(
                f"{self.path}: {left:,} bytes too many behind {self.what}; its count of records is wrong, or it is no "
                "binary file of COLMAP: export the model again."
            )

    def truncated(self, wanted: int) -> JaxbaError:
        return JaxbaError(
            f"{self.place}: truncated, {wanted:,} bytes are wanted at byte {self.at:,} of {len(self.data):,}; copy the "
            "file again, or export the model again."
        )

    def _skip(self, size: int) -> int:
        if self.at + size > len(self.data):
            raise self.truncated(size)
        self.at += size
        return self.at - size


def read_colmap_binary(folder: str | os.PathLike[str]) -> ColmapModel:
    """Return the model in `cameras.bin`, `images.bin` and `points3D.bin`, held to what `read_colmap_text` checks.

    Raises:
        JaxbaError: a file is missing, truncated or too long; and as `read_colmap_text` does.
    """
    files = ColmapFiles.of(Path(folder), "bin")
    cameras = _cameras(files.cameras)
    check_one_model(files.cameras, cameras)
    points, images = _points(files.points), _images(files.images, cameras)
    refuse_other_poses(_read_rigs(Path(folder)), images)
    return model_of(files, cameras, images, points)


def _cameras(path: Path) -> dict[int, ColmapCamera]:
    file, cameras = _Bytes(path), {}
    places: dict[int, str] = {}
    for number in range(1, file.take("Q")[0] + 1):
        file.what = f"camera {number}"
        camera_id, model, width, height = file.take("iiQQ")
        name = _MODELS[model] if 0 <= model < len(_MODELS) else f"number {model}"
        if name not in PARAMETERS:
            raise JaxbaError(f"{file.place}: camera model {name}; jaxba has {', '.join(PARAMETERS)}.")
        parameters = _finite(file, "parameters", file.take(f"{PARAMETERS[name]}d"))
        claim(places, camera_id, file.place, "camera")
        cameras[camera_id] = ColmapCamera(place=file.place, model=name, size_px=(width, height), parameters=parameters)
    file.end()
    return cameras


def _images(path: Path, cameras: Mapping[int, ColmapCamera]) -> list[ColmapImage]:
    file, images = _Bytes(path), []
    places: dict[int, str] = {}
    for number in range(1, file.take("Q")[0] + 1):
        file.what = f"image {number}"
        (image_id,) = file.take("I")
        pose = _finite(file, "pose", file.take("7d"))
        (camera_id,) = file.take("I")
        name = file.text()
        keypoints = file.rows(_KEYPOINT, file.take("Q")[0])
        _finite(file, "keypoints", keypoints["xy"].ravel())
        image = ColmapImage(
            place=file.place, image_id=image_id, pose=pose, camera_id=camera_id, name=name,
            xy_px=keypoints["xy"].tolist(),
            point_ids=[NO_POINT if of == _NO_POINT else of for of in keypoints["point_id"].tolist()],
        )  # fmt: skip
        claim(places, image_id, file.place, "image")
        check_image(image, cameras, "cameras.bin")
        images.append(image)
    file.end()
    return images


def _points(path: Path) -> list[ColmapPoint]:
    file, points = _Bytes(path), []
    places: dict[int, str] = {}
    for number in range(1, file.take("Q")[0] + 1):
        file.what = f"point {number}"
        point_id, x, y, z, red, green, blue, error, length = file.take("Q3d3BdQ")
        _finite(file, "coordinates or error", (x, y, z, error))
        track = file.rows(_VIEW, length)
        claim(places, point_id, file.place, "point")
        point = ColmapPoint(
            place=file.place, point_id=point_id, xyz=[x, y, z], rgb=[red, green, blue], error_px=error,
            track=list(zip(track["image_id"].tolist(), track["keypoint"].tolist(), strict=True)),
        )  # fmt: skip
        points.append(point)
    file.end()
    return points


def _read_rigs(folder: Path) -> Rigs | None:
    """Return rigs and frames of a model; None where it has none."""
    files = rigs_files(folder, "bin")
    if files is None:
        return None
    rigs, frames = _Bytes(files[0]), _Bytes(files[1])
    sensors: dict[int, dict[int, Transform]] = {}
    places: dict[int, str] = {}
    for number in range(1, rigs.take("Q")[0] + 1):
        rigs.what = f"rig {number}"
        rig_id, count = rigs.take("II")
        of_rig: dict[int, Transform] = {}
        for k in range(count):
            kind, sensor_id = rigs.take("iI")
            is_placed = k == 0 or rigs.take("B")[0] != 0
            pose = (1.0, *6 * [0.0]) if k == 0 else rigs.take("7d") if is_placed else ()
            if is_placed and kind == _KIND_CAMERA:
                of_rig[sensor_id] = _transform(rigs, pose)
        claim(places, rig_id, rigs.place, "rig")
        sensors[rig_id] = of_rig
    rigs.end()
    found: list[Frame] = []
    places = {}
    for number in range(1, frames.take("Q")[0] + 1):
        frames.what = f"frame {number}"
        frame_id, rig_id = frames.take("II")
        pose = _transform(frames, frames.take("7d"))
        data = [frames.take("iIQ") for _ in range(frames.take("I")[0])]
        claim(places, frame_id, frames.place, "frame")
        named = [(CAMERA if kind == _KIND_CAMERA else str(kind), sensor, datum) for kind, sensor, datum in data]
        found.append(Frame(place=frames.place, frame_id=frame_id, rig_id=rig_id, pose=pose, data=named))
    frames.end()
    if not found:
        return None
    return Rigs(sensors=sensors, frames=found, name=files[0].name, frames_name=files[1].name)


def _transform(file: _Bytes, numbers: tuple) -> Transform:
    values = _finite(file, "pose", numbers)
    if not any(values[:4]):
        raise JaxbaError(f"{file.place}: has a quaternion of zeros; export the model again.")
    return transform_of(values)


def _finite(file: _Bytes, what: str, numbers: tuple | np.ndarray) -> list[float]:
    """Return numbers as a list; raises `JaxbaError` for what is not finite."""
    values = list(numbers) if isinstance(numbers, tuple) else numbers.tolist()
    bad = next((value for value in values if not math.isfinite(value)), None)
    if bad is not None:
        raise JaxbaError(f"{file.place}: its {what} hold {bad}, which is not finite; export the model again.")
    return values
