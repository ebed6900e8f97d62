"""Stage export: the adjusted block in the target CRS, in the files that other programs read."""

from dataclasses import dataclass
from pathlib import Path

from jaxba.pipeline import adjust
from jaxba.pipeline._parameters import Parameters
from jaxba.scene import Photo, Reference


@dataclass(frozen=True, kw_only=True)
class Inputs:
    """- `photos`, `reference`, `adjusted`: of the stages before. `folder`: empty; the stage's files go there."""

    photos: tuple[Photo, ...]
    reference: Reference
    adjusted: adjust.Outputs
    folder: Path


@dataclass(frozen=True, kw_only=True)
class Params(Parameters):
    """What the user may set."""


@dataclass(frozen=True, kw_only=True)
class Outputs:
    """- `files`: names of what was written, below the folder. `notes`: what a reader of the files should know."""

    files: tuple[str, ...]
    notes: tuple[str, ...] = ()


def run(inputs: Inputs, params: Params) -> Outputs:
    """Write the exports."""
    raise NotImplementedError
