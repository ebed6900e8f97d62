"""COLMAP's sparse models: what `write_colmap_text` and `write_colmap_binary` wrote, or COLMAP itself.

What is read, and what is held against each other, stands in `_colmap_model.py`; where rigs and frames are there, as
COLMAP 3.12 and later write them, the poses of images follow from theirs. Blank lines of a text are passed over where
COLMAP does so: anywhere but as an image's second line.
"""

import os
import re
from collections.abc import Mapping
from pathlib import Path

from jaxba._errors import JaxbaError
from jaxba.io.models._colmap_lines import Damage, claim, comment_lines, content_lines, finite
from jaxba.io.models._colmap_model import (
    PARAMETERS,
    ColmapCamera,
    ColmapFiles,
    ColmapImage,
    ColmapModel,
    ColmapPoint,
    check_camera,
    check_image,
    check_one_model,
    model_of,
)
from jaxba.io.models._colmap_rigs import read_rigs_text, refuse_other_poses
from jaxba.io.models._read_colmap_binary import read_colmap_binary
from jaxba.scene import Claim

_HEADER = re.compile(r"# Number of (cameras|images|points): (\d+)(?:, (mean [a-z ]+): (\S+))?")


def read_colmap(folder: str | os.PathLike[str]) -> ColmapModel:
    """Return the model in a folder, binary or text; where both are there the binary one, as COLMAP does.

    Raises:
        JaxbaError: the folder holds no model, or as `read_colmap_text` does.
    """
    path = Path(folder)
    if not path.is_dir():
        raise JaxbaError(f"{path}: no such folder; give one with a COLMAP model.")
    found = {kind: [of for of in ColmapFiles.of(path, kind).all if of.exists()] for kind in ("bin", "txt")}
    for kind, read in (("bin", read_colmap_binary), ("txt", read_colmap_text)):
        if len(found[kind]) == 3:
            return read(path)
    there = found["bin"] or found["txt"]
    if not there:
        raise JaxbaError(
            f"{path}: holds no COLMAP model, neither cameras.bin, images.bin, points3D.bin nor the same as .txt; give "
            "the folder with these, such as sparse/0."
        )
    missing = [of.name for of in ColmapFiles.of(path, there[0].suffix[1:]).all if not of.exists()]
    raise JaxbaError(
        f"{path / missing[0]}: no such file beside {there[0].name}; a model has cameras, images and points3D: export "
        "or copy it again."
    )


def read_colmap_text(folder: str | os.PathLike[str]) -> ColmapModel:
    """Return the model in `cameras.txt`, `images.txt` and `points3D.txt`; keypoints without a point are passed over.

    A point that an image sees twice is taken as it is where its track says the same, since COLMAP makes such tracks. A
    point without a track is taken at the word of images.txt, and images that only tracks know were taken out of it.

    Raises:
        JaxbaError: a file is missing or damaged, a number is not finite, a quaternion is zero, an id stands twice, ids
            or tracks contradict each other, poses do not follow from rigs.txt and frames.txt, or cameras are of a model
            that jaxba has not, or of several.
    """
    files = ColmapFiles.of(Path(folder), "txt")
    cameras = _cameras(files.cameras)
    check_one_model(files.cameras, cameras)
    points, images = _points(files.points), _images(files.images, cameras)
    refuse_other_poses(read_rigs_text(Path(folder)), images)
    claims = [found for path in (files.cameras, files.images, files.points) for found in _claims(path)]
    return model_of(files, cameras, images, points, claims)


def _claims(path: Path) -> list[Claim]:
    """Return what the comments of a file say of the model."""
    found = []
    for place, line in comment_lines(path):
        match = _HEADER.match(line)
        if match is None:
            continue
        name, count, mean, value = match.groups()
        found.append(Claim(name=name, stated=float(count), place=place))
        if mean is not None:
            with Damage(place):
                found.append(Claim(name=mean, stated=finite([value])[0], place=place))
    return found


def _cameras(path: Path) -> dict[int, ColmapCamera]:
    cameras: dict[int, ColmapCamera] = {}
    places: dict[int, str] = {}
    for place, line in content_lines(path):
        with Damage(place):
            words = line.split()
            camera_id, name = int(words[0]), words[1]
            size_px = int(words[2]), int(words[3])
            parameters = finite(words[4:]) if name in PARAMETERS else []
        camera = ColmapCamera(place=place, model=name, size_px=size_px, parameters=parameters)
        check_camera(camera)
        claim(places, camera_id, place, "camera")
        cameras[camera_id] = camera
    return cameras


def _points(path: Path) -> list[ColmapPoint]:
    points: list[ColmapPoint] = []
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
            point = ColmapPoint(
                place=damage.place, point_id=int(words[0]), xyz=xyz, rgb=rgb, error_px=error,
                track=list(zip(track[0::2], track[1::2], strict=True)),
            )  # fmt: skip
            claim(places, point.point_id, point.place, "point")
            points.append(point)
    return points


def _images(path: Path, cameras: Mapping[int, ColmapCamera]) -> list[ColmapImage]:
    images: list[ColmapImage] = []
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
            image = ColmapImage(
                place=place, image_id=int(fields[0]), pose=finite(fields[1:8]), camera_id=int(fields[8]),
                name=fields[9], xy_px=[xy[k : k + 2] for k in range(0, len(xy), 2)], point_ids=point_ids,
            )  # fmt: skip
        claim(places, image.image_id, place, "image")
        check_image(image, cameras, "cameras.txt")
        images.append(image)
    return images
