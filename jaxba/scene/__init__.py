"""Host data around an adjustment: surveys, blocks, tracks (numpy, frozen dataclasses)."""

from jaxba.scene.synthetic import DRONE_CAMERA, Survey, Truth, uav_block

__all__ = ["DRONE_CAMERA", "Survey", "Truth", "uav_block"]
