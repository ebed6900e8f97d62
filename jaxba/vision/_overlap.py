"""Where two images may show the same ground, from matches of their largest features: the rest need not be compared.

An exact search over all features costs the product of their numbers. A homography of a few matches, loose enough for
relief, tells where the other image lies; features that it maps outside of that by more than a margin have no partner
there. At half an overlap the search is left with a quarter of its products. The ratio test then knows no second nearest
from outside the common ground, where nothing can match.
"""

import numpy as np
from jaxtyping import Bool, Float, Int

_LEAST_MATCHES, _LEAST_INLIERS, _LEAST_SHARE = 16, 12, 0.5
_LOOSE, _MARGIN = 0.02, 0.12  # of the longer side


def common_ground(
    matches: Int[np.ndarray, "matches 2"],
    first_px: Float[np.ndarray, "rows 2"],
    second_px: Float[np.ndarray, "columns 2"],
    first_size_px: tuple[int, int],
    second_size_px: tuple[int, int],
) -> tuple[Int[np.ndarray, " some"], Int[np.ndarray, " others"]]:
    """Return the features of both images that may have a partner in the other one; all of them where it is not known.

    - `matches`: of some of the features.
    """
    whole = np.arange(len(first_px)), np.arange(len(second_px))
    if len(matches) < _LEAST_MATCHES:
        return whole
    mapped = _homography(first_px[matches[:, 0]], second_px[matches[:, 1]], max(*first_size_px, *second_size_px))
    if mapped is None:
        return whole
    rows = _lands_inside(mapped, first_px, first_size_px, second_size_px)
    columns = _lands_inside(np.linalg.inv(mapped), second_px, second_size_px, first_size_px)
    if rows is None or columns is None:
        return whole
    return np.flatnonzero(rows), np.flatnonzero(columns)


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
