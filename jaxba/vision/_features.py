"""Keypoints and descriptors of one image, by OpenCV tuned for aerial photos, or learned (see `_learned.py`).

Position. OpenCV counts from the centre of the first pixel, so 0.5 is added. SIFT's doubled first octave shifts
keypoints by 0.25 px unless `enable_precise_upscale` is set. ORB's pixel p of a level that is s times coarser is
centred at (p + 0.5) width / round(width / s), and OpenCV says p s.

Choice. SIFT drops extrema whose contrast is under `contrast_threshold / 3`, for its 3 layers an octave. Where fewer
than `nfeatures` reach it, those down to `contrast_floor` count, too: a frame over smooth ground, which has 25 keypoints
over 0.04 and 3200 over 0.02, stays in the block. Of more, the largest are kept, which other photos see again more often
than the strongest: 1.4 times the verified matches over forest, 1.7 times over a ploughed field. Each keeps the features
of all its orientations. `edge_threshold` is the largest ratio of principal curvatures (times (r + 1)^2 / r) that a
keypoint may have: a larger one keeps more of those on edges.

Bits. ORB compares `wta_k` pixels at a time. With 3 or 4 each choice takes two bits, and two choices are equal or not,
whatever their bits (Hamming distance of pairs of bits). Such pairs are kept as one of four bits, 64 bytes in place of
32, so that the plain Hamming distance, which all matching uses, counts them right: twice each difference.

Cost on one core: SIFT 0.5 to 0.7 s for 1600 x 900 pixels.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float, UInt8

from jaxba._errors import JaxbaError
from jaxba.scene import LEARNED, Features
from jaxba.vision._decode import Pixels
from jaxba.vision._learned import Keypoints, check_learned, detect_learned, load_network

_SIFT_LAYERS = 3
_ONE_OF_FOUR = np.array([1, 2, 4, 8], np.uint8)


@dataclass(frozen=True, kw_only=True)
class OrbOptions:
    """How ORB looks at an image.

    - `fast_threshold`: grey levels by which a corner differs from its ring. `nlevels`, `scale_factor`: of the pyramid.
    - `edge_px`: border without keypoints. `patch_px`: side of what is described. `wta_k`: pixels compared at a time.
    - `score`: by which the strongest are chosen, `harris` or `fast`.
    """

    fast_threshold: int = 20
    nlevels: int = 8
    scale_factor: float = 1.2
    edge_px: int = 31
    patch_px: int = 31
    wta_k: int = 2
    score: str = "harris"


def detect_features(
    pixels: Pixels,
    *,
    detector: str = "sift",
    nfeatures: int = 8000,
    contrast_threshold: float = 0.04,
    contrast_floor: float = 0.02,
    edge_threshold: float = 10.0,
    sigma: float = 1.6,
    orb: OrbOptions = OrbOptions(),
    side_px: int = 1600,
    mask: UInt8[np.ndarray, "height width"] | None = None,
) -> Features:
    """Return the features of the best `nfeatures` keypoints of an image; a frame without texture has none.

    `contrast_threshold`, `contrast_floor`, `edge_threshold` and `sigma` (px, blur of the first octave) are SIFT's,
    `side_px` is of learned detectors (see `detect_learned`). No keypoint lies where `mask` is 0.

    SIFT keeps the largest keypoints, the others the strongest; a keypoint with several orientations counts once.

    Raises `JaxbaError` for a detector that is not installed.

    >>> squares = np.kron(np.random.default_rng(0).integers(0, 255, (20, 30)), np.ones((8, 8))).astype(np.uint8)
    >>> features = detect_features(Pixels(gray=squares, rgb=np.dstack([squares] * 3)))
    >>> features.descriptors.shape == (features.num_keypoints, 128), features.num_keypoints > 100
    (True, True)
    """
    brightness = float(pixels.gray.mean())
    height, width = pixels.gray.shape
    notes = []
    check_detector(detector)
    if detector in LEARNED:
        found = detect_learned(load_network(detector), pixels.rgb, nfeatures, side_px=side_px, mask=mask)
    else:
        if detector == "sift":
            floor = min(contrast_floor, contrast_threshold)
            keypoints, descriptors, note = _sift(
                pixels.gray, mask, nfeatures, contrast_threshold, floor, edge_threshold, sigma
            )
            notes += [note] * bool(note)
        elif detector == "orb":
            keypoints, descriptors = _orb(pixels.gray, mask, nfeatures, orb)
        else:
            keypoints, descriptors = _akaze(pixels.gray, mask)
        found = _of_opencv(keypoints, descriptors, detector, (width, height), nfeatures, orb)
    if mask is not None:
        notes.append(f"{np.mean(mask == 0):.0%} of the photo is masked")
    if len(found.xy_px) == 0:
        notes.append(f"no texture: zero keypoints at a mean brightness of {brightness:.0f} of 255")
    column = np.clip(found.xy_px[:, 0], 0, width - 1).astype(int)
    row = np.clip(found.xy_px[:, 1], 0, height - 1).astype(int)
    return Features(
        detector=detector,  # pyright: ignore[reportArgumentType]
        xy_px=found.xy_px,
        size_px=found.size_px,
        angle_rad=found.angle_rad,
        descriptors=found.descriptors,
        rgb=pixels.rgb[row, column],
        mean_brightness=brightness,
        coverage=grid_coverage(found.xy_px, width, height),
        notes=tuple(notes),
    )


def check_detector(detector: str) -> None:
    """Raise `JaxbaError` where a detector is not installed; learned ones are not imported for it."""
    if detector in LEARNED:
        check_learned(detector)
    elif detector == "akaze":
        import cv2

        if not hasattr(cv2, "AKAZE_create"):
            raise JaxbaError(
                f"features.detector=akaze: OpenCV {cv2.__version__} has none in its main module; take sift or orb, "
                "or install opencv-python-headless<5."
            )


def grid_coverage(xy_px: Float[np.ndarray, "points 2"], width_px: int, height_px: int) -> float:
    """Return the share of the cells of an 8 x 8 grid over the image that hold a point.

    >>> grid_coverage(np.array([[1.0, 1.0], [2.0, 3.0], [99.0, 49.0]]), 100, 50) * 64
    2.0
    """
    cell = np.clip(np.floor(xy_px * [8 / width_px, 8 / height_px]), 0, 7).astype(int)
    return float(len(np.unique(cell[:, 0] + 8 * cell[:, 1])) / 64)


def _of_opencv(
    keypoints: Any,
    descriptors: UInt8[np.ndarray, "keypoints length"],
    detector: str,
    image_px: tuple[int, int],
    nfeatures: int,
    orb: OrbOptions,
) -> Keypoints:
    """Return OpenCV's keypoints in the convention of pixels here, the best first."""
    rows = np.array([(*k.pt, k.size, k.angle, k.response, k.octave) for k in keypoints], np.float64).reshape(-1, 6)
    x, y, size, angle, response, octave = rows.T
    xy_px = np.stack([x, y], axis=1) + 0.5
    if detector == "orb":
        scale = orb.scale_factor ** octave[:, None]
        xy_px = (np.stack([x, y], axis=1) / scale + 0.5) * (np.array(image_px) / np.rint(np.array(image_px) / scale))
    # SIFT's come in their order; the descriptors of the others do not depend on it
    order = np.arange(len(x)) if detector == "sift" else np.lexsort([angle, size, x, y, -response])[:nfeatures]
    return Keypoints(
        xy_px=xy_px[order],
        size_px=size[order],
        angle_rad=np.deg2rad(angle[order]),
        descriptors=np.ascontiguousarray(descriptors[order]),
    )


