"""Host data around an adjustment: photos, features, view graph, tracks, blocks, synthetic surveys (numpy alone).

`import jaxba.scene` loads no jax, so that workers that only decode and match photos stay light: what needs the core
loads it when it is first used (PEP 562).
"""

from typing import TYPE_CHECKING

from jaxba._lazy import lazy
from jaxba.scene._attitude import Attitude, cam_from_enu
from jaxba.scene._block import Block
from jaxba.scene._candidates import joining_pairs, nearest_pairs, window_pairs
from jaxba.scene._control import Control, ControlFit
from jaxba.scene._features import Features
from jaxba.scene._footprint import Footprints, footprint_overlaps, footprint_pairs, ground_footprints
from jaxba.scene._graph import components
from jaxba.scene._photo import Left, Photo, PhotoFile, Position
from jaxba.scene._reference import LocalFrame, Reference
from jaxba.scene._track_building import build_tracks
from jaxba.scene._tracks import Tracks
from jaxba.scene._view_graph import EdgeStatus, ViewGraph

if TYPE_CHECKING:
    from jaxba.scene.synthetic import DRONE_CAMERA, Survey, Truth, uav_block

__all__ = [
    "DRONE_CAMERA", "Attitude", "Block", "Control", "ControlFit", "EdgeStatus", "Features", "Footprints", "Left",
    "LocalFrame", "Photo", "PhotoFile", "Position", "Reference", "Survey", "Tracks", "Truth", "ViewGraph",
    "build_tracks", "cam_from_enu", "components", "footprint_overlaps", "footprint_pairs", "ground_footprints",
    "joining_pairs", "nearest_pairs", "uav_block", "window_pairs",
]  # fmt: skip

_MODULE_OF = {name: "jaxba.scene.synthetic" for name in ("DRONE_CAMERA", "Survey", "Truth", "uav_block")}

__getattr__, __dir__ = lazy(__name__, _MODULE_OF)
