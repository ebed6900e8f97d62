"""How an adjusted block fits its surveyed points, and the fit of 7 or 12 parameters that brings it onto them.

**Residuals** are adjusted minus surveyed, along local east, north, up. A control point in the adjustment is where that
put it; all others are intersected from their marks by the adjusted poses.

**Blunder test.** A control point in the adjustment is compared with what marks, photos, positions and the other control
points say of it, and set aside where it contradicts them (`_explained.py`), a check point with where its marks
place it. The difference over its sigma is over 3.29 by chance in one of a thousand. What all check points are off in
common (a GNSS base, a datum) is told as such and blamed on none of them. In a fit, whose parameters a wrong point
bends, it is the standardised residual `v / sigma_v` with `sigma_v^2` the diagonal of `S - A (A^T S^-1 A)^-1 A^T`
(Baarda 1968), over their own scatter where that is larger; the point with the largest one is left out and the fit made
anew, as long as enough are left.

**Affine.** Twelve parameters near the similarity, each of their nine coefficients held to it with a sigma of 1%: flat
control tells nothing of how heights are sheared, and that then stays as it is. A camera's pose cannot be sheared, so it
applies to coordinates alone.
"""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float
from scipy.spatial import KDTree

from jaxba.geometry import Similarity
from jaxba.scene import Block, Control, ControlFit, Reference
from jaxba.sfm._adjust import Adjusted
from jaxba.sfm._measured import OUTLIER, median_offset
from jaxba.sfm._uncertainty import Uncertainty, own_variance
from jaxba.sfm.control._control import LEAST_TO_PLACE, Intersected, intersect
from jaxba.sfm.control._start import determines_tilt, fit_similarity, transformed
from jaxba.sfm.control._statistics import Tested

LEAST_OF = {"helmert": 3, "affine": 4}
_SHEAR = 0.01
_AROUND = 20  # tie points that tell what poses contribute to a point's sigma
_LEAST_IN_COMMON = 3
_CHECK_OFF = 5.0  # sigmas: of a check point nobody expects more
IDENTITY = np.eye(3, 4)


@dataclass(frozen=True, eq=False)
class Controlled:
    """A block brought onto its control points, as far as the method does so after the adjustment.

    - `sigmas`: of the adjustment; without those of positions and points after a fit, which has its own.
    - `affine`: what applies to coordinates beside that, 3 x 4; the identity but for `affine`.
    """

    block: Block
    sigmas: Uncertainty
    affine: Float[np.ndarray, "3 4"]
    fit: ControlFit

    @property
    def is_fixed(self) -> bool:
        """Whether control points fix the block in all axes."""
        return self.fit.method != "none" and bool(np.isfinite(self.fit.control_rms_m).all())


