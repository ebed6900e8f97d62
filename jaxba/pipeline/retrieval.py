"""Stage retrieval: pairs of photos that look alike, where positions do not tell which overlap.

Beyond `pairs.exhaustive_limit` photos those without a usable position are paired with those near in time or name, which
leaves the lines of a flight apart. Their features say which others look most like them, whatever was in between.

Of simulated photos in lines of 60% side overlap, 30 that look alike and the 20 before and after hold all verified pairs
of the half with more matches, also where names say nothing (`python -m benchmarks.retrieval`); 20 that look alike miss
1 or 2% of them.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from jaxba.engine._parameters import Parameters, parameter
from jaxba.report import Told
from jaxba.scene import Features, rising_pairs


@dataclass(frozen=True, kw_only=True)
class Inputs:
    """- `pairs`, `overlap`, `by_order`: of the pairs stage.

    - `features`: of all photos, by index; empty where every photo has its partners.
    """

    pairs: Int[np.ndarray, "pairs 2"]
    overlap: Float[np.ndarray, " pairs"]
    by_order: Int[np.ndarray, " some"]
    features: Mapping[int, Features]


@dataclass(frozen=True, kw_only=True)
class Params(Parameters):
    """What the user may set."""

    neighbours: int = parameter(
        30, low=0, high=500, help="photos that look most like one without a position are its partners; 0: none are"
    )


@dataclass(frozen=True, kw_only=True, eq=False)
class Outputs:
    """All candidate pairs, in rising order.

    - `pairs`: image indices, the first below the second. `overlap`: share of a footprint that both see, NaN if unknown.
    - `num_added`: of the pairs, those found here. `num_photos`: that partners were looked for.
    """

    pairs: Int[np.ndarray, "pairs 2"]
    overlap: Float[np.ndarray, " pairs"]
    num_added: int
    num_photos: int


def run(inputs: Inputs, params: Params) -> Outputs:
    """Add the pairs of photos that look alike to the candidates."""
    before, overlap = inputs.pairs, inputs.overlap
    if not len(inputs.by_order) or not params.neighbours:
        return Outputs(pairs=before, overlap=overlap, num_added=0, num_photos=0)
    from jaxba.vision import alike_pairs

    found = alike_pairs(inputs.features, inputs.by_order, params.neighbours)
    pairs = rising_pairs(np.concatenate([before, found]))
    size = int(pairs.max(initial=0)) + 1
    key, known = pairs @ [size, 1], before.astype(np.int64) @ [size, 1]
    place = np.searchsorted(key, known)
    of_pairs = np.full(len(pairs), np.nan)
    of_pairs[place] = overlap
    return Outputs(
        pairs=pairs.astype(np.int32),
        overlap=of_pairs,
        num_added=len(pairs) - len(before),
        num_photos=len(inputs.by_order),
    )


def lines(outputs: Outputs, told: Told) -> list[str]:
    """Return what was made, in words."""
    if not outputs.num_photos:
        return ["not needed: every photo has its partners"]
    return [f"{outputs.num_added:,} more pairs, for {outputs.num_photos:,} photos without a usable position"]


def facts(outputs: Outputs, told: Told) -> dict[str, Any]:
    """Return how many pairs were found by what photos look like."""
    return {"retrieval": {"added": outputs.num_added, "photos": outputs.num_photos}}
