"""What the features stage found: the features of each photo, how each was looked at, and the block's decision."""

import functools
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

from jaxba.engine._store import Stored
from jaxba.pipeline._routing import Routing
from jaxba.pipeline._tuning import Tuning
from jaxba.pipeline.features import Outputs
from jaxba.scene import Features


class Detected(Mapping[int, Features]):
    """Features by image index, opened on access.

    - `routing`: of the block; it does not count for a fingerprint.
    """

    def __init__(self, folders: Mapping[int, Path], digests: Mapping[int, str], routing: Routing) -> None:
        self.features: Stored[Features] = Stored(Outputs, "features", folders, digests)
        self.routing = routing

    @functools.cached_property
    def tunings(self) -> Mapping[int, Tuning]:
        """How each photo was looked at."""
        return dict(Stored(Outputs, "tuning", self.features.folders, self.features.digests))

    @property
    def digests(self) -> Mapping[int, str]:
        """What counts for a fingerprint."""
        return self.features.digests

    def only(self, indices: Sequence[int]) -> Stored[Features]:
        """Return the features of some photos, counted anew from 0 in the order given."""
        return self.features.only(indices)

    def __getitem__(self, index: int) -> Features:
        return self.features[index]

    def __iter__(self) -> Iterator[int]:
        return iter(self.features)

    def __len__(self) -> int:
        return len(self.features)
