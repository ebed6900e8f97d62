"""Other programs' results as `Reconstruction`s, whatever their form: what `jaxba audit` takes.

BAL and tiles say less than the others. BAL's pixels count from the middle of the image, whose size nobody states: an
image is taken as large as its measurements reach, and its camera becomes RADIAL with the principal point in the middle,
which is the same projection.
"""

import dataclasses
import os
from pathlib import Path

import numpy as np
from jaxtyping import Int

from jaxba._errors import JaxbaError
from jaxba.ba import Problem
from jaxba.geometry import BAL, CAMERAS
from jaxba.io._npz import ZIP_MAGIC
from jaxba.io._problem import problem_of_bytes
from jaxba.io._read import read_bytes
from jaxba.io.models._colmap_model import ColmapFiles
from jaxba.io.models._read_colmap import read_colmap
from jaxba.io.models._read_opensfm import read_opensfm
from jaxba.scene import Block, Reconstruction

_GREY = 128


def read_reconstruction(path: str | os.PathLike[str]) -> Reconstruction:
    """Return another program's result: a COLMAP model, an OpenSfM reconstruction, a BAL problem or a tile.

    - `path`: a folder with a COLMAP model or a `reconstruction*.json`; or a file.

    Raises:
        JaxbaError: there is none, or as the reader of its form does.

    >>> import pathlib, tempfile
    >>> path = pathlib.Path(tempfile.mkdtemp(), "problem.txt")
    >>> _ = path.write_text("1 1 1  0 0 3 -4  0 0 0  0 0 0  100 0 0  0 0 -10")
    >>> found = read_reconstruction(path)
    >>> found.program, found.size_px.tolist(), found.block.observation_xy_px.tolist()
    ('BAL', [[6, 8]], [[6.0, 8.0]])
    """
    place = Path(path)
    if place.is_dir():
        if any(of.exists() for ending in ("bin", "txt") for of in ColmapFiles.of(place, ending).all):
            return _of_colmap(place)
        if any(place.glob("reconstruction*.json")):
            return read_opensfm(place)
        raise JaxbaError(
            f"{place}: holds neither a COLMAP model (cameras, images, points3D as .bin or .txt) nor an OpenSfM "
            "reconstruction*.json; give the folder with one, such as sparse/0, or a file."
        )
    if place.name in {of.name for ending in ("bin", "txt") for of in ColmapFiles.of(Path(), ending).all}:
        return _of_colmap(place.parent)
    if place.suffix.lower() == ".json":
        read_bytes(place)
        return read_opensfm(place)
    data = read_bytes(place)
    contents = problem_of_bytes(data, os.fspath(path))
    return _of_problem(contents.problem, place, "jaxba" if data.startswith(ZIP_MAGIC) else "BAL")


def _of_colmap(folder: Path) -> Reconstruction:
    model = read_colmap(folder)
    block = dataclasses.replace(model.block, image_index=np.arange(model.block.num_images))
    return Reconstruction(
        block=block,
        names=model.names,
        size_px=model.size_px[block.camera_index],
        point_ids=tuple(map(str, model.point_ids)),
        program="COLMAP",
        files=model.files,
        point_error=np.where(model.error_px < 0, np.nan, model.error_px),
        claims=model.claims,
        unit_px=np.ones(block.num_images),
    )


def _of_problem(problem: Problem, path: Path, program: str) -> Reconstruction:
    """Return a problem without its priors and sigmas, which are no part of the result itself."""
    camera = type(problem.cameras)
    model = next(name for name, known in CAMERAS.items() if known is camera)
    names = camera.parameter_names()
    columns = [np.broadcast_to(np.asarray(getattr(problem.cameras, n), float), (problem.num_cameras,)) for n in names]
    parameters = np.stack(columns, axis=1)
    camera_index = np.asarray(problem.camera_index, np.int64)
    image = np.asarray(problem.observations.image_index, np.int64)
    xy_px = np.asarray(problem.observations.xy_px, float)
    notes = []
    if camera is BAL:
        size_px = _reach(xy_px, camera_index[image], problem.num_cameras)
        model = "RADIAL"
        parameters = np.concatenate([parameters[:, :1], size_px / 2, parameters[:, 1:]], axis=1)
        xy_px = xy_px + size_px[camera_index[image]] / 2
        notes.append("The file states no sizes of images: each is taken as large as its measurements reach.")
    else:
        middle = parameters[:, [names.index("cx"), names.index("cy")]]
        size_px = np.maximum(np.round(2 * middle), 1).astype(np.int64)
        notes.append("The file states no sizes of images: principal points are taken as their middles.")
    if problem.priors:
        kinds = ", ".join(prior.name for prior in problem.priors)
        notes.append(f"The file's priors take no part: {kinds}.")
    count = problem.num_points
    block = Block(
        image_index=np.arange(problem.num_images),
        quaternion=np.asarray(problem.poses.quaternion, float),
        translation_m=np.asarray(problem.poses.translation, float),
        camera_model=model,
        camera_names=tuple(str(k) for k in range(problem.num_cameras)),
        camera_parameters=parameters,
        camera_index=camera_index,
        points_m=np.asarray(problem.points, float),
        track_index=np.arange(count),
        rgb=np.full((count, 3), _GREY, np.uint8),
        observation_image=image,
        observation_point=np.asarray(problem.observations.point_index, np.int64),
        observation_xy_px=xy_px,
        is_georeferenced=False,
    )
    return Reconstruction(
        block=block,
        names=problem.image_names or tuple(f"image {k}" for k in range(problem.num_images)),
        size_px=size_px[camera_index],
        point_ids=tuple(map(str, range(count))),
        program=program,
        files=(path,),
        point_error=np.full(count, np.nan),
        unit_px=np.ones(problem.num_images),
        notes=tuple(notes),
    )


def _reach(xy_px: np.ndarray, camera: np.ndarray, num_cameras: int) -> Int[np.ndarray, "cameras 2"]:
    """Return the size of an image about its middle that holds all measurements of a camera."""
    reach = np.ones((num_cameras, 2))
    np.maximum.at(reach, camera, np.abs(xy_px))
    return 2 * np.ceil(reach).astype(np.int64)
