"""Similarities of space, `X_target = s G X_source + t`: how two frames of one survey differ. Host code in numpy."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

_ON_A_LINE = 1e-3  # second over first singular value


@dataclass(frozen=True, kw_only=True, eq=False)
class Similarity:
    """`X_target = scale * rotation @ X_source + shift`."""

    scale: float
    rotation: Float[np.ndarray, "3 3"]
    shift: Float[np.ndarray, "3"]

    @staticmethod
    def identity() -> "Similarity":
        """Return the similarity that leaves points where they are."""
        return Similarity(scale=1.0, rotation=np.eye(3), shift=np.zeros(3))

    @property
    def angle_rad(self) -> float:
        """By how much it turns."""
        return float(Rotation.from_matrix(self.rotation).magnitude())

    def points(self, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
        """Return points, or centres, in the target's frame."""
        return self.scale * points @ self.rotation.T + self.shift

    def rotations(self, rotations: Float[np.ndarray, "n 3 3"]) -> Float[np.ndarray, "n 3 3"]:
        """Return `cam_from_target` of rotations `cam_from_source`."""
        return rotations @ self.rotation.T

    def after(self, first: "Similarity") -> "Similarity":
        """Return `first` followed by this one."""
        shift = self.points(first.shift[None])[0]
        return Similarity(scale=self.scale * first.scale, rotation=self.rotation @ first.rotation, shift=shift)

    def inverse(self) -> "Similarity":
        """Return `source_from_target`."""
        back = self.rotation.T
        return Similarity(scale=1 / self.scale, rotation=back, shift=-back @ self.shift / self.scale)


def umeyama(source: Float[np.ndarray, "n 3"], target: Float[np.ndarray, "n 3"]) -> Similarity | None:
    """Return the similarity of least squares (Umeyama 1991), or None for points on a line, which determine none.

    >>> import numpy as np
    >>> points = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]])
    >>> found = umeyama(points, 2 * points + 5)
    >>> float(found.scale), found.shift.tolist()
    (2.00, [5.00, 5.00, 5.00])
    """
    p, q = source - source.mean(axis=0), target - target.mean(axis=0)
    u, s, vt = np.linalg.svd(q.T @ p)
    if s[1] < _ON_A_LINE * s[0] or s[0] == 0:
        return None
    sign = np.array([1.0, 1.0, np.linalg.det(u @ vt)])
    rotation, scale = u @ (sign[:, None] * vt), float((s * sign).sum() / (p * p).sum())
    if not scale > 0:
        return None
    shift = target.mean(axis=0) - scale * rotation @ source.mean(axis=0)
    return Similarity(scale=scale, rotation=rotation, shift=shift)
