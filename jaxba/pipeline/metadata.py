"""Stage metadata: what each photo's tags and header tell; what cannot be used is left out and named."""

from dataclasses import dataclass

from jaxba.pipeline._parameters import Parameters, parameter
from jaxba.scene import Left, Photo, PhotoFile


@dataclass(frozen=True, kw_only=True)
class Inputs:
    """- `files`: the photo folder's files, by name. `geotags`: text of a geo.txt or CSV that replaces the tags."""

    files: tuple[PhotoFile, ...]
    geotags: str | None = None
    geotags_name: str = "geo.txt"


@dataclass(frozen=True, kw_only=True)
class Params(Parameters):
    """What the user may set."""

    focal: float | None = parameter(None, low=100, high=100_000, help="focal length in pixels, in place of the tags'")
    max_focal_deviation: float = parameter(0.15, low=0.05, high=0.5, help="from the sensor's specification, as a share")


@dataclass(frozen=True, kw_only=True)
class Outputs:
    """- `photos`: usable frames by name. `left_out`: files that are none, with the reason."""

    photos: tuple[Photo, ...]
    left_out: tuple[Left, ...]
    notes: tuple[str, ...] = ()


def run(inputs: Inputs, params: Params) -> Outputs:
    """Read the tags of every photo."""
    raise NotImplementedError
