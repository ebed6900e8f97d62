"""A model adjusted anew as a project is: the same rounds, judge, sigmas, findings and control.

The model's poses, cameras and points are the start values, its observations the tracks. Each observation counts with
the sigma that the errors themselves show, and what does not fit is rejected. Intrinsics that the model plainly did not
calibrate stay as they are: a principal point in the middle of the image, distortion of zero.

Without control a block has no place. Its own frame and scale stay, and sigmas of its images for the comparison with
the model are those of its shape, under inner constraints.
"""

import dataclasses
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from jaxba._errors import JaxbaError
from jaxba.audit._claims import residuals_px
from jaxba.engine._words import many
from jaxba.pipeline import PIPELINE, adjust, control as control_stage
from jaxba.scene import Block, Photo, Reconstruction, Reference, Tracks, ViewGraph, components

_CENTERED = 1e-6  # of the image's width: as near a principal point was not calibrated


@dataclass(frozen=True, kw_only=True, eq=False)
class Readjusted:
    """A model adjusted anew.

    - `photos`, `tracks`: made of the model. `start`: its block, brought onto control where there is any.
    - `controlled`: what the stage control made of the list. `outputs`: what the stage adjust made.
    - `center_covariance`: of each image of `outputs.block`, of the block's shape, its own units squared; None where it
      could not be computed. `held`: intrinsics that were not adjusted.
    - `notes`: what was found and decided, in sentences.
    """

    photos: tuple[Photo, ...]
    tracks: Tracks
    start: Block
    controlled: Any
    outputs: Any
    center_covariance: Float[np.ndarray, "images 3 3"] | None
    held: tuple[str, ...]
    notes: tuple[str, ...]


def readjust(given: Reconstruction, gcp: tuple[str, str] | None = None, crs: str | None = None) -> Readjusted:
    """Return a model adjusted anew.

    - `gcp`: name and text of a list of control points. `crs`: of the results, and of a list that names none.

    Raises:
        JaxbaError: too little of the model can be adjusted; or the list of control points cannot be used.
    """
    from jaxba.sfm import place_by_control

    settings: Any = PIPELINE.settings
    photos = tuple(
        Photo(
            name=name, path=Path(name), sha256="", width_px=int(width), height_px=int(height),
            camera=given.block.camera_names[camera],
        )
        for name, (width, height), camera in zip(
            given.names, given.size_px.tolist(), given.block.camera_index.tolist(), strict=True
        )
    )  # fmt: skip
    block, notes = _start(given)
    tracks = _tracks(block)
    nowhere = _no_reference(len(photos))
    controlled = control_stage.run(
        control_stage.Inputs(photos=photos, reference=nowhere, target_crs=crs, gcp=gcp, list_crs=crs or ""),
        settings["control"],
    )
    block = place_by_control(block, controlled.control, is_placed=False)
    held = _not_calibrated(given)
    outputs, adjusted = adjust.run_and_keep(
        adjust.Inputs(
            photos=photos,
            reference=controlled.reference,
            view_graph=ViewGraph.empty(),
            tracks=tracks,
            block=block,
            control=controlled.control,
            chunk_size=settings["tiles"].chunk_size,
            held=held,
        ),
        settings["adjust"],
    )
    covariance, told = _of_the_shape(adjusted)
    return Readjusted(
        photos=photos,
        tracks=tracks,
        start=block,
        controlled=controlled,
        outputs=outputs,
        center_covariance=covariance,
        held=held,
        notes=(*notes, *controlled.notes, *told),
    )


def _no_reference(count: int) -> Reference:
    nothing = np.full((count, 3), np.nan)
    return Reference(
        frame=None,
        xyz_m=nothing,
        std_m=nothing,
        quaternion=np.full((count, 4), np.nan),
        attitude_std_rad=nothing,
        is_used=np.zeros(count, bool),
        height_above_ground_m=np.full(count, np.nan),
    )


