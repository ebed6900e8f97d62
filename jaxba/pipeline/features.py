"""Stage features: keypoints and descriptors of one photo, none where its mask is black.

The runner calls it once a photo, in worker processes.
"""

import functools
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import UInt8

from jaxba._errors import JaxbaError
from jaxba.engine import Resources
from jaxba.engine._limits import check_room
from jaxba.engine._parameters import Parameters, parameter
from jaxba.engine._store import Stored
from jaxba.engine._workers import megapixels_of
from jaxba.pipeline._routing import Routing
from jaxba.report import Told, grouped, with_ranges
from jaxba.scene import DETECTORS, LEARNED, Features, LeftOut, Photo, described
from jaxba.vision import (
    CONDITIONS,
    OrbOptions,
    Pixels,
    Tuning,
    check_detector,
    decode,
    detect_features,
    learned_bytes,
    measure_image,
    most_keypoints,
    read_mask,
    store_bytes,
    tune,
)

_CONTRAST_FLOOR = 0.02


@dataclass(frozen=True, kw_only=True)
class Inputs:
    """- `photo`: one usable frame.
    - `detector`: of the whole block, for `auto`. `is_height_varying`: the block shows the ground at several scales.
    """

    photo: Photo
    detector: str = "sift"
    is_height_varying: bool = False


@dataclass(frozen=True, kw_only=True)
class Params(Parameters):
    """What the user may set."""

    detector: str = parameter(
        "auto",
        choices=("auto", *DETECTORS),
        help="kind of features, of all photos; auto: SIFT over sift_gsd, under sift_overlap or where these are "
        "unknown, else ORB; aliked and xfeat are learned, and need more packages",
    )
    sift_gsd: float = parameter(0.05, low=0.005, high=1, help="m/px; auto takes SIFT over this ground sample distance")
    sift_overlap: float = parameter(
        0.70, low=0.3, high=0.95, help="auto takes SIFT where photos overlap the nearest by less (median)"
    )
    condition: str = parameter(
        "auto",
        choices=("auto", "none", *CONDITIONS),
        several=True,
        help="what thresholds that are not set follow; auto measures each photo; several by commas",
    )
    nfeatures: int | None = parameter(
        None,
        low=2000,
        high=20000,
        help="the most keypoints an image; none: 8000 SIFT and AKAZE, 10000 ORB, 2000 a turn learned",
    )
    contrast_threshold: float | None = parameter(
        None,
        low=0.02,
        high=0.08,
        help="SIFT: weaker extrema are dropped; none: 0.04, 0.03 in low light or over water, and where fewer than "
        "nfeatures reach it, 0.02",
    )
    edge_threshold: float | None = parameter(
        None, low=5, high=20, help="SIFT: extrema on edges over it are dropped; none: 10, 15 over rows and roofs"
    )
    sigma: float = parameter(1.6, low=1.0, high=2.5, help="SIFT: blur of the first octave, px")
    fast_threshold: int | None = parameter(
        None, low=5, high=50, help="ORB: grey levels that make a corner; none: 20, 15 over water and flat ground"
    )
    nlevels: int | None = parameter(
        None, low=4, high=12, help="ORB: levels of the pyramid; none: 8, 10 at varying height or oblique"
    )
    scale_factor: float = parameter(1.2, low=1.05, high=2, help="ORB: between levels of the pyramid")
    orb_edge: int = parameter(31, low=5, high=63, help="ORB: border without keypoints, px of each level")
    orb_patch: int = parameter(31, low=15, high=63, help="ORB: side of what a keypoint describes, px of each level")
    orb_score: str = parameter("harris", choices=("harris", "fast"), help="ORB: by which the strongest are kept")
    wta_k: int = parameter(2, low=2, high=4, help="ORB: pixels compared at a time; 3 and 4 double the descriptors")
    learned_side: int = parameter(
        1600, low=640, high=6000, help="learned: px of the longer side, to which larger photos are scaled"
    )

    def check_installed(self) -> None:
        check_detector(self.detector)


@dataclass(frozen=True, kw_only=True)
class Outputs:
    """- `features`: of the photo. `tuning`: how it was looked at, and why."""

    features: Features
    tuning: Tuning


