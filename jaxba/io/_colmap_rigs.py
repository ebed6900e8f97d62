"""Poses that follow from COLMAP's rigs.txt and frames.txt, held against those of images.txt.

COLMAP 3.12 and later keep the pose of a frame, `rig_from_world`, and where each camera sits on the rig,
`sensor_from_rig`. An image's pose is their product, and the one that images.txt repeats is not read by COLMAP: a model
in which they differ would be another one here than there.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from jaxba._errors import JaxbaError
from jaxba.io._colmap_lines import Damage, claim, content_lines, finite, unit

_TOLERANCE = 1e-5  # rad, and of a translation's length: texts of six digits round by a tenth of it
_CAMERA = "CAMERA"


@dataclass(frozen=True, kw_only=True, eq=False)
class _Transform:
    rotation: Rotation
    translation: Float[np.ndarray, "3"]

    def after(self, other: "_Transform") -> "_Transform":
        return _Transform(
            rotation=self.rotation * other.rotation,
            translation=self.rotation.apply(other.translation) + self.translation,
        )


def refuse_other_poses(folder: Path, images: Sequence[tuple[str, int, int, list[float]]]) -> None:
    """Raise where the model has rigs and frames, and images have other poses, or none, by these.

    - `images`: place in images.txt, IMAGE_ID, CAMERA_ID, and quaternion with translation, of each.

    Raises:
        JaxbaError: one of the two files is missing or damaged, an id stands twice or is not there, an image is in no
            frame or of another camera, a camera has no place on its rig, or a pose does not follow.
    """
    rigs_file, frames_file = folder / "rigs.txt", folder / "frames.txt"
    if not rigs_file.exists() and not frames_file.exists():
        return
    for there, other in ((rigs_file, frames_file), (frames_file, rigs_file)):
        if not other.exists():
            raise JaxbaError(f"{other}: no such file beside {there.name}; export the model again.")
    if not any(content_lines(frames_file)):  # COLMAP then takes the poses of images.txt
        return
    rigs = _rigs(rigs_file)
    found: dict[int, tuple[str, int, _Transform]] = {}
    places: dict[int, str] = {}
    frame_places: dict[int, str] = {}
    for place, line in content_lines(frames_file):
        with Damage(place):
            words = line.split()
            frame_id, rig_id, pose, count = int(words[0]), int(words[1]), _transform(words[2:9]), int(words[9])
            if len(words) != 10 + 3 * count:
                raise ValueError(f"{len(words) - 10} fields of {count} data, which come in threes")
            data = [(words[k], int(words[k + 1]), int(words[k + 2])) for k in range(10, len(words), 3)]
        claim(frame_places, frame_id, place, "frame")
        if rig_id not in rigs:
            raise JaxbaError(f"{place}: frame {frame_id} is of rig {rig_id}, which rigs.txt lacks.")
        for kind, camera_id, image_id in data:
            if kind != _CAMERA:
                continue
            claim(places, image_id, place, "image")
            sensor = rigs[rig_id].get(camera_id)
            if sensor is None:
                raise JaxbaError(
                    f"{place}: camera {camera_id} of image {image_id} has no place on rig {rig_id} by rigs.txt; export "
                    "the model again."
                )
            found[image_id] = place, camera_id, sensor.after(pose)
    for place, image_id, camera_id, pose in images:
        if image_id not in found:
            raise JaxbaError(f"{place}: image {image_id} is in no frame of frames.txt; export the model again.")
        frame_place, frame_camera, expected = found[image_id]
        if frame_camera != camera_id:
            raise JaxbaError(f"{place}: image {image_id} has camera {camera_id}, and {frame_camera} in {frame_place}.")
        angle, shift = _difference(expected, pose)
        if angle > _TOLERANCE or shift > _TOLERANCE * (1 + float(np.abs(expected.translation).max())):
            raise JaxbaError(
                f"{place}: the pose of image {image_id} does not follow from rigs.txt and frames.txt ({frame_place}): "
                f"it is turned by {np.degrees(angle):.3g} degrees and shifted by {shift:.3g}; export the model again."
            )


def _rigs(path: Path) -> dict[int, dict[int, _Transform]]:
    """Return sensor_from_rig of each camera of each rig; those that the file does not place are left out."""
    rigs: dict[int, dict[int, _Transform]] = {}
    places: dict[int, str] = {}
    for place, line in content_lines(path):
        with Damage(place):
            words = line.split()
            rig_id, count = int(words[0]), int(words[1])
            cameras = {}
            if count and words[2] == _CAMERA:
                cameras[int(words[3])] = _transform(["1"] + 6 * ["0"])
            k = 4
            for _ in range(count - 1):
                kind, sensor_id, has_pose = words[k], int(words[k + 1]), int(words[k + 2])
                if has_pose and kind == _CAMERA:
                    cameras[sensor_id] = _transform(words[k + 3 : k + 10])
                k += 10 if has_pose else 3
            if count and k != len(words):
                raise ValueError(f"{len(words)} fields where {count} sensors have {k}")
        claim(places, rig_id, place, "rig")
        rigs[rig_id] = cameras
    return rigs


def _transform(words: Sequence[str]) -> _Transform:
    numbers = finite(words)
    if len(numbers) != 7 or not any(numbers[:4]):
        raise ValueError(f"{' '.join(words)} is no quaternion, not all zero, and translation")
    return _Transform(
        rotation=Rotation.from_quat(np.array(unit(numbers[:4])), scalar_first=True), translation=np.array(numbers[4:])
    )


def _difference(expected: _Transform, pose: Sequence[float]) -> tuple[float, float]:
    """Return the angle, radians, and the distance between two poses."""
    rotation = Rotation.from_quat(np.array(unit(pose[:4])), scalar_first=True)
    angle = float((rotation * expected.rotation.inv()).magnitude())
    with np.errstate(over="ignore"):
        return angle, float(np.linalg.norm(np.array(pose[4:]) - expected.translation))
