"""Photos to arrays and back: decoding, tags, features, matches, and simulated photos.

`import jaxba.vision` loads neither OpenCV nor jax: a name loads its module when it is first used (PEP 562). Only
simulated photos need jax.
"""

from typing import TYPE_CHECKING

from jaxba._lazy import lazy

if TYPE_CHECKING:
    from jaxba.vision._attitude_tags import attitude_from_nadir_body
    from jaxba.vision._decode import Pixels, decode
    from jaxba.vision._features import OrbOptions, detect_features, grid_coverage
    from jaxba.vision._ground import Ground, paint_ground
    from jaxba.vision._nearest import Descriptors, match_descriptors, prepare_descriptors
    from jaxba.vision._overlap import common_ground
    from jaxba.vision._photo import IMAGE_SUFFIXES, RAW_SUFFIXES, read_photo
    from jaxba.vision._render import expose, ground_points, pixel_rays, render
    from jaxba.vision._statistics import ImageStatistics, measure_image
    from jaxba.vision._two_view import Pinhole, PosePrior, TwoView, verify
    from jaxba.vision._write_photo import PhotoTags, jpeg_with_tags

__all__ = [
    "IMAGE_SUFFIXES", "RAW_SUFFIXES", "Descriptors", "Ground", "ImageStatistics", "OrbOptions", "PhotoTags",
    "Pinhole", "Pixels", "PosePrior", "TwoView", "attitude_from_nadir_body", "common_ground", "decode",
    "detect_features", "expose", "grid_coverage", "ground_points", "jpeg_with_tags", "match_descriptors",
    "measure_image", "paint_ground", "pixel_rays", "prepare_descriptors", "read_photo", "render", "verify",
]  # fmt: skip

_MODULE_OF = {
    "Descriptors": "jaxba.vision._nearest",
    "Ground": "jaxba.vision._ground",
    "IMAGE_SUFFIXES": "jaxba.vision._photo",
    "ImageStatistics": "jaxba.vision._statistics",
    "OrbOptions": "jaxba.vision._features",
    "PhotoTags": "jaxba.vision._write_photo",
    "Pinhole": "jaxba.vision._two_view",
    "Pixels": "jaxba.vision._decode",
    "PosePrior": "jaxba.vision._two_view",
    "RAW_SUFFIXES": "jaxba.vision._photo",
    "TwoView": "jaxba.vision._two_view",
    "attitude_from_nadir_body": "jaxba.vision._attitude_tags",
    "common_ground": "jaxba.vision._overlap",
    "decode": "jaxba.vision._decode",
    "detect_features": "jaxba.vision._features",
    "expose": "jaxba.vision._render",
    "grid_coverage": "jaxba.vision._features",
    "ground_points": "jaxba.vision._render",
    "jpeg_with_tags": "jaxba.vision._write_photo",
    "match_descriptors": "jaxba.vision._nearest",
    "measure_image": "jaxba.vision._statistics",
    "paint_ground": "jaxba.vision._ground",
    "pixel_rays": "jaxba.vision._render",
    "prepare_descriptors": "jaxba.vision._nearest",
    "read_photo": "jaxba.vision._photo",
    "render": "jaxba.vision._render",
    "verify": "jaxba.vision._two_view",
}

__getattr__, __dir__ = lazy(__name__, _MODULE_OF)