class Detected(Mapping[int, Features]):
    """What the stage found of all photos: features by image index, opened on access, and how each was looked at.

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


def run(inputs: Inputs, params: Params) -> Outputs:
    """Detect and describe the features of one photo.

    Raises `JaxbaError` where the file cannot be decoded, or is not the one whose size the metadata stage read.
    """
    photo = inputs.photo
    pixels = decode(photo.path)
    height, width = pixels.gray.shape
    if (width, height) != (photo.width_px, photo.height_px):
        raise JaxbaError(
            f"{photo.name} has {width} x {height} pixels, and had {photo.width_px} x {photo.height_px} before; "
            "the file was changed meanwhile: run again from the metadata stage."
        )
    conditions = tuple(condition.strip() for condition in params.condition.split(","))
    if inputs.is_height_varying and "auto" in conditions:
        conditions = (*conditions, "varying_height")
    statistics, notes = None, ()
    if "auto" in conditions:
        statistics, notes = described("light and texture", lambda: measure_image(pixels.gray), None)
    tuning = tune(
        inputs.detector if params.detector == "auto" else params.detector,
        conditions,
        statistics,
        nfeatures=params.nfeatures,
        contrast_threshold=params.contrast_threshold,
        edge_threshold=params.edge_threshold,
        fast_threshold=params.fast_threshold,
        nlevels=params.nlevels,
    )
    mask = None if photo.mask is None else read_mask(photo.mask.path, photo.width_px, photo.height_px)
    found = _detect(pixels, mask, tuning, params)
    return Outputs(features=replace(found, notes=(*found.notes, *notes)), tuning=tuning)


def check_store(store: Path, num_photos: int, detector: str, params: Params, resources: Resources) -> None:
    """Raise `JaxbaError` where the features of so many photos may not fit, or may take more than is allowed.

    - `store`: the folder where they are to lie. `detector`: of all photos.
    """
    nfeatures = most_keypoints(detector, params.nfeatures)
    check_room(
        store,
        store_bytes(num_photos, detector, nfeatures),
        resources,
        what=f"the features of {num_photos:,} photos",
        each=f"at {nfeatures:,} keypoints a photo",
        cure="Set fewer features.nfeatures, take fewer photos",
    )


def megapixels_to_hold(photo: Photo, detector: str, params: Params) -> float:
    """Return the size of the photo that needs as much memory with SIFT as this one with a detector."""
    if detector not in LEARNED:
        return photo.megapixels
    scale = min(1.0, params.learned_side / max(photo.width_px, photo.height_px))
    return max(photo.megapixels, megapixels_of(learned_bytes(detector, photo.megapixels * scale**2)))


def lines(outputs: Detected, told: Told) -> list[str]:
    """Return what was made of all photos, in words."""
    found = {index: outputs[index] for index in sorted(outputs)}
    counts = [features.num_keypoints for features in found.values()]
    first = f"{sum(counts):,} keypoints, median {int(np.median(counts)):,} an image" if counts else "no keypoints"
    used = [i for i, features in found.items() if features.num_keypoints]
    texts = [(i, text) for i in used for text in (*outputs.tunings[i].reasons, *found[i].notes)]
    odd = [LeftOut(name=told.photos[i], reason=text) for i, text in texts]
    return [first, *outputs.routing.reasons, *grouped(told.left_out), *grouped(with_ranges(odd))]


def facts(outputs: Detected, told: Told) -> dict[str, Any]:
    """Return the decision on the detector with its figures, and how each photo was looked at, with those of its own."""
    photos = {told.photos[i]: asdict(outputs.tunings[i]) for i in sorted(outputs)}
    return {"features": {"routing": asdict(outputs.routing), "photos": photos}}


def _detect(pixels: Pixels, mask: UInt8[np.ndarray, "height width"] | None, tuning: Tuning, params: Params) -> Features:
    if tuning.detector == "sift":
        assert tuning.contrast_threshold is not None and tuning.edge_threshold is not None
        return detect_features(
            pixels,
            nfeatures=tuning.nfeatures,
            contrast_threshold=tuning.contrast_threshold,
            contrast_floor=_CONTRAST_FLOOR if params.contrast_threshold is None else params.contrast_threshold,
            edge_threshold=tuning.edge_threshold,
            sigma=params.sigma,
            mask=mask,
        )
    if tuning.detector != "orb":
        return detect_features(
            pixels, detector=tuning.detector, nfeatures=tuning.nfeatures, side_px=params.learned_side, mask=mask
        )
    assert tuning.fast_threshold is not None and tuning.nlevels is not None
    options = OrbOptions(
        fast_threshold=tuning.fast_threshold,
        nlevels=tuning.nlevels,
        scale_factor=params.scale_factor,
        edge_px=params.orb_edge,
        patch_px=params.orb_patch,
        wta_k=params.wta_k,
        score=params.orb_score,
    )
    return detect_features(pixels, detector="orb", nfeatures=tuning.nfeatures, orb=options, mask=mask)
