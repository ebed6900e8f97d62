"""Stage start: start values of poses, cameras and points."""

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from jaxba.engine._parameters import Parameters, parameter
from jaxba.engine._words import many
from jaxba.report import Told, grouped
from jaxba.scene import Block, Control, Photo, Reference, Tracks, ViewGraph


@dataclass(frozen=True, kw_only=True)
class Inputs:
    """- `photos`, `reference`, `view_graph`, `tracks`: of the stages before. `control`: without check points."""

    photos: tuple[Photo, ...]
    reference: Reference
    view_graph: ViewGraph
    tracks: Tracks
    control: Control = field(default_factory=Control.nothing)


@dataclass(frozen=True, kw_only=True)
class Params(Parameters):
    """What the user may set."""

    camera_model: str = parameter(
        "OPENCV",
        choices=("SIMPLE_RADIAL", "RADIAL", "OPENCV", "OPENCV_FISHEYE"),
        help="camera model of all photos",
    )
    min_angle: float = parameter(1.5, low=0.1, high=10, help="least angle between two rays of a point, degrees")


@dataclass(frozen=True, kw_only=True)
class Outputs:
    """- `block`: start values of the largest component."""

    block: Block


def run(inputs: Inputs, params: Params) -> Outputs:
    """Find start values for the largest component."""
    from jaxba.sfm import initialise, place_by_control, positions_hold  # loads jax, which the table of stages must not

    block = initialise(
        inputs.photos,
        inputs.reference,
        inputs.view_graph,
        inputs.tracks,
        camera_model=params.camera_model,
        min_angle_rad=float(np.deg2rad(params.min_angle)),
    )
    is_placed = block.is_georeferenced and positions_hold(block, inputs.reference)
    return Outputs(block=place_by_control(block, inputs.control, is_placed=is_placed))


def lines(outputs: Outputs, told: Told) -> list[str]:
    """Return what was made, in words."""
    block = outputs.block
    first = f"{many(block.num_images, 'image')}, {block.num_points:,} points"
    return [first, *block.notes, *grouped(told.left_out)]


def facts(outputs: Outputs, told: Told) -> dict[str, Any]:
    """Return nothing of its own: start values are not a result."""
    return {}
