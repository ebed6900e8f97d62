"""Findings: what a surveyor should know of an adjusted block, each a kind and its figures; `jaxba.report` has words."""

import dataclasses
from collections.abc import Callable, Sequence
from itertools import pairwise

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.special import gammaincinv

from jaxba.geometry import CAMERAS
from jaxba.scene import Block, Finding, Photo, Reference, described
from jaxba.sfm._adjust import Adjusted
from jaxba.sfm._attitude_findings import attitude_findings
from jaxba.sfm._intrinsics import intrinsics_at_bounds, natural_intrinsics
from jaxba.sfm._measured import BY_CHANCE, OUTLIER, PLAIN_M, robust_limit, used_positions
from jaxba.sfm._uncertainty import Uncertainty

_SCATTER = 1.5
_WEAK_OBSERVATIONS = 20
_FOCAL_OFF = 0.05  # from the photos' focal length
_CENTER_OFF = 0.03  # of the width
_HEIGHT_SIGMA = 0.02  # of the height above ground, from the focal length's sigma
_HEIGHT_OFF = 0.05  # adjusted against measured height above ground
_NADIR = 0.97  # mean |cosine| between viewing directions and the vertical: 14 degrees
_ONE_HEIGHT = 0.1  # spread of the flying height, as a share of it
_DRIFT = 0.5  # share of the variance of height residuals that a trend explains


@dataclasses.dataclass(frozen=True)
class GnssFit:
    """Adjusted minus measured positions.

    - `residual_m`: of every registered image, NaN where nothing was measured or not used.
    - `is_outlier`: beyond `limit` robust sigmas. `rms_m`: an axis over the `num` others; None without any.
    - `scale_m`: robust sigma of the residuals about their median `middle_m`, an axis, metres.
    - `limit`: of an outlier, in robust sigmas.
    """

    residual_m: Float[np.ndarray, "images 3"]
    is_outlier: Bool[np.ndarray, " images"]
    rms_m: tuple[float, float, float] | None
    num: int
    scale_m: Float[np.ndarray, "3"]
    middle_m: Float[np.ndarray, "3"]
    limit: float


def gnss_fit(block: Block, reference: Reference) -> GnssFit:
    """Return how well the block fits its measured positions.

    An outlier's residual is over its limit in some axis: 3.29 of the position's own sigmas, and as many robust ones
    of the residuals as Student's t exceeds by chance in one of a thousand. Both are counted from the median: what all
    have in common is no error of each.
    """
    used = used_positions(block, reference)
    index = block.image_index
    known = used[:, None] & np.isfinite(reference.std_m[index]) & np.isfinite(reference.xyz_m[index])
    residual = np.where(known, block.centers_m - reference.xyz_m[index], np.nan)
    columns = list(zip(residual.T, known.T, strict=True))
    middle = np.array([np.median(r[k]) if k.any() else np.nan for r, k in columns])
    scale = np.array(
        [1.4826 * np.median(np.abs(r[k] - m)) if k.any() else np.nan for (r, k), m in zip(columns, middle, strict=True)]
    )
    own = np.where(known, reference.std_m[index], np.nan)
    # a plain receiver's sigma of metres is mostly a common offset: what scatters within a flight is judged by itself
    robust = robust_limit(int(np.count_nonzero(used)))
    limit = np.maximum(robust * scale, np.where(own > PLAIN_M, own, OUTLIER * own))
    with np.errstate(invalid="ignore"):
        outlier = used & np.any(np.abs(residual - middle) > limit, axis=1)
    inlier = used & ~outlier
    rms = None
    if inlier.any():
        with np.errstate(invalid="ignore"):
            squared = [np.nanmean(c**2) if np.isfinite(c).any() else np.nan for c in residual[inlier].T]
        east, north, up = (float(np.sqrt(s)) for s in squared)
        rms = (east, north, up)
    return GnssFit(residual, outlier, rms, int(inlier.sum()), scale, middle, robust)


