"""Host data around an adjustment: photos, features, view graph, tracks, blocks, synthetic surveys (numpy alone).

`import jaxba.scene` loads no jax, so that workers that only decode and match photos stay light: what needs the core
loads it when it is first used (PEP 562).
"""

import importlib
from typing import TYPE_CHECKING

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

_SYNTHETIC = ("DRONE_CAMERA", "Survey", "Truth", "uav_block")


def __getattr__(name: str) -> object:
    if name not in _SYNTHETIC:
        raise AttributeError(f"module 'jaxba.scene' has no attribute {name!r}")
    globals()[name] = value = getattr(importlib.import_module("jaxba.scene.synthetic"), name)
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