def apply_control(adjusted: Adjusted, sigmas: Uncertainty, control: Control, reference: Reference) -> Controlled:
    """Return the block, fitted to its control points where the method says so, and how it fits them."""
    block = adjusted.block
    if not control.num_points or not block.is_georeferenced:
        return Controlled(block, sigmas, IDENTITY, ControlFit.nothing(control.num_points))
    on_control = adjusted.on_control
    scale = np.ones(2) if on_control is None else np.array(on_control.explained.scale)
    control = replace(control, std_m=control.std_m * scale[[0, 0, 1]])
    held = np.any(np.isfinite(sigmas.point_std_m), axis=0)  # the axes that something measured holds the block along
    found = intersect(block, control, adjusted.mark_used)
    of_poses = _pose_variance(adjusted, sigmas, found)
    variance = of_poses + found.variance_m2
    method, affine, left_out = "none", IDENTITY, np.zeros(control.num_points, bool)
    scores = None
    if control.method == "adjust" and adjusted.control is not None:
        method = "adjust"
    use = ~control.is_check & np.isfinite(found.point_m).all(axis=1)
    if control.method in LEAST_OF and use.sum() >= LEAST_OF[control.method]:
        method = control.method
        # what poses have in common is no part of it: the fit takes that up
        std, variance = np.sqrt(control.std_m**2 + found.variance_m2), found.variance_m2.copy()
        similarity, scores, left_out = _snooped(found.point_m, control.xyz_m, std, use)
        block = transformed(block, similarity)
        found = replace(found, point_m=similarity.points(found.point_m))
        held = np.array([True, True, held[2] or determines_tilt(control.xyz_m[use], control.std_m[use])])
        if method == "affine":
            affine = fit_affine(*(part[use & ~left_out] for part in (found.point_m, control.xyz_m, std)))
        sigmas = _without_absolute(sigmas)
    points = apply_affine(affine, found.point_m)
    off = np.where(np.isfinite(control.std_m), points - control.xyz_m, np.nan)
    std = np.sqrt(np.where(np.isfinite(control.std_m), control.std_m, np.nan) ** 2 + variance)
    shift, shift_std = _common(off, std, of_poses, control.is_check)
    with np.errstate(invalid="ignore"):
        is_shifted = np.abs(shift) > OUTLIER * shift_std
    in_common = np.where(control.is_check[:, None] & is_shifted, shift, 0.0)
    over = _largest(np.abs((off - in_common) / std))
    tests, set_aside = Tested.nothing(control.num_points), np.zeros(off.shape, bool)
    used_std, offset_std = np.full(off.shape, np.inf), np.full(3, np.nan)
    if scores is not None:
        over = np.where(use, scores, over)
    if on_control is not None and method == "adjust":
        tests, set_aside, used_std = on_control.tested, on_control.explained.wrong, on_control.standing.std_m
        over[use] = _largest(np.abs(tests.test[use]))
    if method == "adjust" and adjusted.control is not None:
        points = points.copy()
        points[adjusted.control.rows] = adjusted.control.start_m
        if sigmas.covariance is not None:
            own = sigmas.covariance.points[block.num_points :][: len(adjusted.control.rows)]
            variance[adjusted.control.rows] = np.maximum(np.einsum("nii->ni", own), 0.0)
    residual = np.where(np.isfinite(control.std_m), points - control.xyz_m, np.nan)
    with np.errstate(invalid="ignore"):
        suspect = np.where(control.is_check | (method == "none"), over > _CHECK_OFF, over > OUTLIER) | left_out
    if method == "adjust":
        suspect = np.where(control.is_check, suspect, set_aside.any(axis=1))
    offset = np.full(3, np.nan)
    if on_control is not None and on_control.standing.common is not None and method == "adjust":
        offset = np.where(np.isfinite(median_offset(block, reference)), adjusted.common_m, np.nan)
        if sigmas.covariance is not None:
            offset_std = np.sqrt(np.maximum(np.diagonal(sigmas.covariance.position_offset), 0.0))
    elif method != "none":
        enough = np.isfinite(residual[use]).sum(axis=0) >= LEAST_TO_PLACE
        offset = np.where(enough, -median_offset(block, reference), np.nan)
    return Controlled(
        block,
        sigmas,
        affine,
        ControlFit(
            adjusted_m=points,
            residual_m=residual,
            std_m=np.where(held, np.sqrt(variance), np.nan),
            num_marks=found.num_marks,
            mark_rms_px=_mark_rms(found, control, adjusted.mark_used),
            over_sigma=over,
            detectable_m=tests.detectable_m,
            reach_m=tests.reach_m,
            without_m=tests.without_m,
            without_std_m=tests.without_std_m,
            used_std_m=used_std,
            check_shift_m=shift,
            check_shift_std_m=shift_std,
            is_suspect=suspect,
            is_set_aside=set_aside,
            method=method,
            control_rms_m=_rms(np.where(set_aside, np.nan, residual)[~control.is_check]),
            check_rms_m=_rms(residual[control.is_check]),
            gnss_minus_control_m=offset,
            gnss_minus_control_std_m=offset_std,
            scale=scale,
        ),
    )


def _common(
    off_m: Float[np.ndarray, "points 3"],
    std_m: Float[np.ndarray, "points 3"],
    of_poses_m2: Float[np.ndarray, "points 3"],
    is_check: Bool[np.ndarray, " points"],
) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3"]]:
    """Return what check points are off in common, an axis, and its sigma; NaN where fewer than three are known.

    - `std_m`: of each difference. `of_poses_m2`: its part that the poses bring, the same for points near each other:
      the mean does not make it smaller.
    """
    shift, std = np.full(3, np.nan), np.full(3, np.nan)
    for axis in range(3):
        mine = is_check & np.isfinite(off_m[:, axis]) & np.isfinite(std_m[:, axis])
        if mine.sum() < _LEAST_IN_COMMON:
            continue
        own = np.maximum(std_m[mine, axis] ** 2 - of_poses_m2[mine, axis], 1e-12)
        weight = 1 / own / np.sum(1 / own)
        shift[axis] = np.sum(weight * off_m[mine, axis])
        std[axis] = np.sqrt(np.sum(weight**2 * own) + np.mean(of_poses_m2[mine, axis]))
    return shift, std


def _without_absolute(sigmas: Uncertainty) -> Uncertainty:
    return replace(
        sigmas,
        position_std_m=np.full_like(sigmas.position_std_m, np.nan),
        point_std_m=np.full_like(sigmas.point_std_m, np.nan),
        why_not="Sigmas of positions and points are not given after a fit to control: those of the adjustment before "
        "it do not hold there. control.method=adjust gives them.",
    )