def _start(given: Reconstruction) -> tuple[Block, list[str]]:
    """Return the block without what an adjustment cannot use, and what was left out.

    Of two observations of a point in one image, which COLMAP's tracks may have, the one that fits better stays.
    """
    block, notes = given.block, []
    error = np.nan_to_num(np.hypot(*residuals_px(block).T), nan=np.inf)
    order = np.lexsort((error, block.observation_image, block.observation_point))
    point, image = block.observation_point[order], block.observation_image[order]
    is_again = np.zeros(len(order), bool)
    is_again[1:] = (point[1:] == point[:-1]) & (image[1:] == image[:-1])
    if is_again.any():
        notes.append(
            f"{int(is_again.sum()):,} observations show a point that another of the same image shows: the one that "
            "fits better was adjusted."
        )
    keep = order[~is_again]
    views = np.bincount(block.observation_point[keep], minlength=block.num_points)
    lone = int((views < 2).sum())
    if lone:
        notes.append(f"{many(lone, 'point')} that fewer than two images see took no part.")
    if lone == block.num_points or block.num_images < 2:
        raise JaxbaError(
            f"{given.files[0]}: {many(block.num_images, 'image')} and {block.num_points - lone} points that two of "
            "them see; an adjustment needs two images that share points. Give the whole model."
        )
    return _with_observations(block, np.isin(np.arange(block.num_observations), keep)), notes


def _with_observations(block: Block, keep: Bool[np.ndarray, " observations"]) -> Block:
    """Return the block with some of its observations, sorted by point, and the points that two of these see.

    `track_index` counts the points of the model.
    """
    views = np.bincount(block.observation_point[keep], minlength=block.num_points)
    keep = keep & (views[block.observation_point] >= 2)
    rows = np.flatnonzero(keep)
    rows = rows[np.lexsort((block.observation_image[rows], block.observation_point[rows]))]
    seen = views >= 2
    number = np.cumsum(seen) - 1
    return dataclasses.replace(
        block,
        points_m=block.points_m[seen],
        track_index=np.arange(int(seen.sum())),
        rgb=block.rgb[seen],
        observation_image=block.observation_image[rows],
        observation_point=number[block.observation_point[rows]],
        observation_xy_px=block.observation_xy_px[rows],
    )


def _tracks(block: Block) -> Tracks:
    """Return the observations of a block, sorted by point and image, as tracks."""
    point, image = block.observation_point, block.observation_image
    follows = np.flatnonzero(point[1:] == point[:-1])
    return Tracks(
        track_index=point.astype(np.int64),
        image_index=image.astype(np.int64),
        feature_index=np.arange(len(point)),
        xy_px=block.observation_xy_px,
        rgb=block.rgb,
        components=components(
            np.unique(np.stack([image[follows], image[follows + 1]], axis=1), axis=0), block.num_images
        ),
    )


def _not_calibrated(given: Reconstruction) -> tuple[str, ...]:
    """Return the intrinsics that all cameras of a model have at the value that is assumed before calibration."""
    from jaxba.geometry import CAMERAS

    block, held = given.block, []
    names = CAMERAS[block.camera_model].parameter_names()
    size_px = np.zeros((len(block.camera_names), 2))
    size_px[block.camera_index] = given.size_px
    for k, name in enumerate(names):
        if name in ("f", "fx", "fy"):
            continue
        assumed = size_px[:, ["cx", "cy"].index(name)] / 2 if name in ("cx", "cy") else np.zeros(len(size_px))
        if np.all(
            np.abs(block.camera_parameters[:, k] - assumed)
            <= _CENTERED * (size_px[:, 0] if name in ("cx", "cy") else 0)
        ):
            held.append(name)
    return tuple(held)


def _of_the_shape(adjusted: Any) -> tuple[Float[np.ndarray, "images 3 3"] | None, list[str]]:
    """Return the covariances of the cameras' places under inner constraints, or why there are none."""
    from jaxba.ba import covariance
    from jaxba.sfm import weighed

    problem = weighed(adjusted.problem, adjusted.spread, adjusted.block.num_observations)
    loss = dataclasses.replace(adjusted.loss, f_scale=adjusted.loss.f_scale / adjusted.spread)
    try:
        found = covariance(problem, loss=loss, datum="inner", max_memory=adjusted.max_memory)
    except JaxbaError as error:
        return None, [f"Sigmas of the images' places in the block were not computed. {error}"]
    return found.centers, []
