"""Attitudes by the tags beside those of the block: the turn of each photo, and which are beyond what they can be.

Attitudes take part as weak priors with a loss that lets go of errors (`_problem.py`), and choose pairs and start values
before. A gimbal or a compass errs by degrees. A turn of more than its sigmas allow and of more than half a right angle
is no error of theirs: the tags speak of another direction than the pixels do.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Bool
from scipy.spatial.transform import Rotation

from jaxba.scene import Block, Finding, Photo, Reference
from jaxba.sfm._measured import OUTLIER

_LEAST_RAD = np.pi / 4  # nearer to another quarter turn of the picture than to none
_SAME_RAD = np.radians(15.0)  # that quarter turns of pictures differ by from the turns found


def attitude_turns(block: Block, reference: Reference) -> tuple[Bool[np.ndarray, " images"], Rotation]:
    """Return which images have an attitude, and the turn of each of these: adjusted from measured, camera's frame."""
    measured = reference.quaternion[block.image_index]
    known = np.asarray(np.isfinite(measured).all(axis=1) & block.is_georeferenced)
    adjusted, back = block.quaternion[known], Rotation.from_quat(measured[known], scalar_first=True).inv()
    turns: Any = Rotation.from_quat(adjusted, scalar_first=True) * back
    return known, turns


def contradicts(block: Block, reference: Reference) -> Bool[np.ndarray, " images"]:
    """Return which images have an attitude that contradicts the block."""
    known, turns = attitude_turns(block, reference)
    found = np.zeros(block.num_images, bool)
    if not known.any():
        return found
    std_rad = np.nan_to_num(reference.attitude_std_rad[block.image_index[known]])
    found[known] = np.any(np.abs(turns.as_rotvec()) > np.maximum(OUTLIER * std_rad, _LEAST_RAD), axis=1)
    return found


def attitude_findings(block: Block, reference: Reference, photos: Sequence[Photo]) -> list[Finding]:
    """Return the attitudes that contradict the block, with the turn that they have in common, if any."""
    bad = contradicts(block, reference)
    if not bad.any():
        return []
    known, turns = attitude_turns(block, reference)
    of_bad = Rotation.from_rotvec(turns.as_rotvec()[bad[known]])
    quarters = np.rint(of_bad.as_rotvec()[:, 2] / (np.pi / 2)) % 4  # of the picture, about the viewing direction
    left = Rotation.from_rotvec(np.outer(-quarters * np.pi / 2, [0.0, 0.0, 1.0])) * of_bad
    is_picture = len(np.unique(quarters)) == 1 and np.median(left.magnitude()) < _SAME_RAD
    return [
        Finding.of(
            "attitudes contradict",
            names=[photos[int(i)].name for i in block.image_index[bad]],
            turn_deg=np.degrees(of_bad.magnitude()).tolist(),
            measured=int(known.sum()),
            quarter_turns=int(quarters[0]) if is_picture else 0,
        )
    ]
