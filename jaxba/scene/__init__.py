"""Host data around an adjustment: photos, features, view graph, tracks, blocks, control (numpy alone).

scipy is imported inside the functions that need it: it takes 0.35 s, and most commands and workers call none of them.
"""

from jaxba.scene._attitude import Attitude, cam_from_enu
from jaxba.scene._block import Block
from jaxba.scene._candidates import joining_pairs, nearest_pairs, pairs_between, rising_pairs, window_pairs
from jaxba.scene._control import Control, ControlFit
from jaxba.scene._described import described, fault, lacks_memory
from jaxba.scene._descriptors import (
    DETECTORS,
    LEARNED,
    DescriptorKind,
    descriptor_distances,
    descriptor_vectors,
    distances_of_products,
    unit_bytes,
)
from jaxba.scene._features import Features
from jaxba.scene._finding import Finding
from jaxba.scene._footprint import Footprints, footprint_overlaps, footprint_pairs, ground_footprints
from jaxba.scene._graph import components
from jaxba.scene._pair_record import Fallback, Missed, Model, PairRecord
from jaxba.scene._photo import Fix, FocalSource, HeightKind, LeftOut, Lens, Photo, PhotoFile, Position
from jaxba.scene._reconstruction import Claim, Reconstruction
from jaxba.scene._reference import AssumedDatum, CommonOffset, FlightOffsets, LocalFrame, Reference
from jaxba.scene._scale_bars import BarFit, ScaleBars
from jaxba.scene._survey_statistics import MeasuredKind, SurveyStatistics
from jaxba.scene._track_building import build_tracks
from jaxba.scene._tracks import Tracks
from jaxba.scene._view_graph import EdgeStatus, PrunedEdge, ViewGraph

__all__ = [
    "DETECTORS", "LEARNED", "AssumedDatum", "Attitude", "BarFit", "Block", "Claim", "CommonOffset", "Control",
    "ControlFit", "DescriptorKind", "EdgeStatus", "Fallback", "Features", "Finding", "Fix", "FlightOffsets",
    "FocalSource", "Footprints", "HeightKind", "LeftOut", "Lens", "LocalFrame", "MeasuredKind", "Missed", "Model",
    "PairRecord", "Photo", "PhotoFile", "Position", "PrunedEdge", "Reconstruction", "Reference", "ScaleBars",
    "SurveyStatistics", "Tracks", "ViewGraph", "build_tracks", "cam_from_enu", "components", "described",
    "descriptor_distances", "descriptor_vectors", "distances_of_products", "fault", "footprint_overlaps",
    "footprint_pairs", "ground_footprints", "joining_pairs", "lacks_memory", "nearest_pairs", "pairs_between",
    "rising_pairs", "unit_bytes", "window_pairs",
]  # fmt: skip
