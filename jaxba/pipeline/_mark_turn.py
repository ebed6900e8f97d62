"""Marks that were set in turned photos: which turn brings them onto the stored pixel grid.

Photos are used as they are stored, and marks count there. Many viewers turn a photo by its EXIF orientation before
marks are set in it. Then marks lie on the opposite side, or beyond the edges of a photo that lies on its side. Where
positions, attitudes and focal lengths tell roughly where each point is seen, all eight orientations are tried against
that; where nothing tells it, a turn is found only by marks that lie outside.

A turn is never applied unasked: it is named, with the parameter that applies it.
"""

from collections.abc import Callable, Mapping, Sequence

import numpy as np
from jaxtyping import Float, Int

from jaxba.scene import Photo, Reference

TURNS = {
    2: "mirrored left to right",
    3: "turned by 180 degrees",
    4: "mirrored top to bottom",
    5: "mirrored and turned by 90 degrees counterclockwise",
    6: "turned by 90 degrees clockwise",
    7: "mirrored and turned by 90 degrees clockwise",
    8: "turned by 90 degrees counterclockwise",
}
"""What each EXIF orientation does to a photo that is shown."""
_FITS = 0.15  # of the longer side, median, twice outside: positions of metres and tilts of degrees see points so near
_CLEARLY = 0.5  # of the distance on the stored grid
_LEAST_MARKS = 3
_OTHER_SIZE = 1.3  # at least, of photos that marks were set in over the photos: nearer, what is expected may err
_NEARLY = 1.2  # the photos' own orientation counts before others that fit about as well


def shown_size(
    size_px: Float[np.ndarray, "marks 2"], orientation: Int[np.ndarray, " marks"]
) -> Float[np.ndarray, "marks 2"]:
    """Return width and height of photos as they are shown under an EXIF orientation."""
    return np.where((orientation >= 5)[:, None], size_px[:, ::-1], size_px)


def on_stored_grid(
    xy_px: Float[np.ndarray, "marks 2"], size_px: Float[np.ndarray, "marks 2"], orientation: Int[np.ndarray, " marks"]
) -> Float[np.ndarray, "marks 2"]:
    """Return pixels of photos that are shown under an EXIF orientation on the stored grid of `size_px`.

    >>> on_stored_grid(np.array([[10.0, 20.0]]), np.array([[400.0, 300.0]]), np.array([6]))
    array([[ 20., 290.]])
    """
    u, v = xy_px.T
    width, height = size_px.T
    x = np.choose(orientation - 1, [u, width - u, width - u, u, v, v, width - v, width - v])
    y = np.choose(orientation - 1, [v, v, height - v, height - v, u, height - u, height - u, u])
    return np.stack([x, y], axis=1)


def best_turn(
    placed: Callable[[Int[np.ndarray, " marks"]], Float[np.ndarray, "marks 2"] | None],
    orientation: Int[np.ndarray, " marks"],
    expected_px: Float[np.ndarray, "marks 2"] | None,
    side_px: float,
) -> tuple[str, Mapping[str, float]]:
    """Return the turn that fits, `stored` where none is clearly better, and each one's median distance in px.

    - `placed`: marks on the stored grid under orientations; None where they do not lie in their photos.
    - `orientation`: of each mark's photo by EXIF. `expected_px`: where each is expected, NaN where that is unknown.

    A turn is `exif`, each photo's own, or a number for all.
    """
    candidates = {"stored": np.ones_like(orientation)}
    if (orientation > 1).any():
        candidates["exif"] = orientation
    candidates |= {str(turn): np.full_like(orientation, turn) for turn in TURNS}
    places = {name: xy_px for name, turns in candidates.items() if (xy_px := placed(turns)) is not None}
    known = np.zeros(len(orientation), bool) if expected_px is None else np.isfinite(expected_px).all(axis=1)
    if expected_px is None or known.sum() < _LEAST_MARKS:
        return ("exif" if "stored" not in places and "exif" in places else "stored"), {}
    away_px = {name: float(np.median(np.hypot(*(xy_px - expected_px)[known].T))) for name, xy_px in places.items()}
    if not away_px:
        return "stored", {}
    best = min(away_px, key=lambda name: away_px[name])
    best = next((name for name in ("stored", "exif") if away_px.get(name, np.inf) <= _NEARLY * away_px[best]), best)
    limit_px = min(_FITS * side_px, _CLEARLY * away_px["stored"]) if "stored" in away_px else 2 * _FITS * side_px
    if away_px[best] > limit_px:
        return "stored", away_px
    return best, away_px


def other_size(
    xy_px: Float[np.ndarray, "marks 2"], expected_px: Float[np.ndarray, "marks 2"], side_px: float
) -> tuple[float, float, float] | None:
    """Return the factor by which marks fit where they are expected, and the median distances with and without it.

    None where no factor far from 1 makes them fit clearly better, or too few places are known.
    """
    known = np.isfinite(expected_px).all(axis=1)
    if known.sum() < _LEAST_MARKS:
        return None
    factors = np.geomspace(0.1, 10.0, 401)
    away_px = [float(np.median(np.hypot(*(f * xy_px - expected_px)[known].T))) for f in (1.0, *factors)]
    best = int(np.argmin(away_px[1:]))
    factor, scaled_px, unscaled_px = float(factors[best]), away_px[1 + best], away_px[0]
    if abs(np.log(factor)) < np.log(_OTHER_SIZE) or unscaled_px < _FITS * side_px:
        return None
    if scaled_px > min(_FITS * side_px, _CLEARLY * unscaled_px):
        return None
    return factor, scaled_px, unscaled_px


def expected_px(
    photos: Sequence[Photo],
    reference: Reference,
    xyz_m: Float[np.ndarray, "points 3"],
    point: Int[np.ndarray, " marks"],
    image: Int[np.ndarray, " marks"],
) -> Float[np.ndarray, "marks 2"]:
    """Return where measured positions and attitudes see points, roughly; NaN where one of them is unknown."""
    from scipy.spatial.transform import Rotation

    quaternion = reference.quaternion[image]
    known = np.isfinite(quaternion).all(axis=1) & np.isfinite(reference.xyz_m[image]).all(axis=1)
    expected = np.full((len(point), 2), np.nan)
    if not known.any():
        return expected
    turn = Rotation.from_quat(quaternion[known], scalar_first=True)
    in_cam = turn.apply(xyz_m[point[known]] - reference.xyz_m[image[known]])
    of = [photos[k] for k in image[known]]
    focal_px = np.array([photo.focal_px or np.nan for photo in of])[:, None]
    middle = np.array([[photo.width_px / 2, photo.height_px / 2] for photo in of])
    depth = np.where(in_cam[:, 2:] > 0, in_cam[:, 2:], np.nan)
    expected[known] = focal_px * in_cam[:, :2] / depth + middle
    return expected
