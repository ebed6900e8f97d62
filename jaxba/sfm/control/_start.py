"""The block's place by its control points: the similarity from points intersected in it to the surveyed ones.

The similarity is found among samples by a robust loss, like that onto positions (`_align.py`), since a wrong point must
not turn the block, and refined on the points. Control without heights fixes no tilt and no height: the cameras are
taken to look down on average then, and the points to lie at the height of the frame's origin.
"""

import dataclasses

import numpy as np
from jaxtyping import Float
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from jaxba.geometry import Similarity
from jaxba.scene import Block, Control
from jaxba.sfm._align import align, look_down
from jaxba.sfm._initialise import UNPLACED
from jaxba.sfm._problem import is_collinear
from jaxba.sfm.control._control import LEAST_TO_PLACE, image_rows, intersect

_BENT = 0.005  # of the control's extent: what start values are good to
_LOSS = 2.0  # sigmas
_HELD = 1e-6  # radians, or shares of the extent: sigma of what control does not tell


def place_by_control(block: Block, control: Control, *, is_placed: bool) -> Block:
    """Return the block in the frame of its control points, where three of them or more can be used.

    `is_placed`: by positions, which leave it free in nothing. It stays where it is then, and control is tested against
    it before it may move it.
    """
    is_fit = control.method != "adjust" and block.is_georeferenced
    if is_placed or is_fit or control.method == "none" or not control.num_points:
        return block
    found = intersect(block, control, image_rows(block, control) >= 0)
    use = np.isfinite(found.point_m).all(axis=1) & ~control.is_check
    if use.sum() < LEAST_TO_PLACE:
        note = (
            f"Control points: {use.sum()} are marked in two registered images or more, and {LEAST_TO_PLACE} place a "
            "block: they do not."
        )
        return dataclasses.replace(block, notes=(*block.notes, note))
    xyz_m = control.xyz_m[use]
    extent = float(np.sqrt(np.mean(np.sum((xyz_m - xyz_m.mean(axis=0))[:, :2] ** 2, axis=1))))
    std_m = np.maximum(control.std_m[use], _BENT * extent)
    similarity = _similarity(block, found.point_m[use], xyz_m, std_m)
    if similarity is None:
        note = "Control points lie too near each other to place the block."
        return dataclasses.replace(block, notes=(*block.notes, note))
    moved = transformed(block, similarity)
    off_m = np.where(np.isfinite(std_m), similarity.points(found.point_m[use]) - xyz_m, 0.0)
    rms = float(np.sqrt(np.median(np.sum(off_m**2, axis=1))))
    notes = [note for note in block.notes if not note.endswith(UNPLACED)]
    notes.append(f"{use.sum()} control points place the block; at the start values they miss by {rms:.2g} m (median).")
    if not determines_tilt(xyz_m, std_m):
        by = "positions do"
        if not block.is_georeferenced:
            by = "cameras look down on average, and the points lie at the height of the frame's origin"
        notes.append(f"Control points without enough heights tell neither the block's tilt nor its height: {by}.")
    return dataclasses.replace(moved, is_georeferenced=True, notes=tuple(notes))


def _similarity(
    block: Block, source: Float[np.ndarray, "n 3"], xyz_m: Float[np.ndarray, "n 3"], std_m: Float[np.ndarray, "n 3"]
) -> Similarity | None:
    count = len(source)
    turns = Rotation.from_quat(block.quaternion, scalar_first=True).as_matrix()
    if block.is_georeferenced and not determines_tilt(xyz_m, std_m):
        # positions have told what is up
        up = np.eye(3)
        height = np.nanmedian(source[:, 2])
    else:
        up, height = look_down(turns), None
    upright = np.tile(np.diag([1.0, -1.0, -1.0]) @ up, (count, 1, 1))  # its third row: the mean viewing direction
    nothing = np.full((count, 4), np.nan)
    target = xyz_m.copy()
    if height is not None:
        target[:, 2] = np.where(np.isfinite(std_m[:, 2]), xyz_m[:, 2], height)
    found = align(source, upright, target, std_m, np.ones(count, bool), nothing, nothing[:, :3])
    if found is None:
        return None
    if not determines_tilt(xyz_m, std_m):
        level = Similarity(scale=found.scale, rotation=_level(found.rotation, up), shift=found.shift)
        middle = source.mean(axis=0)
        shift = found.points(middle[None])[0] - level.points(middle[None])[0] + level.shift
        found = dataclasses.replace(level, shift=shift)
    return fit_similarity(source, target, std_m, found)