def _sift(
    gray: UInt8[np.ndarray, "height width"],
    mask: UInt8[np.ndarray, "height width"] | None,
    nfeatures: int,
    contrast: float,
    floor: float,
    edge: float,
    sigma: float,
) -> tuple[Any, UInt8[np.ndarray, "keypoints 128"], str]:
    """Return keypoints, descriptors and what was odd about their strength."""
    import cv2

    sift = cv2.SIFT.create(
        nfeatures=0,
        nOctaveLayers=_SIFT_LAYERS,
        contrastThreshold=floor,
        edgeThreshold=edge,
        sigma=sigma,
        enable_precise_upscale=True,
    )
    keypoints = sift.detect(gray, mask)  # pyright: ignore[reportArgumentType, reportCallIssue]
    rows = np.array([(*k.pt, k.size, k.response, k.angle) for k in keypoints], np.float64).reshape(-1, 5)
    # OpenCV keeps float32 responses: a keypoint right at the threshold is over it
    strong = rows[:, 3] * _SIFT_LAYERS >= contrast * (1 - 1e-6)
    num_strong = len(np.unique(rows[strong, :2], axis=0))
    candidates, note = np.flatnonzero(strong), ""
    if num_strong < nfeatures and floor < contrast:
        candidates = np.arange(len(rows))
    x, y, size, response, angle = rows[candidates].T
    order = candidates[np.lexsort([angle, y, x, -response, -size])]
    _, first, place = np.unique(rows[order, :2], axis=0, return_index=True, return_inverse=True)
    rank = np.empty(len(first), np.int64)
    rank[np.argsort(first)] = np.arange(len(first))
    kept = order[rank[place.reshape(-1)] < nfeatures]
    if num_strong < min(nfeatures, len(first)):
        note = (
            f"only {num_strong} keypoints reach the contrast threshold {contrast:g}; "
            f"{min(nfeatures, len(first))} were kept, down to {floor:g}"
        )
    if len(kept) == 0:
        return (), np.zeros((0, 128), np.uint8), note
    found, descriptors = sift.compute(gray, [keypoints[i] for i in kept])
    return found, descriptors.astype(np.uint8), note  # integral 0 to 255: nothing is lost


