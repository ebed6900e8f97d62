"""What is wrong with a model, as findings: figures of its claims and of its new adjustment against limits.

A limit is one of chance, in sigmas, together with one of practical size, since sigmas of a large block are so small
that anything differs by many of them:

    intrinsic       4 sigmas (one of 16,000 by chance), and pixels move by a thousandth of the image's longer side
    image           the quantile of chi-square (3 coordinates) that one of n images exceeds in one of a thousand
                    models, with sigmas enlarged to the median of all images; and its points move by 1 px and by
                    5 times the median of all images, which may move in common, as with another focal length
    wrong match     10 sigmas and 4 px from its point; a fault where over 1% of the observations are
    near parallel   no two rays of a point meet at the angle that an adjustment asks for; a fault over 5% of the points

A point behind its camera is a fault wherever it stands. What control says stands in `jaxba.sfm.control`.
"""

from typing import Any

import numpy as np
from jaxtyping import Bool, Float
from scipy.special import chdtri

from jaxba.audit._claims import Claims
from jaxba.audit._moved import MovedImages, MovedIntrinsic
from jaxba.audit._readjust import Readjusted
from jaxba.report import CONTROL_KINDS, is_to_act_on
from jaxba.scene import Block, Finding, Reconstruction

INTRINSIC_SIGMAS, INTRINSIC_SHARE = 4.0, 1e-3  # of the longer side
IMAGE_PX, IMAGE_TIMES = 1.0, 5.0
WRONG_SIGMAS, WRONG_PX, WRONG_SHARE = 10.0, 4.0, 0.01
PARALLEL_SHARE = 0.05
_BY_CHANCE = 1e-3
_MEDIAN_OF_THREE = 1.538  # of the root of a chi-square of three degrees of freedom
_SHOWN = 3
_OF_THE_CLAIMS = "claim differs", "point errors differ", "points behind"
_OF_THE_MODEL = "intrinsics off", "images off", "wrong matches", "rays near parallel"
_OF_THE_ADJUSTMENT = "image lost", "not settled", "not converged", "large median", "at bound"
_SAID_BETTER = "no sigmas", "focal moved"  # by the audit's own findings


def is_fault(finding: Finding) -> bool:
    """Return whether a finding says that something is wrong with a model, its claims or its control."""
    kinds = (*_OF_THE_CLAIMS, *_OF_THE_MODEL, *_OF_THE_ADJUSTMENT, *CONTROL_KINDS)
    return finding.kind in kinds and is_to_act_on(finding)


def findings(
    given: Reconstruction,
    claims: Claims,
    found: Readjusted,
    images: MovedImages,
    intrinsics: list[MovedIntrinsic],
    min_angle_deg: float,
) -> tuple[Finding, ...]:
    """Return all findings on a model: its faults first, then what the adjustment found, then notes."""
    others = [finding for finding in found.outputs.findings if finding.kind not in _SAID_BETTER]
    notes = [*given.notes, *found.notes]
    if not found.outputs.block.is_georeferenced:
        notes.append(
            "Without control the model has no place and no scale to give sigmas of positions and points in; lengths "
            "are in units of its own."
        )
    return (
        *of_claims(given, claims),
        *_intrinsics_off(found, intrinsics),
        *_images_off(found, images),
        *_wrong(found),
        *_parallel(found, min_angle_deg),
        *sorted(others, key=lambda finding: not is_fault(finding)),
        *(Finding.of("audit note", text=note) for note in notes),
    )


