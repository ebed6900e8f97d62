"""Stage tracks: matches joined to tracks, images to connected components."""

from collections.abc import Mapping
from dataclasses import dataclass

from jaxba.pipeline._parameters import Parameters, parameter
from jaxba.scene import Features, Photo, Tracks, ViewGraph


@dataclass(frozen=True, kw_only=True)
class Inputs:
    """- `photos`: of the metadata stage. `features`: by image index. `view_graph`: of the match stage."""

    photos: tuple[Photo, ...]
    features: Mapping[int, Features]
    view_graph: ViewGraph


@dataclass(frozen=True, kw_only=True)
class Params(Parameters):
    """What the user may set."""

    require_connected: bool = parameter(False, help="stop where the photos fall into several groups")


@dataclass(frozen=True, kw_only=True)
class Outputs:
    """- `tracks`: of all images; those of the largest component are solved."""

    tracks: Tracks


def run(inputs: Inputs, params: Params) -> Outputs:
    """Join verified matches to tracks."""
    raise NotImplementedError
