"""Settings of tiles, into which large blocks are to be cut; so far every block is solved whole."""

import dataclasses
from dataclasses import dataclass

from jaxba._errors import JaxbaError
from jaxba.engine._parameters import Parameters, parameter

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
