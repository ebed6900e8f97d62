"""Which detector a block gets, and which conditions hold for all of its photos: decided once, with the figures.

Features of two kinds do not match, so one detector serves the whole block. SIFT holds where photos are coarse, since a
pixel then blurs what ORB's corners are, or overlap little, since few and oblique views must still match; ORB is for
fine photos with much overlap. What is unknown counts against ORB.

Ground sample distance: height above ground over focal length in pixels, of the photos as they are given; the median
of the photos that have both. Overlap: the median over photos of the largest overlap with any other photo, which is the
forward overlap of a flight in lines, from the footprints of the pairs stage.

Measured (`python -m benchmarks.detectors`): ORB adjusts the same photos with the same fit to GNSS, at 0.25 to 0.29 px
where SIFT has 0.10 to 0.20, with half of its points seen three times over forest and field and four fifths in a
simulated survey of 4 cm/px and 80% overlap, which `auto` gives to ORB. Its features take a fifth of the time, its
matches more: in all 0.9 to 1.1 times SIFT's processor time, and 3 times where a third of the pairs fall back to SIFT.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from jaxba.scene import Photo, Reference, described

_HEIGHT_RATIO = 1.2  # one level of ORB's pyramid
_OBLIQUE_RAD, _OBLIQUE_SHARE = np.deg2rad(20.0), 0.1


@dataclass(frozen=True, kw_only=True)
class Routing:
    """The detector of a block, and the figures behind it; NaN where one is unknown.

    - `detector`: of all photos. `is_height_varying`: the photos show the ground at several scales.
    - `gsd_m`: median ground sample distance, a pixel. `overlap`: median over photos of the largest with another.
    - `num_gsd`, `num_overlap`: photos that have one, of `num_photos`.
    - `height_ratio`: of the heights above ground, the 95th percentile over the 5th. `oblique_share`: of the photos with
      an attitude, those tilted by over 20 degrees.
    - `reasons`: in sentences, the decision first.
    """

    detector: str
    is_height_varying: bool
    gsd_m: float
    overlap: float
    num_gsd: int
    num_overlap: int
    num_photos: int
    height_ratio: float
    oblique_share: float
    reasons: tuple[str, ...]


def route(
    photos: tuple[Photo, ...],
    reference: Reference,
    pairs: Int[np.ndarray, "pairs 2"],
    overlap: Float[np.ndarray, " pairs"],
    *,
    detector: str = "auto",
    sift_gsd_m: float = 0.05,
    sift_overlap: float = 0.70,
) -> Routing:
    """Return the detector of a block.

    - `reference`: its heights above ground and attitudes. `pairs`, `overlap`: candidates, NaN where unknown.
    - `detector`: `auto`, or one that is set. `sift_gsd_m`: SIFT over it. `sift_overlap`: SIFT under it.
    """
    height_m = reference.height_above_ground_m
    gsd_m = height_m / np.array([photo.focal_px or np.nan for photo in photos], float)
    largest = _largest_overlap(pairs, overlap, len(photos))
    typical_gsd_m, typical_overlap = _median(gsd_m), _median(largest)
    num_gsd, num_overlap = int(np.isfinite(gsd_m).sum()), int(np.isfinite(largest).sum())
    gsd_text = f"ground sample distance {100 * typical_gsd_m:.1f} cm/px (median of {num_gsd} photos)"
    overlap_text = f"largest overlap of a photo {typical_overlap:.0%} (median of {num_overlap})"
    against = [
        f"ground sample distance unknown ({_unknown_gsd(photos, height_m)})" if np.isnan(typical_gsd_m) else "",
        f"{gsd_text}, over {100 * sift_gsd_m:g} (features.sift_gsd)" if typical_gsd_m > sift_gsd_m else "",
        "overlap unknown (no footprints)" if np.isnan(typical_overlap) else "",
        f"{overlap_text}, under {sift_overlap:.0%} (features.sift_overlap)" if typical_overlap < sift_overlap else "",
    ]
    against = [text for text in against if text]
    if detector != "auto":
        chosen, reason = detector, "set by features.detector."
    elif against:
        chosen, reason = "sift", f"{'; '.join(against)}."
    else:
        chosen = "orb"
        reason = f"{gsd_text}, not over {100 * sift_gsd_m:g}; {overlap_text}, not under {sift_overlap:.0%}."
    ratio, odd = described("the range of heights above ground", lambda: _height_ratio(height_m), np.nan)
    oblique, more = described("the tilt of the photos", lambda: _oblique_share(reference), np.nan)
    varying = _varying_height(ratio, oblique)
    return Routing(
        detector=chosen,
        is_height_varying=bool(varying),
        gsd_m=typical_gsd_m,
        overlap=typical_overlap,
        num_gsd=num_gsd,
        num_overlap=num_overlap,
        num_photos=len(photos),
        height_ratio=ratio,
        oblique_share=oblique,
        reasons=(
            f"Detector {chosen.upper()}: {reason}",
            *varying,
            *(f"{note[0].upper()}{note[1:]}." for note in (*odd, *more)),
        ),
    )


def _largest_overlap(
    pairs: Int[np.ndarray, "pairs 2"], overlap: Float[np.ndarray, " pairs"], num_photos: int
) -> Float[np.ndarray, " photos"]:
    """Return each photo's largest known overlap with another; NaN where none is known."""
    largest = np.full(num_photos, -np.inf)
    known = np.isfinite(overlap)
    for side in (0, 1):
        np.maximum.at(largest, pairs[known, side], overlap[known])
    return np.where(np.isfinite(largest), largest, np.nan)


def _unknown_gsd(photos: tuple[Photo, ...], height_m: Float[np.ndarray, " photos"]) -> str:
    without = [not np.isfinite(height_m).any(), all(photo.focal_px is None for photo in photos)]
    names = [name for name, missing in zip(("heights above ground", "focal lengths"), without, strict=True) if missing]
    return f"no {' and no '.join(names) if names else 'photo has both height above ground and focal length'}"


def _height_ratio(height_m: Float[np.ndarray, " photos"]) -> float:
    known = height_m[np.isfinite(height_m) & (height_m > 0)]
    return float(np.percentile(known, 95) / np.percentile(known, 5)) if len(known) else np.nan


def _oblique_share(reference: Reference) -> float:
    from scipy.spatial.transform import Rotation

    known = np.isfinite(reference.quaternion).all(axis=1)
    if not known.any():
        return np.nan
    axis = Rotation.from_quat(reference.quaternion[known], scalar_first=True).as_matrix()[:, 2]  # of view, in the world
    return float(np.mean(np.arccos(np.clip(-axis[:, 2], -1, 1)) > _OBLIQUE_RAD))


def _varying_height(ratio: float, oblique: float) -> tuple[str, ...]:
    """Return why the photos show the ground at several scales; nothing where they do not."""
    texts = [
        f"heights above ground differ by a factor of {ratio:.2f}" if ratio > _HEIGHT_RATIO else "",
        f"{oblique:.0%} of the photos are tilted by over 20 degrees" if oblique >= _OBLIQUE_SHARE else "",
    ]
    found = [text for text in texts if text]
    return (f"Varying height: {'; '.join(found)}.",) if found else ()


def _median(values: Float[np.ndarray, " photos"]) -> float:
    known = values[np.isfinite(values)]
    return float(np.median(known)) if len(known) else np.nan
