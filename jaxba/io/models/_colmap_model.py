"""COLMAP's sparse models as their files have them, text or binary, and the block that they make.

The files say much twice, and what they say is held against each other here: a point's track lists the keypoints that
its images give it, ids stand once, and an image's camera is there. `_read_colmap.py` reads text,
`_read_colmap_binary.py` the binary form.
"""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int

from jaxba._errors import JaxbaError
from jaxba.io.models._colmap_lines import Damage, unit
from jaxba.scene import Block, Claim

PARAMETERS = {
    "SIMPLE_PINHOLE": 3, "PINHOLE": 4, "SIMPLE_RADIAL": 4, "RADIAL": 5, "OPENCV": 8, "OPENCV_FISHEYE": 8,
    "FULL_OPENCV": 12,
}  # fmt: skip
"""How many parameters each camera model has."""
NO_POINT = -1


@dataclass(frozen=True, kw_only=True, eq=False)
class ColmapModel:
    """A model's block, its images by IMAGE_ID, its points by POINT3D_ID, and what a block does not hold.

    - `names`: of the images. `size_px`: width and height of each camera's. `error_px`: of each point as the file has
      it, negative where it was not computed. `block.image_index` is IMAGE_ID - 1, `block.camera_names` the CAMERA_IDs;
      the world is any frame and scale.
    - `point_ids`: POINT3D_IDs. `claims`: what the files' headers say of the model. `files`: the three.
    """

    block: Block
    names: tuple[str, ...]
    size_px: Int[np.ndarray, "cameras 2"]
    error_px: Float[np.ndarray, " points"]
    point_ids: tuple[int, ...]
    files: tuple[Path, ...]
    claims: tuple[Claim, ...] = ()


@dataclass(frozen=True, kw_only=True, eq=False)
class ColmapCamera:
    """A camera; `place`: file and line, or file and which of its cameras."""

    place: str
    model: str
    size_px: tuple[int, int]
    parameters: list[float]


@dataclass(frozen=True, kw_only=True, eq=False)
class ColmapImage:
    """An image with its keypoints."""

    place: str
    image_id: int
    pose: list[float]
    camera_id: int
    name: str
    xy_px: list[list[float]]
    point_ids: list[int]


@dataclass(frozen=True, kw_only=True, eq=False)
class ColmapPoint:
    """A point; `track`: pairs of IMAGE_ID and the keypoint's place in that image."""

    place: str
    point_id: int
    xyz: list[float]
    rgb: list[int]
    error_px: float
    track: list[tuple[int, int]]


@dataclass(frozen=True, kw_only=True)
class ColmapFiles:
    """The three files of a model, for messages."""

    cameras: Path
    images: Path
    points: Path

    @staticmethod
    def of(folder: Path, ending: str) -> "ColmapFiles":
        """Return the files in a folder; `ending`: txt or bin."""
        cameras, images, points = (folder / f"{name}.{ending}" for name in ("cameras", "images", "points3D"))
        return ColmapFiles(cameras=cameras, images=images, points=points)

    @property
    def all(self) -> tuple[Path, Path, Path]:
        """Return the three in the order of COLMAP's documentation."""
        return self.cameras, self.images, self.points


def check_camera(camera: ColmapCamera) -> None:
    """Raise `JaxbaError` for a camera of a model that jaxba has not, or with another number of parameters."""
    if camera.model not in PARAMETERS:
        raise JaxbaError(f"{camera.place}: camera model {camera.model}; jaxba has {', '.join(PARAMETERS)}.")
    if len(camera.parameters) != PARAMETERS[camera.model]:
        raise JaxbaError(
            f"{camera.place}: {len(camera.parameters)} parameters, but {camera.model} has {PARAMETERS[camera.model]}."
        )


