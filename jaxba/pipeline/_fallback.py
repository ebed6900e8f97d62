"""SIFT for pairs that failed with ORB: keypoints of a second kind, numbered behind those of the first.

A pair is matched by one kind of features alone, so the two kinds meet in tracks only, where positions and colours are
all that counts. Detection is deterministic: whichever pair asks for a photo's SIFT keypoints, they are the same.
"""

import dataclasses
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, UInt8

from jaxba.pipeline import features as detection
from jaxba.scene import Features, Photo


@dataclass(frozen=True, kw_only=True, eq=False)
class FallbackKeypoints:
    """SIFT keypoints of an image that has ORB features, for matches whose indices go on behind those.

    - `image`: its index. `xy_px`, `rgb`: as in `Features`.
    """

    image: int
    xy_px: Float[np.ndarray, "keypoints 2"]
    rgb: UInt8[np.ndarray, "keypoints 3"]


def detect_fallback(
    photo: Photo, *, nfeatures: int = 12000, contrast_threshold: float = 0.03, edge_threshold: float = 12.0
) -> Features:
    """Return the SIFT features of a photo, whatever condition holds for it.

    Raises `JaxbaError` where the file cannot be decoded any more, or has another size.
    """
    params = detection.Params(
        detector="sift",
        condition="none",
        nfeatures=nfeatures,
        contrast_threshold=contrast_threshold,
        edge_threshold=edge_threshold,
    )
    return detection.run(detection.Inputs(photo=photo), params).features


class WithFallback(Mapping[int, Features]):
    """Features by image index; those of some images go on with SIFT keypoints, which have a position and a colour.

    There, `descriptors` have length 0, sizes and angles are NaN: nothing is left by which the two kinds could be mixed.
    """

    def __init__(self, features: Mapping[int, Features], fallback: Sequence[FallbackKeypoints]) -> None:
        self.features, self.fallback = features, {entry.image: entry for entry in fallback}

    @property
    def digests(self) -> tuple[Mapping[int, Features], dict[int, FallbackKeypoints]]:
        """What counts for a fingerprint."""
        return self.features, self.fallback

    def __getitem__(self, index: int) -> Features:
        features = self.features[index]
        if index not in self.fallback:
            return features
        more = self.fallback[index]
        count = features.num_keypoints + len(more.xy_px)
        return dataclasses.replace(
            features,
            xy_px=np.concatenate([features.xy_px, more.xy_px]),
            rgb=np.concatenate([features.rgb, more.rgb]),
            size_px=np.full(count, np.nan),
            angle_rad=np.full(count, np.nan),
            descriptors=np.zeros((count, 0), np.uint8),
        )

    def __iter__(self) -> Iterator[int]:
        return iter(self.features)

    def __len__(self) -> int:
        return len(self.features)