def _level(rotation: Float[np.ndarray, "3 3"], up: Float[np.ndarray, "3 3"]) -> Float[np.ndarray, "3 3"]:
    """Return the rotation about the vertical, after `up`, that is nearest to a rotation."""
    turn = rotation @ up.T
    angle = np.arctan2(turn[1, 0] - turn[0, 1], turn[0, 0] + turn[1, 1])
    return Rotation.from_rotvec([0, 0, angle]).as_matrix() @ up


def determines_tilt(xyz_m: Float[np.ndarray, "n 3"], std_m: Float[np.ndarray, "n 3"]) -> bool:
    """Whether points fix a block's tilt and height: three with heights that lie on no line."""
    return not is_collinear(xyz_m[np.isfinite(std_m).all(axis=1)])


def fit_similarity(
    source: Float[np.ndarray, "n 3"],
    xyz_m: Float[np.ndarray, "n 3"],
    std_m: Float[np.ndarray, "n 3"],
    start: Similarity,
    *,
    robust: bool = True,
) -> Similarity:
    """Return the similarity from points to surveyed ones near `start`; what the points do not tell stays as there.

    - `std_m`: infinite where a coordinate is not known. `robust`: by Huber's loss; else least squares.
    """
    middle = source.mean(axis=0)
    target = start.points(middle[None])[0]
    weight = np.where(np.isfinite(std_m), 1 / std_m, 0.0)
    extent = max(float(np.sqrt(np.mean(np.sum((start.points(source) - target) ** 2, axis=1)))), 1e-9)
    held = np.zeros(7)  # over sigma
    if not determines_tilt(xyz_m, std_m):
        held[:2] = 1 / _HELD
        heights = np.isfinite(std_m[:, 2]).any()
        held[6] = 0.0 if heights else 1 / (_HELD * extent)

    def of(x: Float[np.ndarray, "7"]) -> Similarity:
        rotation = Rotation.from_rotvec(x[:3]).as_matrix() @ start.rotation
        scale = start.scale * float(np.exp(x[3]))
        return Similarity(scale=scale, rotation=rotation, shift=target + x[4:] - scale * rotation @ middle)

    def residuals(x: Float[np.ndarray, "7"]) -> Float[np.ndarray, " residuals"]:
        off = (of(x).points(source) - np.where(weight > 0, xyz_m, 0.0)) * weight
        return np.concatenate([off.ravel(), held * x])

    unit = [0.01, 0.01, 0.01, 0.01, 0.01 * extent, 0.01 * extent, 0.01 * extent]
    loss = "huber" if robust else "linear"
    return of(least_squares(residuals, np.zeros(7), x_scale=unit, loss=loss, f_scale=_LOSS, xtol=1e-14, ftol=1e-14).x)


def transformed(block: Block, similarity: Similarity) -> Block:
    """Return the block moved by a similarity."""
    rotations = similarity.rotations(Rotation.from_quat(block.quaternion, scalar_first=True).as_matrix())
    centers = similarity.points(block.centers_m)
    return dataclasses.replace(
        block,
        quaternion=Rotation.from_matrix(rotations).as_quat(canonical=True, scalar_first=True),
        translation_m=-np.einsum("nij,nj->ni", rotations, centers),
        points_m=similarity.points(block.points_m),
    )
