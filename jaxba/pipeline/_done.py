"""What the stages of a run have made so far."""

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TypeVar

from jaxba.engine._parameters import Parameters
from jaxba.pipeline._routing import Routing, route
from jaxba.pipeline.adjust import Outputs as Adjusted
from jaxba.pipeline.control import Outputs as Controlled
from jaxba.pipeline.crs import Outputs as Placed
from jaxba.pipeline.export import Outputs as Exported
from jaxba.pipeline.features import Detected, Params as FeatureParams
from jaxba.pipeline.match import Outputs as Matched
from jaxba.pipeline.metadata import Outputs as Described
from jaxba.pipeline.pairs import Outputs as Paired
from jaxba.pipeline.retrieval import Outputs as Retrieved
from jaxba.pipeline.start import Outputs as Started
from jaxba.pipeline.tracks import Outputs as Tracked
from jaxba.scene import LeftOut, Photo, PhotoFile, Reference

T = TypeVar("T")


@dataclass
class Done:
    """What the stages so far have made; None where a stage has not run. `settings`: parameters by section.

    - `geotags`, `gcp`, `check`, `bars`: name and text of the lists that the run was given.
    - `found_lists`: those of them that nobody named, since they lie among the photos. `own_lists`: the files below
      the folder of photos that are lists in use.
    - `features_left_out`, `match_left_out`: photos that these stages could not work on.
    """

    files: tuple[PhotoFile, ...]
    settings: Mapping[str, Parameters]
    geotags: tuple[str, str] | None = None
    gcp: tuple[str, str] | None = None
    check: tuple[str, str] | None = None
    bars: tuple[str, str] | None = None
    found_lists: tuple[str, ...] = ()
    own_lists: tuple[str, ...] = ()
    metadata: Described | None = None
    crs: Placed | None = None
    control: Controlled | None = None
    pairs: Paired | None = None
    features: Detected | None = None
    features_left_out: tuple[LeftOut, ...] = ()
    retrieval: Retrieved | None = None
    match: Matched | None = None
    match_left_out: tuple[LeftOut, ...] = ()
    tracks: Tracked | None = None
    start: Started | None = None
    adjust: Adjusted | None = None
    export: Exported | None = None

    @property
    def photos(self) -> tuple[Photo, ...]:
        """The usable photos; none before their tags are read."""
        return () if self.metadata is None else self.metadata.photos

    @property
    def placed(self) -> Reference:
        """The reference without the target CRS: nothing before the export depends on it."""
        reference = made(self.control).reference
        frame = reference.frame
        if frame is None:
            return reference
        frame = dataclasses.replace(
            frame, crs="", epsg=None, crs_name="", unit="", height_note="", height_datum="", height_unit=""
        )
        return dataclasses.replace(reference, frame=frame, review=(), notes=(), assumed_datum=None)

    @property
    def routing(self) -> Routing:
        """The detector of the block, and the figures behind it."""
        params = self.settings["features"]
        assert isinstance(params, FeatureParams)
        found = made(self.pairs)
        return route(
            self.photos,
            made(self.crs).reference,
            found.pairs,
            found.overlap,
            detector=params.detector,
            sift_gsd_m=params.sift_gsd,
            sift_overlap=params.sift_overlap,
        )


def made(outputs: T | None) -> T:
    """Return what a stage has made, where the order of the stages says that it has run."""
    assert outputs is not None
    return outputs
