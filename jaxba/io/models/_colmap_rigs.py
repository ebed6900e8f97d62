"""Poses that follow from COLMAP's rigs and frames, held against those of its images.

COLMAP 3.12 and later keep the pose of a frame, `rig_from_world`, and where each camera sits on the rig,
`sensor_from_rig`. An image's pose is their product, and the one that images.txt or images.bin repeats is not read by
COLMAP: a model in which they differ would be another one here than there.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from jaxba._errors import JaxbaError
from jaxba.io.models._colmap_lines import Damage, claim, content_lines, finite, unit
from jaxba.io.models._colmap_model import ColmapImage

_TOLERANCE = 1e-5  # rad, and of a translation's length: texts of six digits round by a tenth of it
CAMERA = "CAMERA"


@dataclass(frozen=True, kw_only=True, eq=False)
class Transform:
    """A rotation, then a shift."""

    rotation: Rotation
    translation: Float[np.ndarray, "3"]

    def after(self, other: "Transform") -> "Transform":
        return Transform(
            rotation=self.rotation * other.rotation,
            translation=self.rotation.apply(other.translation) + self.translation,
        )


@dataclass(frozen=True, kw_only=True, eq=False)
class Frame:
    """A frame: `rig_from_world`, and its data as kind, CAMERA_ID and IMAGE_ID of each."""

    place: str
    frame_id: int
    rig_id: int
    pose: Transform
    data: list[tuple[str, int, int]]


@dataclass(frozen=True, kw_only=True, eq=False)
class Rigs:
    """Rigs and frames of a model.

    - `sensors`: sensor_from_rig of each camera of each rig; those that the file does not place are left out.
    - `name`: of the file that has them.
    """

    sensors: dict[int, dict[int, Transform]]
    frames: list[Frame]
    name: str
    frames_name: str


def rigs_files(folder: Path, ending: str) -> tuple[Path, Path] | None:
    """Return the files of rigs and frames of a model, txt or bin; None where it has neither.

    Raises `JaxbaError` where one of them is missing.
    """
    rigs_file, frames_file = folder / f"rigs.{ending}", folder / f"frames.{ending}"
    if not rigs_file.exists() and not frames_file.exists():
        return None
    for there, other in ((rigs_file, frames_file), (frames_file, rigs_file)):
        if not other.exists():
            raise JaxbaError(f"{other}: no such file beside {there.name}; export the model again.")
    return rigs_file, frames_file


def read_rigs_text(folder: Path) -> Rigs | None:
    """Return rigs and frames of a model; None where it has none, and COLMAP takes the poses of images.txt.

    Raises `JaxbaError` where one of the two files is missing or damaged, or an id stands twice.
    """
    files = rigs_files(folder, "txt")
    if files is None:
        return None
    rigs_file, frames_file = files
    if not any(content_lines(frames_file)):
        return None
    frames, places = [], {}
    rigs = _rigs(rigs_file)
    for place, line in content_lines(frames_file):
        with Damage(place):
            words = line.split()
            frame_id, rig_id, pose, count = int(words[0]), int(words[1]), _transform(words[2:9]), int(words[9])
            if len(words) != 10 + 3 * count:
                raise ValueError(f"{len(words) - 10} fields of {count} data, which come in threes")
            data = [(words[k], int(words[k + 1]), int(words[k + 2])) for k in range(10, len(words), 3)]
        claim(places, frame_id, place, "frame")
        frames.append(Frame(place=place, frame_id=frame_id, rig_id=rig_id, pose=pose, data=data))
    return Rigs(sensors=rigs, frames=frames, name=rigs_file.name, frames_name=frames_file.name)


def refuse_other_poses(rigs: Rigs | None, images: Sequence[ColmapImage]) -> None:
    """Raise where images have other poses than rigs and frames give them, or none by these.

    Raises:
        JaxbaError: an id is not there or stands twice, an image is in no frame or of another camera, a camera has no
            place on its rig, or a pose does not follow.
    """
    if rigs is None:
        return
    found: dict[int, tuple[str, int, Transform]] = {}
    places: dict[int, str] = {}
    for frame in rigs.frames:
        if frame.rig_id not in rigs.sensors:
            raise JaxbaError(
                f"{frame.place}: frame {frame.frame_id} is of rig {frame.rig_id}, which {rigs.name} lacks."
            )
        for kind, camera_id, image_id in frame.data:
            if kind != CAMERA:
                continue
            claim(places, image_id, frame.place, "image")
            sensor = rigs.sensors[frame.rig_id].get(camera_id)
            if sensor is None:
                raise JaxbaError(
                    f"{frame.place}: camera {camera_id} of image {image_id} has no place on rig {frame.rig_id} by "
                    f"{rigs.name}; export the model again."
                )
            found[image_id] = frame.place, camera_id, sensor.after(frame.pose)
    for image in images:
        place, image_id = image.place, image.image_id
        if image_id not in found:
            raise JaxbaError(f"{place}: image {image_id} is in no frame of {rigs.frames_name}; export the model again.")
        frame_place, frame_camera, expected = found[image_id]
        if frame_camera != image.camera_id:
            raise JaxbaError(
                f"{place}: image {image_id} has camera {image.camera_id}, and {frame_camera} in {frame_place}."
            )
        angle, shift = _difference(expected, image.pose)
        if angle > _TOLERANCE or shift > _TOLERANCE * (1 + float(np.abs(expected.translation).max())):
            raise JaxbaError(
                f"{place}: the pose of image {image_id} does not follow from {rigs.name} and {rigs.frames_name} "
                f"({frame_place}): it is turned by {np.degrees(angle):.3g} degrees and shifted by {shift:.3g}; export "
                "the model again."
            )


def _rigs(path: Path) -> dict[int, dict[int, Transform]]:
    """Return sensor_from_rig of each camera of each rig; those that the file does not place are left out."""
    rigs: dict[int, dict[int, Transform]] = {}
    places: dict[int, str] = {}
    for place, line in content_lines(path):
        with Damage(place):
            words = line.split()
            rig_id, count = int(words[0]), int(words[1])
            cameras = {}
            if count and words[2] == CAMERA:
                cameras[int(words[3])] = _transform(["1"] + 6 * ["0"])
            k = 4
            for _ in range(count - 1):
                kind, sensor_id, has_pose = words[k], int(words[k + 1]), int(words[k + 2])
                if has_pose and kind == CAMERA:
                    cameras[sensor_id] = _transform(words[k + 3 : k + 10])
                k += 10 if has_pose else 3
            if count and k != len(words):
                raise ValueError(f"{len(words)} fields where {count} sensors have {k}")
        claim(places, rig_id, place, "rig")
        rigs[rig_id] = cameras
    return rigs


def _transform(words: Sequence[str]) -> Transform:
    numbers = finite(words)
    if len(numbers) != 7 or not any(numbers[:4]):
        raise ValueError(f"{' '.join(words)} is no quaternion, not all zero, and translation")
    return transform_of(numbers)


def transform_of(numbers: Sequence[float]) -> Transform:
    """Return the transform of a quaternion, scalar first and not zero, and a translation."""
    return Transform(
        rotation=Rotation.from_quat(np.array(unit(numbers[:4])), scalar_first=True), translation=np.array(numbers[4:])
    )


def _difference(expected: Transform, pose: Sequence[float]) -> tuple[float, float]:
    """Return the angle, radians, and the distance between two poses."""
    rotation = Rotation.from_quat(np.array(unit(pose[:4])), scalar_first=True)
    angle = float((rotation * expected.rotation.inv()).magnitude())
    with np.errstate(over="ignore"):
        return angle, float(np.linalg.norm(np.array(pose[4:]) - expected.translation))
