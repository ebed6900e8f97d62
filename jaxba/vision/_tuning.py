"""How one photo is looked at: the detector's parameters by the conditions that hold for it, with the figures.

| condition | measured | SIFT | ORB |
| --- | --- | --- | --- |
| low_light | mean brightness under 80 of 255 | contrast_threshold 0.03 for 0.04 | |
| rows | over 20% of the squares repeat: rows, roofs, panels | edge_threshold 15 for 10 | |
| water | over 30% of the cells are flat: water, snow, fog | contrast_threshold 0.03 | fast_threshold 15 for 20 |
| varying_height | of the block: heights above ground, tilts | | nlevels 10 for 8 |

A parameter that the user set stays as it is.
"""

from dataclasses import dataclass

from jaxba.vision._learned import TURNS
from jaxba.vision._statistics import ImageStatistics

CONDITIONS = ("low_light", "rows", "water", "varying_height")

_OTHER_BYTES = 35.0  # of a keypoint: position, size and angle in float64, colour
_DESCRIPTOR_BYTES = {"orb": 32, "akaze": 61}
_LEARNED_BYTES = {"aliked": 128, "xfeat": 64}
_SIFT_BYTES, _SIFT_ORIENTATIONS = 128, 1.3  # up to 1.25 were measured at 2000 keypoints a photo
_PHOTO_BYTES = 6000  # record and headers
_DARK, _REPEATING, _FLAT = 80.0, 0.2, 0.3
_BASE: dict[str, dict[str, float | int]] = {
    "sift": {"nfeatures": 8000, "contrast_threshold": 0.04, "edge_threshold": 10.0},
    "orb": {"nfeatures": 10000, "fast_threshold": 20, "nlevels": 8},
    "akaze": {"nfeatures": 8000},
    "aliked": {"nfeatures": 2000},
    "xfeat": {"nfeatures": 2000},
}
_EFFECT: dict[tuple[str, str], tuple[str, float | int]] = {
    ("low_light", "sift"): ("contrast_threshold", 0.03),
    ("rows", "sift"): ("edge_threshold", 15.0),
    ("water", "sift"): ("contrast_threshold", 0.03),
    ("water", "orb"): ("fast_threshold", 15),
    ("varying_height", "orb"): ("nlevels", 10),
}


@dataclass(frozen=True, kw_only=True)
class Tuning:
    """How a photo was looked at.

    - `nfeatures` and after: the parameters that were used; None where the detector has no such parameter.
    - `conditions`: those that hold. `statistics`: measured of the photo; None where conditions were set by name.
    - `reasons`: in words, one a condition, with what it changed.
    """

    detector: str
    nfeatures: int
    contrast_threshold: float | None = None
    edge_threshold: float | None = None
    fast_threshold: int | None = None
    nlevels: int | None = None
    conditions: tuple[str, ...] = ()
    statistics: ImageStatistics | None = None
    reasons: tuple[str, ...] = ()


def tune(
    detector: str,
    conditions: tuple[str, ...],
    statistics: ImageStatistics | None,
    *,
    nfeatures: int | None = None,
    contrast_threshold: float | None = None,
    edge_threshold: float | None = None,
    fast_threshold: int | None = None,
    nlevels: int | None = None,
) -> Tuning:
    """Return how a photo is looked at.

    - `conditions`: that hold for it by name or for the block. `statistics`: of the photo, for the others, or None.
    - `nfeatures` and after: as the user set them; None follows the detector and the conditions.

    >>> tune("sift", ("rows",), None, nfeatures=5000).edge_threshold
    15.0
    """
    given = {
        "nfeatures": nfeatures,
        "contrast_threshold": contrast_threshold,
        "edge_threshold": edge_threshold,
        "fast_threshold": fast_threshold,
        "nlevels": nlevels,
    }
    measured = {} if statistics is None else _measured(statistics)
    values = {name: base if given[name] is None else given[name] for name, base in _BASE[detector].items()}
    reasons = []
    for condition in (c for c in CONDITIONS if c in conditions or c in measured):
        why = measured.get(condition, "of the block" if condition == "varying_height" else "set by features.condition")
        name, value = _EFFECT.get((condition, detector), ("", 0))
        if not name:
            effect = f"changes nothing for {detector.upper()}"
        elif given[name] is not None:
            effect = f"{name} stays as set, {given[name]:g}"
        else:
            values[name], effect = value, f"{name} {value:g}"
        reasons.append(f"{condition.replace('_', ' ')} ({why}): {effect}")
    holding = tuple(c for c in CONDITIONS if c in conditions or c in measured)
    return Tuning(detector=detector, conditions=holding, statistics=statistics, reasons=tuple(reasons), **values)  # pyright: ignore


def _measured(statistics: ImageStatistics) -> dict[str, str]:
    """Return the conditions that a photo's statistics tell, each with its figure."""
    bright, flat, repeating = statistics.mean_brightness, statistics.flat_share, statistics.repeating_share
    found = {
        "low_light": (bright < _DARK, f"mean brightness {bright:.0f} of 255, under {_DARK:g}"),
        "rows": (repeating > _REPEATING, f"{repeating:.0%} of the squares repeat, over {_REPEATING:.0%}"),
        "water": (flat > _FLAT, f"{flat:.0%} of the cells are flat, over {_FLAT:.0%}"),
    }
    return {name: text for name, (holds, text) in found.items() if holds}


def most_keypoints(detector: str, nfeatures: int | None) -> int:
    """Return the most keypoints that a photo has: as set, or the detector's own number."""
    return tune(detector, (), None, nfeatures=nfeatures).nfeatures


def store_bytes(num_photos: int, detector: str, nfeatures: int) -> float:
    """Return the bytes that the features of so many photos take on the disk at most."""
    if detector in _DESCRIPTOR_BYTES:
        keypoint = _DESCRIPTOR_BYTES[detector] + _OTHER_BYTES
    elif detector in _LEARNED_BYTES:
        keypoint = (_LEARNED_BYTES[detector] + _OTHER_BYTES) * TURNS
    else:
        keypoint = (_SIFT_BYTES + _OTHER_BYTES) * _SIFT_ORIENTATIONS
    return num_photos * (nfeatures * keypoint + _PHOTO_BYTES)