def apply_affine(affine: Float[np.ndarray, "3 4"], xyz_m: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
    """Return points mapped by a 3 x 4 matrix; the very same ones by the identity."""
    return xyz_m if np.array_equal(affine, IDENTITY) else xyz_m @ affine[:, :3].T + affine[:, 3]


def fit_affine(
    source: Float[np.ndarray, "n 3"], xyz_m: Float[np.ndarray, "n 3"], std_m: Float[np.ndarray, "n 3"]
) -> Float[np.ndarray, "3 4"]:
    """Return the affine map of points onto surveyed ones, near the identity."""
    middle = source.mean(axis=0)
    design = np.column_stack([source - middle, np.ones(len(source))])
    result = np.zeros((3, 4))
    for axis in range(3):
        weight = np.where(np.isfinite(std_m[:, axis]), 1 / std_m[:, axis], 0.0)
        off = np.where(weight > 0, xyz_m[:, axis] - source[:, axis], 0.0)
        held = np.diag([1 / _SHEAR] * 3 + [1e-6])
        rows = np.concatenate([design * weight[:, None], held])
        change = np.linalg.lstsq(rows, np.concatenate([off * weight, np.zeros(4)]), rcond=None)[0]
        result[axis, :3] = change[:3] + np.eye(3)[axis]
        result[axis, 3] = change[3] - change[:3] @ middle
    return result


def _snooped(
    source: Float[np.ndarray, "n 3"],
    xyz_m: Float[np.ndarray, "n 3"],
    std_m: Float[np.ndarray, "n 3"],
    use: Bool[np.ndarray, " n"],
) -> tuple[Similarity, Float[np.ndarray, " n"], Bool[np.ndarray, " n"]]:
    """Return the similarity onto the points used, without those that fail the blunder test one after the other."""
    left_out, scores = np.zeros(len(use), bool), np.full(len(use), np.nan)
    start = Similarity(scale=1.0, rotation=np.eye(3), shift=np.median((xyz_m - source)[use], axis=0))
    start = fit_similarity(source[use], xyz_m[use], std_m[use], start)
    while True:
        rows = np.flatnonzero(use & ~left_out)
        parts = source[rows], xyz_m[rows], std_m[rows]
        found = fit_similarity(*parts, start, robust=False)
        over = _standardised(found, *parts)
        # a bent block scatters by more than marks and survey alone
        scores[rows] = _largest(over / max(float(np.nanmedian(over)) / 0.6745, 1.0))
        worst = rows[np.argmax(np.nan_to_num(scores[rows]))]
        if not scores[worst] > OUTLIER or len(rows) <= LEAST_TO_PLACE + 1:
            return found, scores, left_out
        left_out[worst] = True


def _standardised(
    similarity: Similarity,
    source: Float[np.ndarray, "n 3"],
    xyz_m: Float[np.ndarray, "n 3"],
    std_m: Float[np.ndarray, "n 3"],
) -> Float[np.ndarray, "n 3"]:
    """Return the standardised residuals, NaN where a coordinate is not known or nothing checks it."""
    placed = similarity.points(source)
    arm = placed - placed.mean(axis=0)
    zero = np.zeros(len(arm))
    x, y, z = arm.T
    tilt = determines_tilt(xyz_m, std_m)
    columns = [[zero, -z, y], [z, zero, -x]] if tilt else []
    columns += [[-y, x, zero], [x, y, z], *np.eye(3)[:, :, None] * np.ones(len(arm))]
    weight = np.where(np.isfinite(std_m), 1 / std_m, 0.0)
    design = np.array(columns).transpose(2, 1, 0) * weight[:, :, None]
    design = design.reshape(-1, design.shape[2])
    cofactor = np.linalg.pinv(design.T @ design, hermitian=True)
    share = (1 - np.einsum("ni,ij,nj->n", design, cofactor, design)).reshape(-1, 3)
    v = np.where(weight > 0, (placed - xyz_m) * weight, np.nan)
    return np.abs(v) / np.sqrt(np.where(share > 1e-3, share, np.nan))


def _pose_variance(adjusted: Adjusted, sigmas: Uncertainty, found: Intersected) -> Float[np.ndarray, "points 3"]:
    """Return the part of poses in the variance of points: what tie points around have beyond their own marks'."""
    block = adjusted.block
    total = sigmas.point_std_m**2
    poses = np.maximum(total - own_variance(block, adjusted.std_px), 0.0)
    known = np.flatnonzero(np.isfinite(total).any(axis=1) & (np.bincount(block.observation_point) >= 3))
    result = np.zeros(found.point_m.shape)
    here = np.isfinite(found.point_m).all(axis=1)
    if len(known) and here.any():
        near = KDTree(block.points_m[known, :2]).query(found.point_m[here, :2], k=min(_AROUND, len(known)))[1]
        near = near.reshape(here.sum(), -1)
        result[here] = np.nan_to_num(np.median(poses[known][near], axis=1))
    return result


def _mark_rms(found: Intersected, control: Control, use: Bool[np.ndarray, " marks"]) -> Float[np.ndarray, " points"]:
    known = use & np.isfinite(found.error_px)
    total = np.bincount(control.mark_point[known], found.error_px[known] ** 2, minlength=control.num_points)
    count = np.bincount(control.mark_point[known], minlength=control.num_points)
    return np.where(count > 0, np.sqrt(total / np.maximum(count, 1)), np.nan)


def _largest(rows: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, " n"]:
    known = np.isfinite(rows)
    return np.where(known.any(axis=1), np.max(np.where(known, rows, -np.inf), axis=1), np.nan)


def _rms(residual_m: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "3"]:
    known = np.isfinite(residual_m)
    total = np.where(known, residual_m**2, 0.0).sum(axis=0)
    return np.where(known.any(axis=0), np.sqrt(total / np.maximum(known.sum(axis=0), 1)), np.nan)