def of_claims(given: Reconstruction, claims: Claims) -> list[Finding]:
    """Return what the files say wrongly of their own model, and points that no camera can see."""
    found = [
        Finding.of(
            "claim differs", name=figure.name, unit=figure.unit, stated=figure.stated, recomputed=figure.recomputed,
            limit=figure.limit, place=figure.place,
        )
        for figure in claims.figures
        if figure.differs
    ]  # fmt: skip
    if claims.point_differs.any():
        off = np.where(claims.point_differs, np.abs(given.point_error - claims.point_error), 0.0)
        worst = int(np.argmax(off))
        found.append(
            Finding.of(
                "point errors differ",
                count=int(claims.point_differs.sum()),
                num_stated=int(np.isfinite(given.point_error).sum()),
                name=given.point_ids[worst],
                stated=float(given.point_error[worst]),
                recomputed=float(claims.point_error[worst]),
                unit=given.unit,
                limit=claims.point_limit,
            )
        )
    behind = claims.is_behind
    if behind.any():
        images, points = given.block.observation_image[behind], given.block.observation_point[behind]
        names = [given.names[k] for k in np.unique(images)]
        found.append(Finding.of("points behind", count=int(behind.sum()), points=len(np.unique(points)), names=names))
    return found


def intrinsic_limit_px(found: Readjusted, camera: str) -> float:
    """Return by how much pixels may move by an intrinsic of a camera."""
    return INTRINSIC_SHARE * max(max(of.width_px, of.height_px) for of in found.photos if of.camera == camera)


def is_off(found: Readjusted, one: MovedIntrinsic) -> bool:
    """Return whether an intrinsic moved beyond chance and by what matters."""
    return one.over_sigma > INTRINSIC_SIGMAS and one.apart_px > intrinsic_limit_px(found, one.camera)


def _intrinsics_off(found: Readjusted, intrinsics: list[MovedIntrinsic]) -> list[Finding]:
    off = sorted((one for one in intrinsics if is_off(found, one)), key=lambda one: -one.apart_px)
    if not off:
        return []
    return [
        Finding.of(
            "intrinsics off",
            cameras=[one.camera for one in off],
            parameters=[one.name for one in off],
            before=[one.before for one in off],
            after=[one.after for one in off],
            std=[one.std for one in off],
            over_sigma=[one.over_sigma for one in off],
            apart_px=[one.apart_px for one in off],
            least_px=[intrinsic_limit_px(found, one.camera) for one in off],
            limit_sigma=INTRINSIC_SIGMAS,
        )
    ]


def image_limits(images: MovedImages) -> tuple[float, float]:
    """Return how many sigmas, and how many pixels, an image may be off."""
    known = images.over_sigma[np.isfinite(images.over_sigma)]
    limit = float(np.sqrt(chdtri(3, _BY_CHANCE / max(len(images.shift), 1))))
    common = max(float(np.median(known)) / _MEDIAN_OF_THREE, 1.0) if len(known) else 1.0
    apart = images.apart_px[np.isfinite(images.apart_px)]
    return limit * common, max(IMAGE_PX, IMAGE_TIMES * float(np.median(apart))) if len(apart) else IMAGE_PX


def images_off(images: MovedImages) -> Bool[np.ndarray, " images"]:
    """Return which images moved beyond chance and by what matters."""
    limit_sigma, least_px = image_limits(images)
    with np.errstate(invalid="ignore"):
        far = (images.over_sigma > limit_sigma) | ~np.isfinite(images.over_sigma)
        return far & (images.apart_px > least_px)


def _images_off(found: Readjusted, images: MovedImages) -> list[Finding]:
    off = np.flatnonzero(images_off(images))
    if not len(off):
        return []
    off = off[np.argsort(-images.apart_px[off], kind="stable")]
    block: Block = found.outputs.block
    limit_sigma, least_px = image_limits(images)
    return [
        Finding.of(
            "images off",
            names=[found.photos[int(block.image_index[k])].name for k in off],
            shift=images.shift[off].tolist(),
            turn_deg=np.degrees(images.turn_rad[off]).tolist(),
            over_sigma=images.over_sigma[off].tolist(),
            apart_px=images.apart_px[off].tolist(),
            unit="m" if block.is_georeferenced else "",
            others_px=float(np.nanmedian(images.apart_px)),
            limit_sigma=limit_sigma,
            least_px=least_px,
        )
    ]


def wrong_limit_px(outputs: Any) -> float:
    """Return how far a wrong match misses its point, pixels."""
    return max(WRONG_SIGMAS * outputs.std_px * outputs.spread, WRONG_PX)


