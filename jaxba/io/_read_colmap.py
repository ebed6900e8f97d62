"""COLMAP's sparse models, text, as blocks: what `write_colmap_text` wrote, or COLMAP itself.

The three files say much twice, and what they say is held against each other: a point's track lists the keypoints that
images.txt gives it, and where rigs.txt and frames.txt are there, as COLMAP 3.12 and later write them, the poses of
images.txt follow from theirs. Blank lines are passed over where COLMAP does so: anywhere but as an image's second line.
"""

import os
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int

from jaxba._errors import JaxbaError
from jaxba.io._colmap_lines import Damage, claim, content_lines, finite, unit
from jaxba.io._colmap_rigs import refuse_other_poses
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


@dataclass(frozen=True, kw_only=True, eq=False)
class _Image:
    """An image with its keypoints as images.txt has them; `place`: file and line."""

    place: str
    image_id: int
    pose: list[float]
    camera_id: int
    name: str
    xy_px: list[list[float]]
    point_ids: list[int]


@dataclass(frozen=True, kw_only=True, eq=False)
class _Point:
    """A point as points3D.txt has it; `track`: pairs of IMAGE_ID and the keypoint's place in that image."""

    place: str
    point_id: int
    xyz: list[float]
    rgb: list[int]
    error_px: float
    track: list[tuple[int, int]]


def read_colmap_text(folder: str | os.PathLike[str]) -> ColmapModel:
    """Return the model in `cameras.txt`, `images.txt` and `points3D.txt`; keypoints without a point are passed over.

    A point that an image sees twice is taken as it is where its track says the same, since COLMAP makes such tracks. A
    point without a track is taken at the word of images.txt, and images that only tracks know were taken out of it.

    Raises:
        JaxbaError: a file is missing or damaged, a number is not finite, a quaternion is zero, an id stands twice, ids
            or tracks contradict each other, poses do not follow from rigs.txt and frames.txt, or cameras are of a model
            that jaxba has not, or of several.
    """
    path = Path(folder)
    model, camera_ids, parameters, size_px = _cameras(path / "cameras.txt")
    points = sorted(_points(path / "points3D.txt"), key=lambda point: point.point_id)
    images = sorted(_images(path / "images.txt", camera_ids), key=lambda image: image.image_id)
    refuse_other_poses(path, [(i.place, i.image_id, i.camera_id, i.pose) for i in images])
    row_of_point = {point.point_id: row for row, point in enumerate(points)}
    row_of_camera = {camera_id: row for row, camera_id in enumerate(camera_ids)}
    _refuse_contradictions(images, points)
    seen = [[k for k, point_id in enumerate(image.point_ids) if point_id != _NO_POINT] for image in images]
    block = Block(
        image_index=np.array([image.image_id for image in images], dtype=np.int64) - 1,
        quaternion=np.array([unit(image.pose[:4]) for image in images]),
        translation_m=np.array([image.pose[4:] for image in images]),
        camera_model=model,
        camera_names=tuple(str(camera_id) for camera_id in camera_ids),
        camera_parameters=parameters,
        camera_index=np.array([row_of_camera[image.camera_id] for image in images], dtype=np.int64),
        points_m=np.array([point.xyz for point in points]),
        track_index=np.arange(len(points)),
        rgb=np.array([point.rgb for point in points], dtype=np.uint8),
        observation_image=np.repeat(np.arange(len(images)), [len(rows) for rows in seen]),
        observation_point=np.array(
            [row_of_point[i.point_ids[k]] for i, rows in zip(images, seen, strict=True) for k in rows], dtype=np.int64
        ),
        observation_xy_px=np.array(
            [i.xy_px[k] for i, rows in zip(images, seen, strict=True) for k in rows], dtype=float
        ).reshape(-1, 2),
        is_georeferenced=False,
    )
    names = tuple(image.name for image in images)
    return ColmapModel(
        block=block, names=names, size_px=size_px, error_px=np.array([point.error_px for point in points])
    )


def _cameras(path: Path) -> tuple[str, list[int], Float[np.ndarray, "cameras n"], Int[np.ndarray, "cameras 2"]]:
    rows: dict[int, tuple[list[int], list[float]]] = {}
    places: dict[int, str] = {}
    models = set()
    for place, line in content_lines(path):
        with Damage(place):
            words = line.split()
            camera_id, name = int(words[0]), words[1]
            row = [int(words[2]), int(words[3])], finite(words[4:])
        if name not in _COUNTS:
            raise JaxbaError(f"{place}: camera model {name}; jaxba has {', '.join(_COUNTS)}.")
        if len(words) != 4 + _COUNTS[name]:
            raise JaxbaError(f"{place}: {len(words) - 4} parameters, but {name} has {_COUNTS[name]}.")
        claim(places, camera_id, place, "camera")
        rows[camera_id] = row
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
    with Damage(f"{path}"):
        size_px = np.array([rows[i][0] for i in ids], dtype=np.int64)
    return model, ids, parameters, size_px


