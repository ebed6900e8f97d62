"""Global positioning: camera centres and points from known rotations, for all images at once.

A few thousand tracks are enough for it, chosen even over every image (`choose_tracks`).

With the unit ray `v` of an observation in the world, point X and centre c, the error across the ray over the distance
is the sine of the angle between both. From the previous round's distances d the next is linear least squares,

    sum w |(I - v v^T)(X - c)|^2 / d^2  +  e^2 (v . (X - c) / d - 1)^2,

w a Cauchy weight of that angle. The second term holds the distances near the previous ones, loosely: it fixes the
scale, and keeps what the rays leave free (points on parallel rays, images with few of them) near the rest instead of at
infinity. The first round has d = 1, that is all points about equally far, which aerial blocks come close to, and which
makes the problem convex: no start values, no local minima. The term's share e falls from round to round.

This is the bilinear problem of GLOMAP (Pan et al. 2024, "Global structure-from-motion revisited", section 4.2) with the
scales eliminated. Points are eliminated block by block; each round costs a sparse factorisation of (3 images)^2.
"""

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy import sparse

from jaxba.sfm._sparse import block_diagonal, block_matrix, solve_positive, sum_rows

_SHARES = (0.5, 0.3, 0.2, 0.1, 0.05, 0.03, 0.02, 0.01, 0.01, 0.01, 0.01, 0.01)
_LEAST_DISTANCE = 0.05  # of the mean one
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


def global_positions(
    num_images: int,
    ray: Float[np.ndarray, "observations 3"],
    image: Int[np.ndarray, " observations"],
    point: Int[np.ndarray, " observations"],
    *,
    scale_rad: float,
) -> tuple[Float[np.ndarray, "images 3"], Float[np.ndarray, "points 3"], Float[np.ndarray, " observations"]]:
    """Return centres, points and each ray's angle to its point, radians, in a frame of arbitrary origin and scale.

    `ray`: unit, in the world. `scale_rad`: angle beyond which a ray loses weight, some times its sigma. The mean
    distance from a camera to its points is one.
    """
    num_points = int(point.max()) + 1
    distance, weight = np.ones(len(ray)), np.ones(len(ray))
    centers, points = np.zeros((num_images, 3)), np.zeros((num_points, 3))
    angle = np.zeros(len(ray))
    along = ray[:, :, None] * ray[:, None, :]
    for number, share in enumerate(_SHARES):
        across = (weight / distance**2)[:, None, None] * (np.eye(3) - along)
        matrix = across + (share / distance)[:, None, None] ** 2 * along
        right = (share**2 / distance)[:, None] * ray
        centers, points = _solve(num_images, num_points, matrix, right, image, point)
        between = points[point] - centers[image]
        ahead = np.sum(between * ray, axis=1)
        length = np.linalg.norm(between, axis=1)
        angle = np.arctan2(np.linalg.norm(between - ahead[:, None] * ray, axis=1), ahead)
        mean = np.median(length)
        centers, points = centers / mean, points / mean
        distance = np.clip(ahead / mean, _LEAST_DISTANCE, None)
        # wide at first, where the distances are still wrong
        scale = max(scale_rad, 0.3 * 0.5**number)
        weight = 1 / (1 + (np.sin(np.minimum(angle, np.pi / 2)) / scale) ** 2)
    return centers, points, angle


def _solve(
    num_images: int,
    num_points: int,
    matrix: Float[np.ndarray, "observations 3 3"],
    right: Float[np.ndarray, "observations 3"],
    image: Int[np.ndarray, " observations"],
    point: Int[np.ndarray, " observations"],
) -> tuple[Float[np.ndarray, "images 3"], Float[np.ndarray, "points 3"]]:
    """Minimise `sum (X - c)^T M (X - c) / 2 - r (X - c)`, the points eliminated; the mean centre is the origin."""
    of_point = sum_rows(matrix.reshape(-1, 9), point, num_points).reshape(-1, 3, 3)
    of_image = sum_rows(matrix.reshape(-1, 9), image, num_images).reshape(-1, 3, 3)
    right_point, right_image = sum_rows(right, point, num_points), -sum_rows(right, image, num_images)
    inverse = np.linalg.inv(of_point)
    cross = block_matrix(matrix, image, point, (num_images, num_points))
    scaled = block_matrix(matrix @ inverse[point], image, point, (num_images, num_points))
    reduced = (block_diagonal(of_image) - scaled @ cross.T).tocsc()
    # the origin is free: a faint pull of all centres towards it
    ridge = 1e-8 * np.trace(of_image.mean(axis=0)) / 3
    reduced = reduced + ridge * sparse.eye_array(3 * num_images, format="csc")
    side = right_image.ravel() + scaled @ right_point.ravel()
    centers = solve_positive(reduced, side).reshape(-1, 3)
    pulled = right_point + (cross.T @ centers.ravel()).reshape(-1, 3)
    points = (inverse @ pulled[:, :, None])[:, :, 0]
    middle = centers.mean(axis=0)
    return centers - middle, points - middle
