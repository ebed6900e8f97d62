"""Robust similarity from a reconstruction to the local frame, from measured positions and attitudes that may be wrong.

    X_local = s G X + t

Candidates come from samples (random sample consensus): two positions and which way is up; three positions; the
attitudes' mean and two positions. Each is scored on all positions by a Cauchy loss, of the horizontal error as one
vector and of the vertical one by itself, so a wrong altitude costs no more than itself. The best ones are refined on
the same loss with the attitudes, or, where no image has one, with the viewing directions held loosely downward: a
single straight strip determines no rotation about itself, and altitudes that are not trusted (an infinite sigma)
determine no tilt.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from jaxba.geometry import Similarity, umeyama

_SAMPLES = 300
_LOSS = 2.0  # sigmas
_DOWN_STD = 0.05  # radians; mean viewing direction against the vertical where no attitude is known
_LEAST_ATTITUDE_STD = 0.02  # radians


def align(
    centers: Float[np.ndarray, "images 3"],
    rotations: Float[np.ndarray, "images 3 3"],
    xyz_m: Float[np.ndarray, "images 3"],
    std_m: Float[np.ndarray, "images 3"],
    is_used: Bool[np.ndarray, " images"],
    quaternion: Float[np.ndarray, "images 4"],
    attitude_std_rad: Float[np.ndarray, "images 3"],
) -> Similarity | None:
    """Return the similarity onto measured positions, or None where they determine none.

    - `centers`, `rotations` (`cam_from_world`): the reconstruction.
    - `xyz_m`, `std_m`, `is_used`: positions, their sigma an axis (infinite: not known), those to be trusted.
    - `quaternion`, `attitude_std_rad`: measured `cam_from_local`, NaN where there is none.

    Needed are three positions, or two where attitudes are known, that lie apart by several times their sigmas.

    >>> rng = np.random.default_rng(0)
    >>> centers = rng.normal(size=(9, 3))
    >>> none, down = np.full((9, 3), np.nan), np.tile(np.diag([1.0, -1, -1]), (9, 1, 1))
    >>> found = align(centers, down, 5 * centers + 1, np.ones((9, 3)), np.ones(9, bool), np.full((9, 4), np.nan), none)
    >>> float(found.scale), found.shift.tolist()
    (5.00, [1.00, 1.00, 1.00])
    """
    used = is_used & np.isfinite(xyz_m).all(axis=1)
    measured = _Measured.of(centers, rotations, xyz_m, std_m, used, quaternion, attitude_std_rad)
    if measured is None:
        return None
    candidates = measured.candidates(np.random.default_rng(0))
    if not candidates:
        return None
    scored = sorted(candidates, key=measured.cost)[:3]
    return min((measured.refine(candidate) for candidate in scored), key=measured.cost)


def look_down(rotations: Float[np.ndarray, "images 3 3"]) -> Float[np.ndarray, "3 3"]:
    """Return the rotation after which the mean viewing direction points down."""
    mean = rotations[:, 2].mean(axis=0)
    return Rotation.align_vectors([[0.0, 0, -1]], [mean / np.linalg.norm(mean)])[0].as_matrix()


def attitude_rotation(
    rotations: Float[np.ndarray, "images 3 3"], quaternion: Float[np.ndarray, "images 4"]
) -> Float[np.ndarray, "3 3"] | None:
    """Return the rotation of the world that most attitudes agree on, or None without attitudes."""
    known = np.isfinite(quaternion).all(axis=1)
    if not known.any():
        return None
    prior = Rotation.from_quat(quaternion[known], scalar_first=True)
    turn = prior.inv() * Rotation.from_matrix(rotations[known])  # G of each image
    every = turn.as_matrix()
    # the one with the least sum of angles to the others, then a mean of those near it
    cosine = np.clip((np.einsum("aij,bij->ab", every, every) - 1) / 2, -1, 1)
    angle = np.arccos(cosine)
    center = int(np.argmin(np.minimum(angle, 0.5).sum(axis=1)))
    near = angle[center] <= max(2 * np.median(angle[center]), _LEAST_ATTITUDE_STD)
    return turn[near].mean().as_matrix()


@dataclass(frozen=True, eq=False)
class _Measured:
    """Centres with a position, centred on their mean, and the attitudes."""

    center: Float[np.ndarray, "n 3"]
    xyz: Float[np.ndarray, "n 3"]
    weight: Float[np.ndarray, "n 3"]
    mean_view: Float[np.ndarray, "3"]
    attitude: Float[np.ndarray, "3 3"] | None
    prior: Rotation | None
    found: Rotation | None
    prior_weight: Float[np.ndarray, "m 3"]

    @staticmethod
    def of(
        centers: Float[np.ndarray, "images 3"],
        rotations: Float[np.ndarray, "images 3 3"],
        xyz_m: Float[np.ndarray, "images 3"],
        std_m: Float[np.ndarray, "images 3"],
        used: Bool[np.ndarray, " images"],
        quaternion: Float[np.ndarray, "images 4"],
        attitude_std_rad: Float[np.ndarray, "images 3"],
    ) -> "_Measured | None":
        attitude = attitude_rotation(rotations, quaternion)
        if np.count_nonzero(used) < (3 if attitude is None else 2):
            return None
        with np.errstate(divide="ignore"):
            weight = np.nan_to_num(1 / std_m[used], nan=0.0, posinf=0.0)
        spread = np.abs(xyz_m[used] - np.median(xyz_m[used], axis=0))[:, :2].max(axis=0)
        if not np.max(spread * np.median(weight[:, :2], axis=0)) > 3:
            return None
        known = np.isfinite(quaternion).all(axis=1)
        std = np.maximum(np.nan_to_num(attitude_std_rad[known], nan=np.inf), _LEAST_ATTITUDE_STD)
        return _Measured(
            center=centers[used],
            xyz=xyz_m[used],
            weight=weight,
            mean_view=rotations[:, 2].mean(axis=0) / np.linalg.norm(rotations[:, 2].mean(axis=0)),
            attitude=attitude,
            prior=Rotation.from_quat(quaternion[known], scalar_first=True) if known.any() else None,
            found=Rotation.from_matrix(rotations[known]) if known.any() else None,
            prior_weight=1 / std,
        )

    def residuals(self, similarity: Similarity) -> Float[np.ndarray, " residuals"]:
        """Return residuals over sigmas, shortened so that half their squares sum up to Cauchy losses."""
        position = (similarity.points(self.center) - self.xyz) * self.weight
        if self.prior is not None and self.found is not None:
            turn = (self.prior * Rotation.from_matrix(similarity.rotation) * self.found.inv()).as_rotvec()
            direction = _shortened(turn * self.prior_weight)
        else:
            view = similarity.rotation @ self.mean_view
            # counts as much as all positions together: altitudes without a sigma leave the tilt to it alone
            direction = np.sqrt(len(self.center)) * _shortened(np.arctan2(view[:2], -view[2])[None] / _DOWN_STD)
        parts = (_shortened(position[:, :2]), _shortened(position[:, 2:]), direction)
        return np.concatenate([part.ravel() for part in parts])

    def cost(self, similarity: Similarity) -> float:
        return float((self.residuals(similarity) ** 2).sum())

    def candidates(self, rng: np.random.Generator) -> list[Similarity]:
        found = []
        upright = self.attitude if self.attitude is not None else _down(self.mean_view)
        horizontal = (self.center @ upright.T)[:, :2] @ [1, 1j]
        target = self.xyz[:, :2] @ [1, 1j]
        for _ in range(_SAMPLES):
            i, j, k = rng.permutation(len(self.center))[:3].tolist() if len(self.center) > 2 else (0, 1, 0)
            if horizontal[i] != horizontal[j] and target[i] != target[j]:
                ratio = (target[j] - target[i]) / (horizontal[j] - horizontal[i])
                turn = Rotation.from_rotvec([0, 0, np.angle(ratio)]).as_matrix() @ upright
                found.append(self._shifted(abs(ratio), turn, [i, j]))
                if self.attitude is not None:
                    found.append(self._shifted(abs(ratio), self.attitude, [i, j]))
            if k != i and np.all(self.weight[[i, j, k]] > 0):
                similarity = umeyama(self.center[[i, j, k]], self.xyz[[i, j, k]])
                found += [] if similarity is None else [similarity]
        return found

    def _shifted(self, scale: float, rotation: Float[np.ndarray, "3 3"], sample: list[int]) -> Similarity:
        shift = self.xyz - scale * self.center @ rotation.T
        horizontal, vertical = shift[sample, :2].mean(axis=0), np.median(shift[:, 2])
        return Similarity(scale=scale, rotation=rotation, shift=np.array([*horizontal, vertical]))

    def refine(self, start: Similarity) -> Similarity:
        middle = self.center.mean(axis=0)
        target = start.points(middle[None])[0]

        def of(x: Float[np.ndarray, "7"]) -> Similarity:
            rotation = Rotation.from_rotvec(x[:3]).as_matrix() @ start.rotation
            scale = start.scale * float(np.exp(x[3]))
            return Similarity(scale=scale, rotation=rotation, shift=target + x[4:] - scale * rotation @ middle)

        unit = 1 / max(float(np.median(self.weight[:, :2])), 1e-9)
        found = least_squares(
            lambda x: self.residuals(of(x)), np.zeros(7),
            x_scale=[0.01, 0.01, 0.01, 0.01, unit, unit, unit], max_nfev=100,
        )  # fmt: skip
        return of(found.x)


def _shortened(rows: Float[np.ndarray, "rows axes"]) -> Float[np.ndarray, "rows axes"]:
    """Return each row at the length whose square is the Cauchy loss of the row."""
    q = (rows**2).sum(axis=1, keepdims=True) / _LOSS**2
    return rows * np.sqrt(np.where(q > 1e-12, np.log1p(q) / np.maximum(q, 1e-12), 1.0))


def _down(mean_view: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3 3"]:
    return Rotation.align_vectors([[0.0, 0, -1]], [mean_view])[0].as_matrix()
