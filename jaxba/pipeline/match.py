"""Stage match: verified matches of one photo with its candidate partners; called once a photo, in workers."""

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from jaxba.engine._parameters import Parameters, parameter
from jaxba.pipeline._fallback import FallbackKeypoints, detect_fallback
from jaxba.report import Told, grouped, pair_facts, pair_lines, with_ranges
from jaxba.scene import (
    EdgeStatus,
    Fallback,
    Features,
    LeftOut,
    Missed,
    Model,
    PairRecord,
    Photo,
    Reference,
    ViewGraph,
)
from jaxba.vision import (
    Descriptors,
    PairMatches,
    PairOptions,
    Pinhole,
    PosePrior,
    View,
    grid_coverage,
    match_pair,
    prepare_descriptors,
)

_ATTITUDE_STD_RAD = 0.05  # where the reference states none


@dataclass(frozen=True, kw_only=True, eq=False)
class Inputs:
    """One photo and those of its candidate partners whose index is larger.

    - `image`: its index. `partners`: theirs, rising. `overlap`: of each pair, NaN where unknown.
    - `photos`: all photos. `reference`: for the planar two-fold ambiguity; its heights, for the fallback of ORB.
    - `features`: by image index, opened on access; a partner whose features failed is not among `partners`.
    """

    image: int
    partners: Int[np.ndarray, " partners"]
    overlap: Float[np.ndarray, " partners"]
    photos: tuple[Photo, ...]
    reference: Reference
    features: Mapping[int, Features]


@dataclass(frozen=True, kw_only=True)
class Params(Parameters):
    """What the user may set."""

    ratio: float = parameter(0.75, low=0.6, high=0.85, help="nearest over second nearest descriptor distance")
    learned_ratio: float = parameter(0.9, low=0.6, high=0.98, help="the same of learned descriptors")
    ransac_threshold: float | None = parameter(
        None,
        low=0.5,
        high=5,
        help="px; none: 2 over 85% overlap, 3 at 12 to 20 MP, 4 at other widths of 3840 px and more, 3 below",
    )
    epipolar_threshold: float | None = parameter(
        None, low=0.5, high=3, help="px, off the plane: of essential and fundamental matrices; none: ransac_threshold"
    )
    confidence: float = parameter(0.99, low=0.9, high=0.9999, help="of the sample consensus")
    min_inliers: int = parameter(12, low=8, high=30, help="fewer verified matches make no edge")
    min_good: int = parameter(30, low=8, high=100, help="verified matches of a good pair")
    min_inlier_ratio: float = parameter(0.35, low=0.2, high=0.8, help="verified over putative matches of a good pair")
    fallback_gsd: float = parameter(
        0.03, low=0.005, high=0.5, help="m/px; a pair not good with ORB is matched with SIFT over this ground sample"
    )
    fallback_nfeatures: int = parameter(12000, low=2000, high=20000, help="the most keypoints of SIFT then")
    fallback_contrast: float = parameter(0.03, low=0.02, high=0.08, help="its contrast threshold")
    fallback_edge: float = parameter(12.0, low=5, high=20, help="its edge threshold")


@dataclass(frozen=True, kw_only=True)
class Outputs:
    """- `view_graph`: the photo's pairs.
    - `fallback`: SIFT keypoints of photos with a pair that failed with ORB and was matched with SIFT. Its matches count
      them on from the photo's ORB features.
    - `record`: what was decided on each pair, in the view graph's order.
    - `notes`: what could not be measured of pairs.
    """

    view_graph: ViewGraph
    record: PairRecord
    fallback: tuple[FallbackKeypoints, ...] = ()
    notes: tuple[LeftOut, ...] = ()

    @property
    def num_fallback(self) -> int:
        """How many pairs were matched with SIFT after ORB."""
        return int((self.record.fallback == Fallback.TAKEN).sum())


