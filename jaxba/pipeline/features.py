"""Stage features: keypoints and descriptors of one photo; the runner calls it once a photo, in worker processes."""

from dataclasses import dataclass

from jaxba._errors import JaxbaError
from jaxba.pipeline._parameters import Parameters, parameter
from jaxba.scene import Features, Photo
from jaxba.vision import decode, detect_features


@dataclass(frozen=True, kw_only=True)
class Inputs:
    """- `photo`: one usable frame."""

    photo: Photo


@dataclass(frozen=True, kw_only=True)
class Params(Parameters):
    """What the user may set."""

    detector: str = parameter("sift", choices=("sift", "orb", "akaze"), help="kind of features")
    nfeatures: int = parameter(8000, low=2000, high=20000, help="the most keypoints an image")
    contrast_threshold: float | None = parameter(
        None,
        low=0.02,
        high=0.08,
        help="SIFT: weaker extrema are dropped; none: 0.04, 0.03 in low light, 0.02 where these are too few",
    )
    edge_threshold: float = parameter(10.0, low=5, high=20, help="SIFT: 15 over crop rows, solar arrays, roof tiles")
    sigma: float = parameter(1.6, low=1.0, high=2.5, help="SIFT: blur of the first octave, px")
    fast_threshold: int = parameter(20, low=5, high=50, help="ORB: 15 over water and flat ground")
    nlevels: int = parameter(8, low=4, high=12, help="ORB: 10 at varying height or oblique")


@dataclass(frozen=True, kw_only=True)
class Outputs:
    """- `features`: of the photo."""

    features: Features


def run(inputs: Inputs, params: Params) -> Outputs:
    """Detect and describe the features of one photo.

    Raises `JaxbaError` where the file cannot be decoded, or is not the one whose size the metadata stage read.
    """
    photo = inputs.photo
    pixels = decode(photo.path)
    height, width = pixels.gray.shape
    if (width, height) != (photo.width_px, photo.height_px):
        raise JaxbaError(
            f"{photo.name} has {width} x {height} pixels, and had {photo.width_px} x {photo.height_px} before; "
            "the file was changed meanwhile: run again from the metadata stage."
        )
    features = detect_features(
        pixels,
        detector=params.detector,
        nfeatures=params.nfeatures,
        contrast_threshold=params.contrast_threshold,
        edge_threshold=params.edge_threshold,
        sigma=params.sigma,
        fast_threshold=params.fast_threshold,
        nlevels=params.nlevels,
    )
    return Outputs(features=features)