def findings(
    adjusted: Adjusted,
    start: Block,
    sigmas: Uncertainty,
    fit: GnssFit,
    reference: Reference,
    photos: Sequence[Photo],
    *,
    is_controlled: bool = False,
) -> tuple[Finding, ...]:
    """Return the findings on an adjusted block.

    - `start`: the block before the adjustment. `is_controlled`: control points fix it in all axes.
    """
    block = adjusted.block
    parts: tuple[tuple[str, Callable[[], Sequence[Finding]]], ...] = (
        ("Convergence", lambda: _convergence(adjusted)),
        ("Edges left out", lambda: _edges(adjusted)),
        ("Images", lambda: _images(adjusted, photos)),
        ("Contradicting positions", lambda: _outliers(block, fit, photos)),
        ("Scatter of positions", lambda: _scatter(adjusted, reference, fit)),
        ("Drift of heights", lambda: _height_drift(block, reference)),
        ("Use of heights", lambda: _no_heights(block, reference)),
        ("Datum of heights", lambda: _assumed_datum(block, reference)),
        ("Attitudes", lambda: attitude_findings(block, reference, photos)),
        ("Focal length against height", lambda: _focal_and_height(block, sigmas, reference, is_controlled)),
        ("Intrinsics", lambda: _intrinsics(block, start, photos)),
        ("Sigmas of positions", lambda: _positions(block, sigmas, reference, photos, is_controlled)),
        ("Sigmas", lambda: [Finding.of("no sigmas", text=sigmas.why_not)] if sigmas.why_not else []),
        ("Sigmas of the shape", lambda: [Finding.of("sigmas of the shape")] if sigmas.is_of_shape else []),
    )
    found: list[Finding] = []
    for what, find in parts:
        made, notes = described(what, find, [])
        found += [*made, *(Finding.of("note", text=f"{note}.") for note in notes)]
    return tuple(found)


def height_above_ground(block: Block) -> Float[np.ndarray, " images"]:
    """Return the height of each camera over the median of its own points, metres; NaN where it has none."""
    order = np.argsort(block.observation_image, kind="stable")
    z = block.points_m[block.observation_point[order], 2]
    image = block.observation_image[order]
    bounds = np.searchsorted(image, np.arange(block.num_images + 1))
    ground = [np.median(z[a:b]) if b > a else np.nan for a, b in pairwise(bounds)]
    return block.centers_m[:, 2] - np.array(ground)


def _convergence(adjusted: Adjusted) -> list[Finding]:
    found = [Finding.of("note", text=note) for note in adjusted.notes]
    medians_px = [float(median) for median in adjusted.medians_px]
    if not adjusted.converged and len(medians_px) > 2:
        found.append(Finding.of("not settled", medians_px=medians_px))
    if not adjusted.solution.converged:
        found.append(Finding.of("not converged", advice=adjusted.solution.advice))
    if medians_px[-1] > 3.0:
        found.append(Finding.of("large median", median_px=medians_px[-1]))
    return found


def _edges(adjusted: Adjusted) -> list[Finding]:
    """All edges that were left out, the worst first."""
    if not adjusted.pruned:
        return []
    worst_first = sorted(adjusted.pruned, key=lambda edge: -edge.median_px)
    return [
        Finding.of(
            "edges left out",
            names=[edge.name for edge in worst_first],
            matches=[edge.num_matches for edge in worst_first],
            median_px=[edge.median_px for edge in worst_first],
            limit_px=worst_first[0].limit_px,
        )
    ]


def _images(adjusted: Adjusted, photos: Sequence[Photo]) -> list[Finding]:
    block = adjusted.block
    found = [Finding.of("image lost", name=left.name, reason=left.reason) for left in adjusted.lost]
    counts = np.bincount(block.observation_image, minlength=block.num_images)
    weak = np.flatnonzero(counts < _WEAK_OBSERVATIONS)
    if len(weak):
        names = _names(block, photos, weak)
        found.append(Finding.of("few points", names=names, points=counts[weak].tolist(), least=_WEAK_OBSERVATIONS))
    return found


