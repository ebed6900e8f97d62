"""The sections of the settings: those of the stages, then of tiles, workers and checks."""

from collections.abc import Mapping

from jaxba.engine._parameters import Parameters
from jaxba.engine._settings import Settings, changed, explained, from_toml, to_toml
from jaxba.engine._workers import Resources
from jaxba.pipeline._tiles import Tiles
from jaxba.report import verification

__all__ = ["Settings", "changed", "explained", "from_toml", "sections", "to_toml"]  # for callers of a run


def sections(stages: Mapping[str, Parameters]) -> dict[str, Parameters]:
    """Return every section's defaults. `stages`: those of the stages, in their order."""
    return {**stages, "tiles": Tiles(), "workers": Resources(), "verify": verification.Params()}
