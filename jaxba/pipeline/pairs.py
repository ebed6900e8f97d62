"""Stage pairs: which photos may overlap."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from jaxba.pipeline._parameters import Parameters, parameter
from jaxba.scene import Photo, Reference


@dataclass(frozen=True, kw_only=True)
class Inputs:
    """- `photos`: of the metadata stage. `reference`: of the crs stage."""

    photos: tuple[Photo, ...]
    reference: Reference


@dataclass(frozen=True, kw_only=True)
class Params(Parameters):
    """What the user may set."""

    method: str = parameter(
        "auto", choices=("auto", "footprint", "exhaustive", "sequential"), help="how candidate pairs are found"
    )


@dataclass(frozen=True, kw_only=True, eq=False)
class Outputs:
    """Candidate pairs in rising order.

    - `pairs`: image indices, the first below the second. `overlap`: share of a footprint that both see, NaN if unknown.
    - `method`: how they were found. `num_all`: of all pairs, for the saving. `notes`: what was assumed, in sentences.
    """

    pairs: Int[np.ndarray, "pairs 2"]
    overlap: Float[np.ndarray, " pairs"]
    method: str
    num_all: int
    notes: tuple[str, ...] = ()


def run(inputs: Inputs, params: Params) -> Outputs:
    """Find the candidate pairs."""
    raise NotImplementedError