def _outliers(block: Block, fit: GnssFit, photos: Sequence[Photo]) -> list[Finding]:
    bad = np.flatnonzero(fit.is_outlier)
    if not len(bad):
        return []
    bad = bad[np.argsort(-np.nan_to_num(np.abs(fit.residual_m[bad])).max(axis=1), kind="stable")]
    return [
        Finding.of(
            "positions contradict",
            names=_names(block, photos, bad),
            residual_m=fit.residual_m[bad].tolist(),
            measured=fit.num + len(bad),
            sigmas=fit.limit,
        )
    ]


def _scatter(adjusted: Adjusted, reference: Reference, fit: GnssFit) -> list[Finding]:
    """Axes in which residuals are over 1.5 times their sigmas, and more than chance makes them (chi-square, 0.1%)."""
    index = adjusted.block.image_index
    if not used_positions(adjusted.block, reference).any():
        return []
    stated = np.median(reference.std_m[index[used_positions(adjusted.block, reference)]], axis=0)
    ratio = np.where(fit.is_outlier[:, None], np.nan, (fit.residual_m - fit.middle_m) / reference.std_m[index])
    known = np.count_nonzero(np.isfinite(ratio), axis=0)
    # the quantile of chi-square; `scipy.stats`, which has it by name, takes 0.5 s to import
    by_chance = 2 * gammaincinv(np.maximum(known, 1) / 2, 1 - BY_CHANCE)
    excess = (adjusted.position_scale >= _SCATTER) & (fit.scale_m >= _SCATTER * stated)
    excess &= np.nansum(ratio**2, axis=0) > by_chance
    if not excess.any():
        return []
    return [
        Finding.of(
            "positions scatter",
            axes=[axis for axis, much in zip(("east", "north", "up"), excess, strict=True) if much],
            scale_m=fit.scale_m[excess].tolist(),
            stated_m=stated[excess].tolist(),
        )
    ]


def _height_drift(block: Block, reference: Reference) -> list[Finding]:
    """Heights that wander in the order of the photos: a receiver that drifts, not noise."""
    every = block.image_index
    measured = np.isfinite(reference.xyz_m[every, 2]) & np.isfinite(reference.std_m[every, 2])
    rows = np.flatnonzero(measured & block.is_georeferenced)
    if len(rows) < 8:
        return []
    residual = block.centers_m[rows, 2] - reference.xyz_m[every[rows], 2]
    time = np.linspace(-1, 1, len(rows))
    slope, _ = np.polyfit(time, residual, 1)
    share = 1 - np.var(residual - np.polyval(np.polyfit(time, residual, 1), time)) / max(np.var(residual), 1e-12)
    limit = max(3 * float(np.median(reference.std_m[every[rows], 2])), 0.1)
    if share < _DRIFT or 2 * abs(slope) < limit:
        return []
    return [Finding.of("heights drift", drift_m=float(2 * abs(slope)), share=float(share))]


def _no_heights(block: Block, reference: Reference) -> list[Finding]:
    index = block.image_index[used_positions(block, reference)]
    if not len(index) or np.isfinite(reference.std_m[index, 2]).any():
        return []
    return [Finding.of("no heights")]


def _assumed_datum(block: Block, reference: Reference) -> list[Finding]:
    assumed = reference.assumed_datum
    if assumed is None or not block.is_georeferenced:
        return []
    return [Finding.of("height datum assumed", of=list(assumed.of), datum=assumed.datum)]


