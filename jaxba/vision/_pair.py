"""The matches of two photos and their relative pose, in steps of which each spares the next one work.

1. The largest features of both are compared, 3% of the products of all, and where too few of them agree on a geometry
   so many more, 14%. If no more than a few match, the photos show different ground.
2. Where they do not agree, the `_MOST` largest are compared, those on the common ground (see `_overlap.py`). They need
   only find the geometry: of 178 pairs with 30 verified matches by all 10,000 features one was lost, which had just 30.
3. The geometry guides a second search (see `_guided.py`), whose matches are verified in place of the first ones. What
   few matches foretell is good to some ten pixels, so that they guide a first search without epipolar lines.
"""

import dataclasses
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from jaxba.scene import described
from jaxba.vision._guided import guided_matches
from jaxba.vision._nearest import Descriptors, match_descriptors
from jaxba.vision._overlap import common_ground
from jaxba.vision._two_view import Pinhole, PosePrior, TwoView, verify

_LARGEST = (1500, 3000)  # features
_MOST = 5000  # of them, where these do not agree
_APART = 5  # matches of them below which two images are apart
_NO_LINES = np.full((3, 3), np.nan)
_WIDER = 1.5  # the band about an epipolar line, against the threshold
_AGREED, _AGREED_SHARE = 16, 0.6  # matches of them that make a geometry, also as a share


@dataclass(frozen=True, kw_only=True, eq=False)
class View:
    """A photo ready to be matched: its features, the largest (or strongest) first, and its pinhole."""

    xy_px: Float[np.ndarray, "features 2"]
    descriptors: Descriptors
    pinhole: Pinhole

    @property
    def size_px(self) -> tuple[int, int]:
        return self.pinhole.width_px, self.pinhole.height_px


@dataclass(frozen=True, kw_only=True)
class PairOptions:
    """How a pair is matched and verified; see `match_descriptors` and `verify`."""

    ratio: float
    threshold_px: float
    epipolar_threshold_px: float | None
    confidence: float
    min_inliers: int


@dataclass(frozen=True, kw_only=True, eq=False)
class PairMatches:
    """The matches of two photos, rising by the first's features, how distinct each is, and their geometry.

    - `num_putative`: matches of the search that found the geometry, with what was found by it beyond its inliers.
    - `notes`: what could not be measured.
    """

    matches: Int[np.ndarray, "matches 2"]
    distinctiveness: Float[np.ndarray, " matches"]
    two_view: TwoView
    num_putative: int
    notes: tuple[str, ...] = ()


def match_pair(first: View, second: View, options: PairOptions, prior: PosePrior | None) -> PairMatches:
    """Return the matches of two photos; those of different ground have none."""
    found = _largest(first, second, options, prior)
    if found.two_view.model != "none":
        found = _guided(first, second, found, _NO_LINES, options, prior)
        if not np.isfinite(found.two_view.fundamental).all():
            return found
    elif found.num_putative >= _APART:
        found = _of_most(first, second, found, options, prior)
    if found.two_view.model != "none":
        found = _guided(first, second, found, found.two_view.fundamental, options, prior)
    return found


def _largest(first: View, second: View, options: PairOptions, prior: PosePrior | None) -> PairMatches:
    """Return the matches of the largest features; without a geometry where too few agree on one."""
    for count in _LARGEST:
        some = first.descriptors.first(count), second.descriptors.first(count)
        matches, distinctiveness = match_descriptors(*some, options.ratio)
        found = _verified(first, second, matches, distinctiveness, options, prior)
        if found.two_view.num_inliers >= max(_AGREED, _AGREED_SHARE * len(matches)):
            return found
    nothing = dataclasses.replace(found.two_view, model="none", is_inlier=np.zeros(len(matches), bool))
    return dataclasses.replace(found, two_view=nothing)


def _of_most(
    first: View, second: View, largest: PairMatches, options: PairOptions, prior: PosePrior | None
) -> PairMatches:
    ground, notes = described(
        "common ground",
        lambda: common_ground(
            largest.matches, first.xy_px[:_MOST], second.xy_px[:_MOST], first.size_px, second.size_px
        ),
        None,
    )
    own, other = first.descriptors.first(_MOST), second.descriptors.first(_MOST)
    if ground is not None:  # it only spares comparisons
        own, other = own.take(ground[0]), other.take(ground[1])
    matches, distinctiveness = match_descriptors(own, other, options.ratio)
    return dataclasses.replace(_verified(first, second, matches, distinctiveness, options, prior), notes=notes)


def _guided(
    first: View,
    second: View,
    begun: PairMatches,
    fundamental: Float[np.ndarray, "3 3"],
    options: PairOptions,
    prior: PosePrior | None,
) -> PairMatches:
    """Return the matches that a geometry leads to, where they are no fewer than those that told of it."""
    matches, distinctiveness = guided_matches(
        first.descriptors,
        second.descriptors,
        first.xy_px,
        second.xy_px,
        second.size_px,
        begun.matches[begun.two_view.is_inlier],
        fundamental,
        line_px=_WIDER * (options.epipolar_threshold_px or options.threshold_px),
        ratio=options.ratio,
    )
    found = _verified(first, second, matches, distinctiveness, options, prior)
    gained = found.two_view.num_inliers - begun.two_view.num_inliers
    if gained < 0:
        return begun
    return dataclasses.replace(found, num_putative=begun.num_putative + gained, notes=begun.notes)


def _verified(
    first: View,
    second: View,
    matches: Int[np.ndarray, "matches 2"],
    distinctiveness: Float[np.ndarray, " matches"],
    options: PairOptions,
    prior: PosePrior | None,
) -> PairMatches:
    two_view = verify(
        first.xy_px[matches[:, 0]],
        second.xy_px[matches[:, 1]],
        first.pinhole,
        second.pinhole,
        threshold_px=options.threshold_px,
        epipolar_threshold_px=options.epipolar_threshold_px,
        confidence=options.confidence,
        min_inliers=options.min_inliers,
        prior=prior,
    )
    return PairMatches(matches=matches, distinctiveness=distinctiveness, two_view=two_view, num_putative=len(matches))
