"""Where two images may show the same ground, from their largest features: what lies outside need not be compared.

An exact search over all features costs the product of their numbers. The `_COARSE` largest features of both, 3% of that
cost, match well enough to fit a homography, loose enough for relief; features that it maps outside the other image by
more than a margin have no partner there. At half an overlap the search is left with a quarter of its products. The
ratio test then knows no second nearest from outside the common ground, where nothing can match.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxba.vision._nearest import Descriptors, match_descriptors

_COARSE = 1500
_LEAST_MATCHES, _LEAST_INLIERS, _LEAST_SHARE = 16, 12, 0.5
_APART = 5  # coarse matches below which two images are apart
_LOOSE, _MARGIN = 0.02, 0.12  # of the longer side


@dataclass(frozen=True, kw_only=True, eq=False)
class CommonGround:
    """Features of both images that may have a partner in the other one; all of them where that is unknown.

    - `is_apart`: so few of the largest features match that the images show different ground.
    """

    first: Int[np.ndarray, " rows"]
    second: Int[np.ndarray, " columns"]
    is_apart: bool


def common_ground(
    first: Descriptors,
    second: Descriptors,
    first_px: Float[np.ndarray, "rows 2"],
    second_px: Float[np.ndarray, "columns 2"],
    first_size_px: tuple[int, int],
    second_size_px: tuple[int, int],
    ratio: float,
) -> CommonGround:
    """Return the features that need to be compared; the best features come first, as `detect_features` orders them."""
    everything = np.arange(len(first_px)), np.arange(len(second_px))
    coarse = match_descriptors(first.take(everything[0][:_COARSE]), second.take(everything[1][:_COARSE]), ratio)[0]
    whole = CommonGround(first=everything[0], second=everything[1], is_apart=len(coarse) < _APART)
    if len(coarse) < _LEAST_MATCHES:
        return whole
    mapped = _homography(first_px[coarse[:, 0]], second_px[coarse[:, 1]], max(*first_size_px, *second_size_px))
    if mapped is None:
        return whole
    rows = _lands_inside(mapped, first_px, first_size_px, second_size_px)
    columns = _lands_inside(np.linalg.inv(mapped), second_px, second_size_px, first_size_px)
    if rows is None or columns is None:
        return whole
    return CommonGround(first=np.flatnonzero(rows), second=np.flatnonzero(columns), is_apart=False)


def _homography(
    first_px: Float[np.ndarray, "matches 2"], second_px: Float[np.ndarray, "matches 2"], side_px: int
) -> Float[np.ndarray, "3 3"] | None:
    """Return the homography of most of the matches, seconds from firsts; None if no one explains them."""
    import cv2

    x, y = np.asarray(first_px, np.float64), np.asarray(second_px, np.float64)
    found, mask = cv2.findHomography(x, y, cv2.USAC_MAGSAC, _LOOSE * side_px, maxIters=2000, confidence=0.999)
    if found is None or mask.sum() < max(_LEAST_INLIERS, _LEAST_SHARE * len(x)) or abs(np.linalg.det(found)) < 1e-9:
        return None
    return found


def _lands_inside(
    mapped: Float[np.ndarray, "3 3"],
    xy_px: Float[np.ndarray, "rows 2"],
    size_px: tuple[int, int],
    other_size_px: tuple[int, int],
) -> Bool[np.ndarray, " rows"] | None:
    """Return which pixels are mapped into the other image or near it; None where part of this one has no place."""
    corners = np.array([[0, 0], [1, 0], [1, 1], [0, 1]]) * size_px
    depth = np.concatenate([corners, xy_px]) @ mapped[2, :2] + mapped[2, 2]
    if not (np.all(depth > 0) or np.all(depth < 0)):
        return None
    landed = (xy_px @ mapped[:2, :2].T + mapped[:2, 2]) / depth[4:, None]
    margin = _MARGIN * max(other_size_px)
    return np.all((landed > -margin) & (landed < np.array(other_size_px) + margin), axis=1)