def _focal_and_height(block: Block, sigmas: Uncertainty, reference: Reference, is_controlled: bool) -> list[Finding]:
    """The focal length and the height above ground of a flat nadir block trade off: df / f = dh / h.

    The flight's own record is compared where no control points have fixed heights.
    """
    if not block.is_georeferenced:
        return []
    names = CAMERAS[block.camera_model].parameter_names()
    adjusted_m = height_above_ground(block)
    measured_m = reference.height_above_ground_m[block.image_index]
    height = float(np.nanmedian(adjusted_m))
    if not height > 0:
        return []
    focal, sigma = block.camera_parameters[0, 0], sigmas.intrinsics_std[0, 0]
    share = sigma / focal
    both = np.isfinite(adjusted_m) & np.isfinite(measured_m)
    flight: dict[str, float] = {}
    if both.any():
        adjusted_median, measured_median = float(np.median(adjusted_m[both])), float(np.median(measured_m[both]))
        if abs(adjusted_median / measured_median - 1) > _HEIGHT_OFF and not is_controlled:
            flight = {"above_ground_m": adjusted_median, "above_take_off_m": measured_median}
    if not flight and not (np.isfinite(share) and share > _HEIGHT_SIGMA):
        return []
    return [
        Finding.of(
            "focal and height",
            parameter=names[0],
            focal_px=float(focal),
            std_px=float(sigma),
            height_m=height,
            looks=_looks(block, adjusted_m),
            **flight,
        )
    ]


def _looks(block: Block, height_m: Float[np.ndarray, " images"]) -> str:
    """Return how the cameras look: `down from one height`, `down`, or `around`."""
    x, y = block.quaternion[:, 1], block.quaternion[:, 2]
    down = np.abs(1 - 2 * (x**2 + y**2))  # the viewing direction's vertical part
    if np.mean(down) < _NADIR:
        return "around"
    spread = np.ptp(np.percentile(block.centers_m[:, 2], [5, 95])) / max(float(np.nanmedian(height_m)), 1e-9)
    return "down from one height" if spread < _ONE_HEIGHT else "down"


def _intrinsics(block: Block, start: Block, photos: Sequence[Photo]) -> list[Finding]:
    natural = natural_intrinsics(start, photos)
    names = CAMERAS[block.camera_model].parameter_names()
    at_bound = {(bound.camera, bound.parameter): bound for bound in intrinsics_at_bounds(block, start, photos)}
    found = []
    for c, label in enumerate(block.camera_names):
        values = block.camera_parameters[c]
        width = 2 * natural.center[c, names.index("cx")]
        for k, name in enumerate(names):
            value, natural_px = float(values[k]), float(natural.center[c, k])
            of = {"camera": label, "parameter": name, "value": value}
            if (label, name) in at_bound:
                bound = at_bound[label, name]
                found.append(Finding.of("at bound", **of, low=float(bound.low), high=float(bound.high)))
            elif name in ("f", "fx") and abs(value / natural_px - 1) > _FOCAL_OFF:
                found.append(Finding.of("focal moved", **of, before=natural_px))
            elif name in ("cx", "cy") and abs(value - natural_px) > _CENTER_OFF * width:
                found.append(Finding.of("principal point off", **of, middle=natural_px))
    return found


def _positions(
    block: Block, sigmas: Uncertainty, reference: Reference, photos: Sequence[Photo], is_controlled: bool
) -> list[Finding]:
    std = sigmas.position_std_m
    known = np.isfinite(std).all(axis=0)  # not the axes in which no position is measured
    if not known.any():
        return []
    found = []
    largest = std[:, known].max(axis=1)
    middle = float(np.median(largest))
    weak = np.flatnonzero(largest > max(5 * middle, 0.02))
    if len(weak):
        names, std_m = _names(block, photos, weak), largest[weak].tolist()
        found.append(Finding.of("weak positions", names=names, std_m=std_m, median_m=middle))
    used = used_positions(block, reference)
    if used.any() and not is_controlled:
        stated = np.median(reference.std_m[block.image_index[used]], axis=0)
        plain = np.isfinite(stated) & (stated > PLAIN_M)
        if plain.any():
            axes = [axis for axis, much in zip(("east", "north", "up"), plain, strict=True) if much]
            figures = {"axes": axes, "receiver_std_m": stated[plain].tolist()}
            found.append(Finding.of("common offset", median_m=middle, **figures))
    return found


def _names(block: Block, photos: Sequence[Photo], rows: Int[np.ndarray, " rows"]) -> list[str]:
    return [photos[int(block.image_index[i])].name for i in rows]
