"""How a block may be bent: the displacements of the ground that it knows least.

What all spots over the area have in common is its shift. The joint covariance of the rest, C = V diag(l) V^T, has a
vector for each way in which the block may lie wrong; the largest are its weakest modes, and sqrt(l) their sigmas. What
one looks like is said by how much of it is a turn, tilt, change of scale, or a bend: a dome (the middle against the
corners, which focal length and radial distortion make) or a saddle (corners against corners).
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from jaxba.design._network import Network, Spots, spots_in

_GRID = 5
_MOST = 3
_NAMED = 0.5  # share of a mode's square that one shape must have to name it


@dataclass(frozen=True, eq=False)
class Mode:
    """One way in which a block may lie wrong.

    - `name`: its shape; `share`: of the mode's square that is of this shape.
    - `corners_m`: sigma of the displacement of the area's corners, the largest of them, east, north, up.
    - `middle_m`: likewise of the spot next to its middle, with signs against the corner's.
    """

    name: str
    share: float
    corners_m: Float[np.ndarray, "3"]
    middle_m: Float[np.ndarray, "3"]

    @property
    def size_m(self) -> float:
        """Length of the displacement at the corner."""
        return float(np.linalg.norm(self.corners_m))


def weakest_modes(network: Network) -> tuple[Mode, ...]:
    """Return the weakest modes of a network beside its shift, the weakest first."""
    return modes_of(network.at(spots_in(network.area_m, _GRID)))


def modes_of(spots: Spots) -> tuple[Mode, ...]:
    """Return the weakest modes of spots over an area."""
    values, vectors = np.linalg.eigh(_without_shift(spots.joint_m2))
    shapes = _shapes(spots.xyz_m)
    far, near = _ends(spots.xyz_m)
    found = []
    for k in range(1, min(_MOST, len(values)) + 1):
        vector = vectors[:, -k]
        shares = {name: float(np.sum((basis.T @ vector) ** 2)) for name, basis in shapes.items()}
        name = max(shares, key=lambda n: shares[n])
        moved = np.sqrt(max(values[-k], 0.0)) * vector.reshape(-1, 3)
        corner = far[np.argmax(np.linalg.norm(moved[far], axis=1))]
        sign = np.where(moved[corner] < 0, -1.0, 1.0)
        found.append(
            Mode(
                name if shares[name] >= _NAMED else "of no simple shape",
                shares[name],
                np.abs(moved[corner]),
                sign * moved[near],
            )
        )
    return tuple(found)


def shift_std_m(network: Network) -> Float[np.ndarray, "3"]:
    """Return the sigma of what the whole area is off in common, east, north, up, metres."""
    return shift_of(network.at(spots_in(network.area_m, _GRID)))


def shift_of(spots: Spots) -> Float[np.ndarray, "3"]:
    """Return the sigma of the mean displacement of spots, east, north, up, metres."""
    joint = spots.joint_m2
    count = len(joint) // 3
    return np.sqrt(np.einsum("niki->i", joint.reshape(count, 3, count, 3))) / count


def dome_std_m(network: Network) -> float:
    """Return the sigma of the height of the area's middle against its corners that a dome alone makes, metres."""
    return dome_of(network.at(spots_in(network.area_m, _GRID)))


def dome_of(spots: Spots) -> float:
    """Return the same of spots over an area."""
    dome = _shapes(spots.xyz_m)["dome"][:, 0]
    far, near = _ends(spots.xyz_m)
    up = dome.reshape(-1, 3)[:, 2]
    return float(np.sqrt(dome @ spots.joint_m2 @ dome) * abs(np.mean(up[far]) - up[near]))


def _without_shift(joint: Float[np.ndarray, "n n"]) -> Float[np.ndarray, "n n"]:
    """Return the covariance of what is left of displacements without their mean."""
    count = len(joint) // 3
    blocks = joint.reshape(count, 3, count, 3)
    blocks = blocks - blocks.mean(axis=0, keepdims=True)
    return (blocks - blocks.mean(axis=2, keepdims=True)).reshape(joint.shape)


def _ends(xyz_m: Float[np.ndarray, "spots 3"]) -> tuple[np.ndarray, int]:
    """Return the spots that lie farthest out, four of them where there are as many, and the one in the middle."""
    plan = xyz_m[:, :2] - (xyz_m[:, :2].min(axis=0) + xyz_m[:, :2].max(axis=0)) / 2
    quadrant = 2 * (plan[:, 0] > 0) + (plan[:, 1] > 0)
    length = np.linalg.norm(plan, axis=1)
    far = [np.flatnonzero(quadrant == q)[np.argmax(length[quadrant == q])] for q in range(4) if (quadrant == q).any()]
    return np.array(far), int(np.argmin(length))


def _shapes(xyz_m: Float[np.ndarray, "spots 3"]) -> dict[str, Float[np.ndarray, "coordinates directions"]]:
    """Return displacements of each shape, orthonormal, each shape free of those before it."""
    x, y, z = ((xyz_m - xyz_m.mean(axis=0)) / np.ptp(xyz_m[:, :2], axis=0).max()).T
    o, i = np.zeros_like(x), np.ones_like(x)
    columns = {
        "shift": [(i, o, o), (o, i, o), (o, o, i)],
        "turn": [(-y, x, o)],
        "scale": [(x, y, z)],
        "tilt": [(z, o, -x), (o, z, -y)],
        "dome": [(o, o, x**2 + y**2)],
        "saddle": [(o, o, x * y), (o, o, x**2 - y**2)],
    }
    stacked = np.stack([np.stack(c, axis=1).ravel() for shape in columns.values() for c in shape], axis=1)
    basis, _ = np.linalg.qr(stacked)
    ends = np.cumsum([len(shape) for shape in columns.values()])
    return dict(zip(columns, np.split(basis, ends[:-1], axis=1), strict=True))
