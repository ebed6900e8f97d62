"""The sections of the settings: those of the stages, then of tiles, workers and checks.

Tiles are what large blocks are to be cut into; so far every block is solved whole.
"""

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass

from jaxba._errors import JaxbaError
from jaxba.engine._parameters import Parameters, parameter
from jaxba.engine._settings import Settings, changed, explained, from_toml, to_toml
from jaxba.engine._workers import Resources
from jaxba.report import verification

__all__ = ["Settings", "Tiles", "changed", "explained", "from_toml", "sections", "to_toml"]  # for callers of a run

_NOT_YET = "no effect yet, blocks are solved whole, and another value is refused; "


@dataclass(frozen=True, kw_only=True)
class Tiles(Parameters):
    """How a block is to be cut; refuses what would have no effect."""

    chunk_size: int = parameter(500, low=100, high=5000, help=_NOT_YET + "images a tile: consistency against memory")
    overlap: int = parameter(50, low=10, high=1500, help=_NOT_YET + "images that neighbours share: stitching, cost")

    def __post_init__(self) -> None:
        Parameters.__post_init__(self)
        for field in dataclasses.fields(self):
            if getattr(self, field.name) != field.default:
                raise JaxbaError(
                    f"tiles.{field.name}={getattr(self, field.name)}: blocks are solved whole so far, whatever their "
                    f"size; leave {field.name} out. 2000 images take 1.5 GB."
                )


def sections(stages: Mapping[str, Parameters]) -> dict[str, Parameters]:
    """Return every section's defaults. `stages`: those of the stages, in their order."""
    return {**stages, "tiles": Tiles(), "workers": Resources(), "verify": verification.Params()}
