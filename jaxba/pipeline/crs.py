"""Stage crs: the target CRS, positions and attitudes in the local frame, and which positions are trusted."""

from dataclasses import dataclass

from jaxba.pipeline._parameters import Parameters, parameter
from jaxba.scene import Photo, Reference


@dataclass(frozen=True, kw_only=True)
class Inputs:
    """- `photos`: of the metadata stage."""

    photos: tuple[Photo, ...]


@dataclass(frozen=True, kw_only=True)
class Params(Parameters):
    """What the user may set."""

    target_crs: str | None = parameter(None, help="projected CRS of the results; none proposes the UTM zone")
    h_accuracy_threshold: float = parameter(
        2.0, low=0.05, high=5, help="a stated horizontal accuracy over this, metres, goes to review"
    )
    altitude_variance: float = parameter(
        0.05, low=0.01, high=0.5, help="off the median by more than this share of the flight height goes to review"
    )


@dataclass(frozen=True, kw_only=True)
class Outputs:
    """- `reference`: positions and attitudes in the local frame, a row a photo."""

    reference: Reference


def run(inputs: Inputs, params: Params) -> Outputs:
    """Turn measured positions into the local frame and judge them."""
    raise NotImplementedError
