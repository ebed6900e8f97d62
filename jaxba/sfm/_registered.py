"""Which images stay registered: those that enough points hold, and that something ties to the rest.

Two images that share points fix each other's direction, not the distance: that takes points seen in three images. A
group of images that hangs on the rest by one pair of images looks perfect in its residuals at any size. So images are
counted in as an incremental reconstruction adds them: from the best pair on, each image that sees enough points which
two images within the whole have already fixed. What is not part of that whole needs a trusted position near it.
"""

import dataclasses
from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy import sparse

from jaxba._errors import JaxbaError
from jaxba.scene import Block, LeftOut, Photo, Reference, Tracks
from jaxba.sfm._points import with_points
from jaxba.sfm._resection import MIN_INLIERS

CONTRADICTION = 5.0  # sigmas
_START_STD = 0.005  # of the distance to the points: what an uncalibrated lens makes of start values


def drop_weak(
    block: Block,
    tracks: Tracks,
    reference: Reference,
    reasons: dict[int, str],
    min_angle_rad: float,
    max_error_px: float,
    max_sigmas: float,
) -> Block:
    """Return the block without images that too few points hold, or that nothing ties to the rest.

    Tied are images of the rigid whole, and those within `max_sigmas` of their trusted position.

    Raises `JaxbaError` where fewer than two images are left.
    """
    while True:
        count = np.bincount(block.observation_image, minlength=block.num_images)
        tied, shared = rigid_whole(
            block.observation_image, block.observation_point, block.num_images, least=MIN_INLIERS
        )
        few = count < MIN_INLIERS
        off = sigmas_off(block, reference)
        keep = ~few & (tied | (np.isfinite(off) & (off <= max_sigmas)))
        if np.count_nonzero(keep) < 2:
            raise JaxbaError(
                f"start values failed: {block.num_points} points of {block.num_images} images fit their pixels, and no "
                f"two images share {MIN_INLIERS} of them. A wrong focal length is the usual cause (camera "
                f"{block.camera_names[0]}: {block.camera_parameters[0, 0]:.0f} px); check it, or set metadata.focal."
            )
        if keep.all():
            return block
        for row in np.flatnonzero(~keep):
            reasons[int(block.image_index[row])] = (
                f"{count[row]} points fit its pose, {MIN_INLIERS} are needed"
                if few[row]
                else f"{shared[row]} of its points are seen by two images of the rest, {MIN_INLIERS} are needed to "
                "know how far off it is, and no trusted position tells it"
            )
        block = _select(block, keep)
        block = with_points(block, tracks, min_angle_rad=min_angle_rad, max_error_px=max_error_px)


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


def contradictions(block: Block, reference: Reference, photos: Sequence[Photo]) -> list[str]:
    """Name positions that the images contradict; they stay, under a robust loss."""
    index, sigmas = block.image_index, sigmas_off(block, reference)
    use = np.isfinite(sigmas)
    off = np.where(np.isfinite(reference.std_m[index]), block.centers_m - reference.xyz_m[index], 0.0)
    bad = np.flatnonzero(use & (sigmas > CONTRADICTION))
    if len(bad) == 0:
        return []
    bad = bad[np.argsort(-sigmas[bad], kind="stable")]
    named = ", ".join(f"{photos[int(index[b])].name} ({np.linalg.norm(off[b]):.1f} m)" for b in bad[:5])
    more = f" and {len(bad) - 5} more" if len(bad) > 5 else ""
    return [
        f"{len(bad)} of {np.count_nonzero(use)} measured positions contradict the images by more than "
        f"{CONTRADICTION:g} sigma: {named}{more}. They stay in the adjustment under a robust loss."
    ]


def unregistered(photos: Sequence[Photo], tracks: Tracks, block: Block, reasons: dict[int, str]) -> tuple[LeftOut, ...]:
    """Return the photos without a pose, and what to do about each; `reasons` are those of the largest component."""
    left = {}
    registered = set(block.image_index.tolist())
    for component in tracks.components:
        for image in component:
            if image in registered:
                continue
            if component is tracks.components[0]:
                left[image] = f"{reasons.get(image, 'no pose was found')}; fly more overlap there."
            elif len(component) == 1:
                left[image] = (
                    "no edge of the view graph joins it with another photo: too little overlap or texture there."
                )
            else:
                left[image] = (
                    f"in a group of {len(component)} photos that no edge joins with the largest group of "
                    f"{len(tracks.components[0])}; map it on its own, or fly the gap."
                )
    return tuple(LeftOut(name=photos[i].name, reason=left[i]) for i in sorted(left))


def sigmas_off(block: Block, reference: Reference) -> Float[np.ndarray, " images"]:
    """Return by how many sigmas each image is off its trusted position, on the worst axis; infinite without one.

    The sigma is that of the position and that of the start values together: centimetres cannot be judged yet.
    """
    index = block.image_index
    known = reference.is_used[index] & block.is_georeferenced
    with np.errstate(invalid="ignore"):
        std = np.hypot(reference.std_m[index], _START_STD * _distance_m(block))
        off = np.abs(block.centers_m - reference.xyz_m[index]) / std
    off = np.where(np.isfinite(reference.std_m[index]), off, 0.0)
    return np.where(known, off.max(axis=1), np.inf)


def _distance_m(block: Block) -> float:
    """Return the median distance from a camera to a point that it sees; 0 without points."""
    if not block.num_observations:
        return 0.0
    between = block.points_m[block.observation_point] - block.centers_m[block.observation_image]
    return float(np.median(np.linalg.norm(between, axis=1)))


def _select(block: Block, keep: Bool[np.ndarray, " images"]) -> Block:
    return dataclasses.replace(
        block,
        image_index=block.image_index[keep],
        quaternion=block.quaternion[keep],
        translation_m=block.translation_m[keep],
        camera_index=block.camera_index[keep],
    )