def wrong_matches(found: Readjusted) -> Bool[np.ndarray, " observations"]:
    """Return which of the tracks' observations are wrong matches.

    In a track that the adjustment kept, one that misses the point; in one that it rejected as a whole, one that misses
    the model's own point.
    """
    outputs, tracks, start = found.outputs, found.tracks, found.start
    block: Block = outputs.block
    limit = wrong_limit_px(outputs)
    points = np.full((tracks.num_tracks, 3), np.nan)
    points[block.track_index] = block.points_m
    is_lost = np.isnan(points[:, 0])[tracks.track_index]
    image_row = np.full(len(found.photos), -1)
    image_row[block.image_index] = np.arange(block.num_images)
    error = np.zeros(tracks.num_observations)
    mine = ~is_lost & (image_row[tracks.image_index] >= 0)
    rows = image_row[tracks.image_index[mine]]
    error[mine] = _errors_px(block, rows, points[tracks.track_index[mine]], tracks.xy_px[mine])
    error[is_lost] = _errors_px(
        start, tracks.image_index[is_lost], start.points_m[tracks.track_index[is_lost]], tracks.xy_px[is_lost]
    )
    return error > limit


def _errors_px(
    block: Block, image: np.ndarray, points: Float[np.ndarray, "rows 3"], xy_px: Float[np.ndarray, "rows 2"]
) -> Float[np.ndarray, " rows"]:
    """Return how far points are seen from pixels, each in one image; infinite behind it."""
    from jaxba.report.document import projected

    off = np.hypot(*(projected(block, image, points) - xy_px).T)
    return np.where(np.isfinite(off), off, np.inf)


def _wrong(found: Readjusted) -> list[Finding]:
    wrong = wrong_matches(found)
    count, total = int(wrong.sum()), len(wrong)
    if count <= WRONG_SHARE * total:
        return []
    of_image = np.bincount(found.tracks.image_index, minlength=len(found.photos))
    shares = np.bincount(found.tracks.image_index[wrong], minlength=len(found.photos)) / np.maximum(of_image, 1)
    worst = np.argsort(-shares, kind="stable")[:_SHOWN]
    return [
        Finding.of(
            "wrong matches",
            count=count,
            observations=total,
            limit_px=wrong_limit_px(found.outputs),
            std_px=found.outputs.std_px * found.outputs.spread,
            least_share=WRONG_SHARE,
            names=[found.photos[k].name for k in worst],
            shares=shares[worst].tolist(),
        )
    ]


def largest_angles_rad(block: Block) -> Float[np.ndarray, " points"]:
    """Return the largest angle between two rays of each point of a block whose observations are sorted by point."""
    ray = block.points_m[block.observation_point] - block.centers_m[block.observation_image]
    ray /= np.maximum(np.linalg.norm(ray, axis=1, keepdims=True), 1e-300)
    counts = np.bincount(block.observation_point, minlength=block.num_points)
    starts = np.cumsum(counts) - counts
    chord2 = np.zeros(block.num_points)
    for count in np.unique(counts):
        alike = np.flatnonzero(counts == count)
        rays = ray[starts[alike, None] + np.arange(count)]
        for step in range(1, count):
            apart = np.sum((rays[:, step:] - rays[:, :-step]) ** 2, axis=2)
            chord2[alike] = np.maximum(chord2[alike], apart.max(axis=1))
    return 2 * np.arcsin(np.minimum(np.sqrt(chord2) / 2, 1.0))


def num_parallel(found: Readjusted, min_angle_deg: float) -> int:
    """Return how many points of the model no two images see under that angle."""
    return int(np.count_nonzero(largest_angles_rad(found.start) < np.radians(min_angle_deg)))


def _parallel(found: Readjusted, min_angle_deg: float) -> list[Finding]:
    count, total = num_parallel(found, min_angle_deg), found.start.num_points
    if count <= PARALLEL_SHARE * total:
        return []
    figures: dict[str, Any] = {"count": count, "points": total, "angle_deg": min_angle_deg}
    return [Finding.of("rays near parallel", least_share=PARALLEL_SHARE, **figures)]
