"""OpenSfM's reconstructions: `reconstruction.json` with the `tracks.csv` that it was made from.

Poses, world and conventions are told in `_opensfm.py`, which writes the same; `_opensfm_cameras.py` says what becomes
of cameras, `_opensfm_tracks.py` what observations are.
"""

import json
import math
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from jaxba._errors import JaxbaError
from jaxba.io._read import read_bytes, text_of
from jaxba.io.models._opensfm_cameras import OpensfmCameras
from jaxba.io.models._opensfm_fields import is_number, numbers, told
from jaxba.io.models._opensfm_tracks import read_tracks
from jaxba.scene import Block, Reconstruction

_POSE = "rotation", "translation"


def read_opensfm(path: str | os.PathLike[str]) -> Reconstruction:
    """Return the reconstruction in a folder or a `reconstruction*.json`; of several in it, that of the most shots.

    Raises:
        JaxbaError: the folder holds none, or several; the tracks are missing; a file is damaged, or holds a field of
            another kind; a camera is of a kind that jaxba has not; or tracks and points contradict each other.
    """
    file = _file_of(Path(path))
    tracks_file = _tracks_of(file)
    chosen, notes = _chosen(file)
    shots = _entries(file, chosen, "shots")
    points = _entries(file, chosen, "points")
    cameras = OpensfmCameras.of(file, _entries(file, chosen, "cameras"))
    names, ids = sorted(shots), list(points)
    row_of_camera = {name: row for row, name in enumerate(cameras.names)}
    camera_index = []
    for name in names:
        camera = shots[name].get("camera")
        if camera not in row_of_camera:
            raise JaxbaError(f"{file}: shot {name} has camera {camera!r}, which its cameras lack; export it again.")
        camera_index.append(row_of_camera[camera])
    pose = {key: np.array([numbers(file, f"shot {name}", shots[name], key, 3) for name in names]) for key in _POSE}
    size_px = cameras.size_px[camera_index]
    side = size_px.max(axis=1).astype(float)
    seen = read_tracks(tracks_file, file, {n: k for k, n in enumerate(names)}, {n: k for k, n in enumerate(ids)})
    block = Block(
        image_index=np.arange(len(names)),
        quaternion=Rotation.from_rotvec(pose["rotation"]).as_quat(scalar_first=True),
        translation_m=pose["translation"],
        camera_model=cameras.model,
        camera_names=cameras.names,
        camera_parameters=cameras.parameters,
        camera_index=np.array(camera_index, dtype=np.int64),
        points_m=np.array([numbers(file, f"point {i}", points[i], "coordinates", 3) for i in ids]),
        track_index=np.arange(len(ids)),
        rgb=np.array([_colour(points[i]) for i in ids], dtype=np.uint8),
        observation_image=seen.image,
        observation_point=seen.point,
        observation_xy_px=seen.xy * side[seen.image, None] + size_px[seen.image] / 2,
        is_georeferenced=False,
    )
    return Reconstruction(
        block=block,
        names=tuple(names),
        size_px=size_px,
        point_ids=tuple(ids),
        program="OpenSfM",
        files=(file, tracks_file),
        point_error=np.array([_stated_error(file, i, points[i]) for i in ids]),
        unit="longer sides",
        unit_px=side,
        notes=tuple(notes),
    )


def _file_of(path: Path) -> Path:
    if not path.is_dir():
        return path
    found = sorted(path.glob("reconstruction*.json"))
    whole = path / "reconstruction.json"
    if whole in found:
        return whole
    if len(found) != 1:
        what = f"several reconstructions, {', '.join(of.name for of in found)}" if found else "no reconstruction*.json"
        raise JaxbaError(f"{path}: holds {what}; give the file itself.")
    return found[0]


def _tracks_of(file: Path) -> Path:
    """Return the tracks beside a reconstruction: with the same ending of the name, else the only ones there."""
    like = file.with_name(file.stem.replace("reconstruction", "tracks", 1) + ".csv")
    if file.stem.startswith("reconstruction") and like.exists():
        return like
    found = sorted(file.parent.glob("tracks*.csv"))
    if len(found) != 1:
        there = f"several others: {', '.join(of.name for of in found)}" if found else "no tracks*.csv"
        raise JaxbaError(
            f"{like}: no such file; {file.name} has no observations without the tracks that it was made from, and "
            f"beside it lie {there}. Copy them there."
        )
    return found[0]


def _chosen(file: Path) -> tuple[Mapping[str, Any], list[str]]:
    """Return the reconstruction with the most shots, and what is told of the others."""
    try:
        content = json.loads(text_of(read_bytes(file)))
    except (ValueError, RecursionError) as error:
        raise JaxbaError(f"{file}: is no JSON ({error}); copy or export it again.") from error
    every = content if isinstance(content, list) else [content]
    if not every or not all(isinstance(one, dict) for one in every):
        raise JaxbaError(f"{file}: holds no list of reconstructions; give a reconstruction.json of OpenSfM.")
    sizes = [len(one["shots"]) if isinstance(one.get("shots"), dict) else 0 for one in every]
    best = int(np.argmax(sizes))
    if len(every) == 1:
        return every[0], []
    others = ", ".join(str(size) for k, size in enumerate(sizes) if k != best)
    return every[best], [
        f"{file.name} holds {len(every)} reconstructions: that of {sizes[best]} shots is taken, others have {others}."
    ]


def _entries(file: Path, chosen: Mapping[str, Any], key: str) -> Mapping[str, Mapping[str, Any]]:
    found = chosen.get(key)
    if not isinstance(found, dict) or not found or not all(isinstance(entry, dict) for entry in found.values()):
        raise JaxbaError(
            f"{file}: {key} is {told(found)}, where an object of {key} by name is needed; give a reconstruction.json "
            "of OpenSfM."
        )
    return found


def _colour(point: Mapping[str, Any]) -> list[int]:
    colour = point.get("color")
    if not isinstance(colour, list) or len(colour) != 3 or not all(map(is_number, colour)):
        return [128, 128, 128]
    return [int(min(max(value, 0), 255)) for value in colour]


def _stated_error(file: Path, point_id: str, point: Mapping[str, Any]) -> float:
    """Return the mean length of a point's `reprojection_errors`, as older versions write them by shot; else NaN."""
    stated = point.get("reprojection_errors")
    if not isinstance(stated, dict) or not stated:
        return math.nan
    of = f"point {point_id}, reprojection_errors"
    return float(np.mean([math.hypot(*numbers(file, of, stated, shot, 2)) for shot in stated]))