def _points(path: Path) -> list[_Point]:
    points: list[_Point] = []
    places: dict[int, str] = {}
    with Damage(str(path)) as damage:
        for damage.place, line in content_lines(path):
            words = line.split()
            if len(words) < 8 or len(words) % 2:
                raise ValueError(f"{len(words)} fields; the first eight are ID X Y Z R G B ERROR, the others in pairs")
            *xyz, error = finite([*words[1:4], words[7]])
            rgb, track = [int(word) for word in words[4:7]], [int(word) for word in words[8:]]
            if not all(0 <= value <= 255 for value in rgb):
                raise ValueError(f"the colour {rgb} is not of three numbers from 0 to 255")
            point = _Point(
                place=damage.place, point_id=int(words[0]), xyz=xyz, rgb=rgb, error_px=error,
                track=list(zip(track[0::2], track[1::2], strict=True)),
            )  # fmt: skip
            claim(places, point.point_id, point.place, "point")
            points.append(point)
    if not points:
        raise JaxbaError(f"{path}: holds no point; export the model again.")
    return points


def _images(path: Path, camera_ids: Sequence[int]) -> list[_Image]:
    images: list[_Image] = []
    places: dict[int, str] = {}
    lines = content_lines(path, keep_blank=True)
    for place, head in lines:
        if not head:
            continue
        of_points, keypoints = next(lines, (place, ""))
        with Damage(of_points):
            numbers = keypoints.split()
            if len(numbers) % 3:
                raise ValueError(f"{len(numbers)} numbers of keypoints, which come in threes")
            xy = finite([word for k, word in enumerate(numbers) if k % 3 < 2])
            point_ids = [int(word) for word in numbers[2::3]]
        with Damage(place):
            fields = head.split(maxsplit=9)
            if len(fields) != 10:
                raise ValueError(f"{len(fields)} fields of 10")
            image = _Image(
                place=place, image_id=int(fields[0]), pose=finite(fields[1:8]), camera_id=int(fields[8]),
                name=fields[9], xy_px=[xy[k : k + 2] for k in range(0, len(xy), 2)], point_ids=point_ids,
            )  # fmt: skip
        claim(places, image.image_id, place, "image")
        if image.camera_id not in camera_ids:
            raise JaxbaError(f"{place}: image {image.image_id} has camera {image.camera_id}, which cameras.txt lacks.")
        if not any(image.pose[:4]):
            raise JaxbaError(f"{place}: image {image.image_id} has a quaternion of zeros; export the model again.")
        images.append(image)
    if not images:
        raise JaxbaError(f"{path}: holds no image; export the model again.")
    return images


def _refuse_contradictions(images: Sequence[_Image], points: Sequence[_Point]) -> None:
    """Raise where keypoints and tracks do not say the same."""
    of_image = {image.image_id: image for image in images}
    of_point = {point.point_id: point for point in points}
    for image in images:
        unknown = next((i for i in image.point_ids if i != _NO_POINT and i not in of_point), None)
        if unknown is not None:
            raise JaxbaError(f"{image.place}: image {image.image_id} sees point {unknown}, which points3D.txt lacks.")
    seen = Counter(point_id for image in images for point_id in image.point_ids)
    for point in points:
        says = f"{point.place}: the track of point {point.point_id}"
        if len(set(point.track)) != len(point.track):
            raise JaxbaError(f"{says} lists a keypoint twice; export the model again.")
        track = {(image_id, k) for image_id, k in point.track if image_id in of_image}
        for image_id, k in sorted(track):
            image = of_image[image_id]
            if not 0 <= k < len(image.point_ids):
                raise JaxbaError(
                    f"{says} has keypoint {k} of image {image_id}, which has {len(image.point_ids)} ({image.place}); "
                    "export the model again."
                )
            if image.point_ids[k] != point.point_id:
                raise JaxbaError(
                    f"{says} has keypoint {k} of image {image_id}, which is of point {image.point_ids[k]} by "
                    f"{image.place}; export the model again."
                )
        if track and len(track) != seen[point.point_id]:
            image, k = next(
                (image, k)
                for image in images
                for k, point_id in enumerate(image.point_ids)
                if point_id == point.point_id and (image.image_id, k) not in track
            )
            twice = " twice" if image.point_ids.count(point.point_id) > 1 else ""
            raise JaxbaError(
                f"{image.place}: image {image.image_id} sees point {point.point_id}{twice}, at keypoint {k}, which the "
                f"point's track lacks ({point.place}); export the model again."
            )
