from ._attitude_tags import attitude_from_nadir_body as attitude_from_nadir_body
from ._cameras import shared_cameras as shared_cameras
from ._decode import Pixels as Pixels, decode as decode, read_mask as read_mask
from ._exif import image_size as image_size
from ._features import (
    OrbOptions as OrbOptions,
    check_detector as check_detector,
    detect_features as detect_features,
    grid_coverage as grid_coverage,
)
from ._learned import learned_bytes as learned_bytes, learned_packages as learned_packages
from ._likeness import alike_pairs as alike_pairs
from ._nearest import (
    Descriptors as Descriptors,
    match_descriptors as match_descriptors,
    prepare_descriptors as prepare_descriptors,
)
from ._overlap import common_ground as common_ground
from ._pair import PairMatches as PairMatches, PairOptions as PairOptions, View as View, match_pair as match_pair
from ._photo import (
    IMAGE_SUFFIXES as IMAGE_SUFFIXES,
    RAW_SUFFIXES as RAW_SUFFIXES,
    read_photo as read_photo,
)
from ._statistics import ImageStatistics as ImageStatistics, measure_image as measure_image
from ._tuning import (
    CONDITIONS as CONDITIONS,
    Tuning as Tuning,
    most_keypoints as most_keypoints,
    store_bytes as store_bytes,
    tune as tune,
)
from ._two_view import Pinhole as Pinhole, PosePrior as PosePrior, TwoView as TwoView, verify as verify