def check_one_model(path: Path, cameras: Mapping[int, ColmapCamera]) -> None:
    """Raise `JaxbaError` where there is no camera, or they are of several models."""
    models = {camera.model for camera in cameras.values()}
    if len(models) != 1:
        found = ", ".join(sorted(models)) or "none"
        raise JaxbaError(f"{path}: cameras of one model are needed, it has {found}; convert them to one model.")


def check_image(image: ColmapImage, cameras: Mapping[int, ColmapCamera], cameras_name: str) -> None:
    """Raise `JaxbaError` for an image of a camera that is not there, or without a rotation."""
    if image.camera_id not in cameras:
        raise JaxbaError(
            f"{image.place}: image {image.image_id} has camera {image.camera_id}, which {cameras_name} lacks."
        )
    if not any(image.pose[:4]):
        raise JaxbaError(f"{image.place}: image {image.image_id} has a quaternion of zeros; export the model again.")


def model_of(
    files: ColmapFiles,
    cameras: Mapping[int, ColmapCamera],
    images: Sequence[ColmapImage],
    points: Sequence[ColmapPoint],
    claims: Sequence[Claim] = (),
) -> ColmapModel:
    """Return the model of what the files hold.

    Raises `JaxbaError` where there are no images or points, and where ids or tracks contradict each other.
    """
    model, parameters, size_px = _camera_table(files.cameras, cameras)
    for path, found, what in ((files.images, images, "image"), (files.points, points, "point")):
        if not found:
            raise JaxbaError(f"{path}: holds no {what}; export the model again.")
    points = sorted(points, key=lambda point: point.point_id)
    images = sorted(images, key=lambda image: image.image_id)
    _refuse_contradictions(images, points, files.points.name)
    row_of_point = {point.point_id: row for row, point in enumerate(points)}
    row_of_camera = {camera_id: row for row, camera_id in enumerate(sorted(cameras))}
    seen = [[k for k, point_id in enumerate(image.point_ids) if point_id != NO_POINT] for image in images]
    block = Block(
        image_index=np.array([image.image_id for image in images], dtype=np.int64) - 1,
        quaternion=np.array([unit(image.pose[:4]) for image in images]),
        translation_m=np.array([image.pose[4:] for image in images]),
        camera_model=model,
        camera_names=tuple(str(camera_id) for camera_id in sorted(cameras)),
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
    return ColmapModel(
        block=block,
        names=tuple(image.name for image in images),
        size_px=size_px,
        error_px=np.array([point.error_px for point in points]),
        point_ids=tuple(point.point_id for point in points),
        files=files.all,
        claims=tuple(claims),
    )


def _camera_table(
    path: Path, cameras: Mapping[int, ColmapCamera]
) -> tuple[str, Float[np.ndarray, "cameras n"], Int[np.ndarray, "cameras 2"]]:
    ids = sorted(cameras)
    model = cameras[ids[0]].model
    parameters = np.array([cameras[i].parameters for i in ids])
    if model == "FULL_OPENCV":
        if np.any(parameters[:, 9:]):
            raise JaxbaError(f"{path}: FULL_OPENCV with k4, k5 or k6 other than 0 has no model here; refine without.")
        model, parameters = "OPENCV", parameters[:, :9]
    elif model == "OPENCV":
        parameters = np.pad(parameters, ((0, 0), (0, 1)))
    with Damage(f"{path}"):
        size_px = np.array([cameras[i].size_px for i in ids], dtype=np.int64)
    return model, parameters, size_px


def _refuse_contradictions(images: Sequence[ColmapImage], points: Sequence[ColmapPoint], points_name: str) -> None:
    """Raise where keypoints and tracks do not say the same."""
    of_image = {image.image_id: image for image in images}
    of_point = {point.point_id: point for point in points}
    for image in images:
        unknown = next((i for i in image.point_ids if i != NO_POINT and i not in of_point), None)
        if unknown is not None:
            raise JaxbaError(f"{image.place}: image {image.image_id} sees point {unknown}, which {points_name} lacks.")
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
