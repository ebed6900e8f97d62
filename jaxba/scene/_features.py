"""Features of one image: keypoints in pixels, their descriptors, their colours."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, UInt8

from jaxba.scene._descriptors import KIND_OF, DescriptorKind, Detector


@dataclass(frozen=True, kw_only=True, eq=False)
class Features:
    """Keypoints of one image, the best first (SIFT: the largest, ORB: the strongest), descriptors in the same order.

    A SIFT keypoint with several orientations stands there once for each.

    - `xy_px`: the centre of the first pixel is (0.5, 0.5). `size_px`: diameter. `angle_rad`: of the keypoint.
    - `descriptors`: C-contiguous; SIFT 128 integral values, ORB 32 bytes of bits.
    - `rgb`: colour of the image at each keypoint.
    - `mean_brightness`: of the image, 0 to 255. `coverage`: share of an 8 x 8 grid's cells that hold a keypoint.
    - `notes`: what was odd, such as a frame without texture.

    A frame without texture has zero keypoints: arrays of length 0, never None.
    """

    detector: Detector
    xy_px: Float[np.ndarray, "keypoints 2"]
    size_px: Float[np.ndarray, " keypoints"]
    angle_rad: Float[np.ndarray, " keypoints"]
    descriptors: UInt8[np.ndarray, "keypoints length"]
    rgb: UInt8[np.ndarray, "keypoints 3"]
    mean_brightness: float
    coverage: float
    notes: tuple[str, ...] = ()

    @property
    def kind(self) -> DescriptorKind:
        """How the descriptors are compared."""
        return KIND_OF[self.detector]

    @property
    def num_keypoints(self) -> int:
        return self.xy_px.shape[0]