def run(inputs: Inputs, params: Params) -> Outputs:
    """Match one photo with its partners and verify the matches.

    Keypoints at one position, of several orientations, all take part; matches speak of the first of them. A pair that
    fails is an edge of status `REJECTED`, without matches, its figures kept. Where the features are ORB and the pair's
    ground sample distance is known to be coarse, a pair that is not good is matched with SIFT, too, and the better of
    both is kept.

    Raises `JaxbaError` where that needs a photo which cannot be decoded any more.
    """
    features = inputs.features[inputs.image]
    prepared = prepare_descriptors(features)
    own: tuple[Features, Descriptors] | None = None  # SIFT, once a pair asks for it
    edges, records, fallback = [], [], {}
    notes: list[LeftOut] = []
    for partner, overlap in zip(inputs.partners.tolist(), inputs.overlap.tolist(), strict=True):
        others = inputs.features[partner]
        edge, record = _matched(inputs, partner, overlap, features, prepared, others, params, notes)
        outcome, gsd_m = _may_fall_back(inputs, partner, edge, features, others, params)
        if outcome == Fallback.TAKEN:
            if own is None:
                found = _sift(inputs, inputs.image, params)
                own = found, prepare_descriptors(found)
            sift = _sift(inputs, partner, params)
            again, its_record = _matched(inputs, partner, overlap, *own, sift, params, notes)
            if (again.status[0], again.num_inliers[0]) > (edge.status[0], edge.num_inliers[0]):
                behind = np.array([features.num_keypoints, others.num_keypoints], np.int32)
                edge, record = dataclasses.replace(again, matches=again.matches + behind), its_record
                for image, kind in ((inputs.image, own[0]), (partner, sift)):
                    fallback[image] = FallbackKeypoints(image=image, xy_px=kind.xy_px, rgb=kind.rgb)
            else:
                outcome = Fallback.NOT_BETTER
        edges.append(edge)
        records.append(dataclasses.replace(record, fallback=np.array([outcome], np.uint8), gsd_m=np.array([gsd_m])))
    return Outputs(
        view_graph=ViewGraph.concatenate(edges),
        record=PairRecord.concatenate(records),
        fallback=tuple(fallback.values()),
        notes=tuple(notes),
    )


def lines(outputs: Outputs, told: Told) -> list[str]:
    """Return what was made of all photos, in words."""
    graph = outputs.view_graph
    good, weak = (int((graph.status == status).sum()) for status in (EdgeStatus.GOOD, EdgeStatus.WEAK))
    rejected = len(graph.pairs) - good - weak
    first = f"{good:,} good pairs, {weak:,} weak, {rejected:,} rejected; {len(graph.matches):,} matches"
    odd = grouped(with_ranges(outputs.notes))
    return [first, *pair_lines(graph, outputs.record), *grouped(told.left_out), *odd]


def facts(outputs: Outputs, told: Told) -> dict[str, Any]:
    """Return how many pairs got which threshold and model, missed which figure, and fell back or why not."""
    return {"match": pair_facts(outputs.view_graph, outputs.record)}


def _sift(inputs: Inputs, image: int, params: Params) -> Features:
    return detect_fallback(
        inputs.photos[image],
        nfeatures=params.fallback_nfeatures,
        contrast_threshold=float(params.fallback_contrast),
        edge_threshold=float(params.fallback_edge),
    )


def _matched(
    inputs: Inputs,
    partner: int,
    overlap: float,
    features: Features,
    prepared: Descriptors,
    others: Features,
    params: Params,
    notes: list[LeftOut],
) -> tuple[ViewGraph, PairRecord]:
    """Return the view graph of one pair, matched by features of one kind, and how it was verified."""
    first, second = inputs.photos[inputs.image], inputs.photos[partner]
    threshold_px = float(params.ransac_threshold or _threshold_px(first, second, overlap))
    options = PairOptions(
        ratio=params.learned_ratio if features.kind == "unit" else params.ratio,
        threshold_px=threshold_px,
        epipolar_threshold_px=None if params.epipolar_threshold is None else float(params.epipolar_threshold),
        confidence=float(params.confidence),
        min_inliers=params.min_inliers,
    )
    found = match_pair(
        View(xy_px=features.xy_px, descriptors=prepared, pinhole=_pinhole(first)),
        View(xy_px=others.xy_px, descriptors=prepare_descriptors(others), pinhole=_pinhole(second)),
        options,
        _prior(inputs.reference, inputs.image, partner),
    )
    notes += [LeftOut(name=f"{first.name}, {second.name}", reason=note) for note in found.notes]
    inliers = found.matches[found.two_view.is_inlier]
    coverage = min(
        grid_coverage(features.xy_px[inliers[:, 0]], first.width_px, first.height_px),
        grid_coverage(others.xy_px[inliers[:, 1]], second.width_px, second.height_px),
    )
    missed = _missed(found, params)
    record = PairRecord.of(
        threshold_px=threshold_px,
        model=Model[found.two_view.model.upper()],
        missed=missed,
        num_verified=found.two_view.num_explained,
    )
    return _edge(inputs.image, partner, found, coverage, missed), record


def _missed(found: PairMatches, params: Params) -> Missed:
    """Return the first figure that a pair misses."""
    num_inliers = found.two_view.num_inliers
    if found.num_putative < params.min_inliers:
        return Missed.MATCHES
    if num_inliers < params.min_inliers:
        return Missed.VERIFIED
    if num_inliers < params.min_good:
        return Missed.MIN_GOOD
    return Missed.NOTHING if num_inliers >= params.min_inlier_ratio * found.num_putative else Missed.MIN_INLIER_RATIO