def _orb(
    gray: UInt8[np.ndarray, "height width"],
    mask: UInt8[np.ndarray, "height width"] | None,
    nfeatures: int,
    options: OrbOptions,
) -> tuple[Any, UInt8[np.ndarray, "keypoints length"]]:
    import cv2

    orb = cv2.ORB.create(
        nfeatures=nfeatures,
        scaleFactor=options.scale_factor,
        nlevels=options.nlevels,
        edgeThreshold=options.edge_px,
        WTA_K=options.wta_k,
        scoreType=cv2.ORB_HARRIS_SCORE if options.score == "harris" else cv2.ORB_FAST_SCORE,
        patchSize=options.patch_px,
        fastThreshold=options.fast_threshold,
    )
    keypoints, descriptors = orb.detectAndCompute(gray, mask)  # pyright: ignore[reportArgumentType, reportCallIssue]
    if descriptors is None:
        keypoints, descriptors = (), np.zeros((0, 32), np.uint8)
    return keypoints, descriptors if options.wta_k == 2 else _one_of_four(descriptors)


def _one_of_four(descriptors: UInt8[np.ndarray, "keypoints 32"]) -> UInt8[np.ndarray, "keypoints 64"]:
    """Return descriptors in which each pair of bits has become four, the one of its value set."""
    pairs = (descriptors[:, :, None] >> np.array([0, 2, 4, 6], np.uint8)) & 3
    four = _ONE_OF_FOUR[pairs]
    return (four[:, :, 0::2] | (four[:, :, 1::2] << 4)).reshape(len(descriptors), 64)


def _akaze(
    gray: UInt8[np.ndarray, "height width"], mask: UInt8[np.ndarray, "height width"] | None
) -> tuple[Any, UInt8[np.ndarray, "keypoints 61"]]:
    import cv2

    keypoints, descriptors = cv2.AKAZE_create().detectAndCompute(gray, mask)  # pyright: ignore
    return (keypoints, descriptors) if descriptors is not None else ((), np.zeros((0, 61), np.uint8))
