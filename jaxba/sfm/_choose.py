"""The tracks that start values are found from: a few thousand instead of all, even over every image."""

import numpy as np
from jaxtyping import Bool, Float, Int

_GRID = 6
_PER_CELL = 6  # observations, in each cell of each image's grid: about 200 an image


def choose_tracks(
    track: Int[np.ndarray, " observations"],
    image: Int[np.ndarray, " observations"],
    xy: Float[np.ndarray, "observations 2"],
    angle_rad: Float[np.ndarray, " tracks"],
    *,
    min_angle_rad: float,
) -> Bool[np.ndarray, " observations"]:
    """Return which observations belong to the chosen tracks.

    - `track`, `image`: of each observation, sorted by track. `xy`: place in the image, 0 to 1.
    - `angle_rad`: largest angle between two rays of each track; below `min_angle_rad` it fixes no point.

    Longer tracks come first; one is taken if any of its images still lacks observations around there.

    >>> track, image = np.array([0, 0, 1, 1, 1]), np.array([0, 1, 0, 1, 2])
    >>> choose_tracks(track, image, np.full((5, 2), 0.5), np.array([0.01, 0.2]), min_angle_rad=0.02).tolist()
    [False, False, True, True, True]
    """
    num_tracks = len(angle_rad)
    starts = np.searchsorted(track, np.arange(num_tracks + 1))
    length = np.diff(starts)
    cell = np.clip((xy * _GRID).astype(int), 0, _GRID - 1)
    cell = (image * _GRID + cell[:, 0]) * _GRID + cell[:, 1]
    count = [0] * int((image.max() + 1) * _GRID * _GRID)
    chosen = np.zeros(num_tracks, bool)
    cells, bounds = cell.tolist(), starts.tolist()
    for k in np.argsort(-length, kind="stable"):
        if length[k] < 2 or not angle_rad[k] >= min_angle_rad:
            continue
        mine = cells[bounds[k] : bounds[k + 1]]
        if min(count[c] for c in mine) < _PER_CELL:
            chosen[k] = True
            for c in mine:
                count[c] += 1
    return chosen[track]


def largest_angles(
    ray: Float[np.ndarray, "observations 3"], track: Int[np.ndarray, " observations"], num_tracks: int
) -> Float[np.ndarray, " tracks"]:
    """Return the largest angle between the mean ray of each track and one of its rays, doubled: at most twice off.

    Exact for two rays; a screening, not a measurement, for more.
    """
    mean = np.stack([np.bincount(track, column, minlength=num_tracks) for column in ray.T], axis=1)
    mean /= np.maximum(np.linalg.norm(mean, axis=1, keepdims=True), 1e-12)
    chord = np.linalg.norm(ray - mean[track], axis=1)
    largest = np.zeros(num_tracks)
    np.maximum.at(largest, track, chord)
    return 4 * np.arcsin(np.minimum(largest / 2, 1.0))