def _may_fall_back(
    inputs: Inputs, partner: int, edge: ViewGraph, features: Features, others: Features, params: Params
) -> tuple[Fallback, float]:
    """Return whether a pair that is not good is to be matched with SIFT, or why not, and its ground sample distance."""
    if edge.status[0] == EdgeStatus.GOOD or features.detector != "orb" or others.detector != "orb":
        return Fallback.NONE, np.nan
    images = [inputs.image, partner]
    focal_px = np.array([inputs.photos[i].focal_px or np.nan for i in images])
    gsd_m = float(np.mean(inputs.reference.height_above_ground_m[images] / focal_px))
    if np.isnan(gsd_m):
        return Fallback.GSD_UNKNOWN, gsd_m
    return (Fallback.TAKEN if gsd_m > params.fallback_gsd else Fallback.GSD_TOO_FINE), gsd_m


def _edge(
    image: int,
    partner: int,
    found: PairMatches,
    coverage: float,
    missed: Missed,
) -> ViewGraph:
    """Return the view graph of one pair."""
    from scipy.spatial.transform import Rotation

    two_view = found.two_view
    inliers = found.matches[two_view.is_inlier]
    status = EdgeStatus.REJECTED
    if missed not in (Missed.MATCHES, Missed.VERIFIED):
        status = EdgeStatus.GOOD if missed == Missed.NOTHING else EdgeStatus.WEAK
    has_pose = bool(np.isfinite(two_view.direction).all())
    quaternion = np.full(4, np.nan)
    if has_pose:
        quaternion = Rotation.from_matrix(two_view.rotation).as_quat(scalar_first=True, canonical=True)
    return ViewGraph(
        pairs=np.array([[image, partner]], np.int32),
        status=np.array([status], np.uint8),
        offsets=np.array([0, len(inliers)], np.int64),
        matches=inliers.astype(np.int32),
        num_putative=np.array([found.num_putative], np.int32),
        is_planar=np.array([two_view.is_planar]),
        quaternion=quaternion[None],
        direction=two_view.direction[None],
        residual_px=np.array([two_view.residual_px]),
        distinctiveness=np.array([np.median(found.distinctiveness[two_view.is_inlier]) if len(inliers) else np.nan]),
        angle_rad=np.array([two_view.angle_rad]),
        coverage=np.array([coverage]),
    )


def _pinhole(photo: Photo) -> Pinhole:
    return Pinhole(width_px=photo.width_px, height_px=photo.height_px, focal_px=photo.focal_px)


def _threshold_px(first: Photo, second: Photo, overlap: float) -> float:
    """Return the threshold that fits a pair's overlap and resolution; an unknown overlap counts as a low one.

    Of two sizes the one with the larger threshold counts. 12 to 20 MP come before the width, which is over 3840 there.
    """
    if overlap > 0.85:
        return 2.0
    sizes = [(photo.megapixels, max(photo.width_px, photo.height_px)) for photo in (first, second)]
    return max(3.0 if 12 <= megapixels <= 20 or side < 3840 else 4.0 for megapixels, side in sizes)


def _prior(reference: Reference, i: int, j: int) -> PosePrior | None:
    """Return what the attitudes of two images, and their positions, tell of their relative pose."""
    from scipy.spatial.transform import Rotation

    quaternions = reference.quaternion[[i, j]]
    if not np.isfinite(quaternions).all():
        return None
    rotation_i, rotation_j = Rotation.from_quat(quaternions, scalar_first=True).as_matrix()
    std_rad = float(np.sqrt(np.mean(reference.attitude_std_rad[[i, j]] ** 2) * 2))
    std_rad = std_rad if np.isfinite(std_rad) and std_rad > 0 else _ATTITUDE_STD_RAD
    rotation = rotation_j @ rotation_i.T
    if not reference.is_used[[i, j]].all():
        return PosePrior(rotation=rotation, rotation_std_rad=std_rad)
    step_m = reference.xyz_m[i] - reference.xyz_m[j]
    length_m = float(np.linalg.norm(step_m))
    across_m = float(np.sqrt(np.sum(reference.std_m[[i, j]] ** 2) / 3))
    if not length_m > 3 * across_m:  # the positions do not tell a direction
        return PosePrior(rotation=rotation, rotation_std_rad=std_rad)
    return PosePrior(
        rotation=rotation,
        rotation_std_rad=std_rad,
        direction=rotation_j @ step_m / length_m,
        direction_std_rad=float(np.hypot(std_rad, across_m / length_m)),
    )
