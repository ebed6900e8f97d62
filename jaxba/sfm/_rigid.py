"""Images that the points hold in one rigid whole.

Two images that share points fix each other's direction, not the distance: that takes points seen in three images. A
group of images that hangs on the rest by one pair of images looks perfect in its residuals at any size. So images are
counted in as an incremental reconstruction adds them: from the best pair on, each image that sees enough points which
two images within the whole have already fixed.
"""

import numpy as np
from jaxtyping import Bool, Int
from scipy import sparse


def rigid_whole(
    image: Int[np.ndarray, " observations"],
    point: Int[np.ndarray, " observations"],
    num_images: int,
    *,
    least: int,
) -> tuple[Bool[np.ndarray, " images"], Int[np.ndarray, " images"]]:
    """Return which images belong to the largest rigid whole, and how many of its points each image sees.

    `least`: points, seen by two images of the whole or more, that an image needs.

    >>> image = np.array([0, 1, 0, 1, 2, 2, 3])  # two points in 0 and 1, one of them in 2 as well, one in 2 and 3
    >>> point = np.array([0, 0, 1, 1, 1, 2, 2])
    >>> [part.tolist() for part in rigid_whole(image, point, 4, least=1)]
    [[True, True, True, False], [2, 2, 1, 0]]
    """
    num_points = int(point.max(initial=-1)) + 1
    sees = sparse.csr_array((np.ones(len(image)), (image, point)), shape=(num_images, num_points))
    shared = sparse.triu(sees @ sees.T, 1).tocoo()
    left = np.ones(num_images, bool)
    best, best_count = np.zeros(num_images, bool), np.zeros(num_images, int)
    while np.count_nonzero(left) > np.count_nonzero(best):
        strength = np.where(left[shared.row] & left[shared.col], shared.data, 0)
        if not strength.any():
            break
        pair = int(np.argmax(strength))
        whole = np.zeros(num_images, bool)
        whole[[shared.row[pair], shared.col[pair]]] = True
        while True:
            fixed = np.bincount(point[whole[image]], minlength=num_points) >= 2
            count = np.bincount(image[fixed[point]], minlength=num_images)
            grown = whole | (count >= least)
            if np.array_equal(grown, whole):
                break
            whole = grown
        if np.count_nonzero(whole) > np.count_nonzero(best):
            best, best_count = whole, count
        left &= ~whole
    return best, best_count
