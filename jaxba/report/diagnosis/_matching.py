"""Rules on features, pairs and groups: too few matches, photos that fall apart, photos from one place."""

import numpy as np
from jaxtyping import Int

from jaxba.engine._words import some
from jaxba.report._recorded import Recorded
from jaxba.report.diagnosis._diagnosis import Diagnosis
from jaxba.scene import components, pairs_between

_OVERLAPS = 0.3  # pairs that overlap by more should match
_MOST = 0.5
_FEW_KEYPOINTS = 500  # of a photo with texture 2,000 and more are found at 0.3 megapixels
_THIN_COVERAGE = 0.6  # of an 8 x 8 grid: large parts without texture
_FEW_MATCHES = 30  # of a pair before verification: there is nothing to verify
_LEAST_ANGLE = 1.5  # degrees between two rays of a point
_LOST_TRACKS = 0.5
_NEAREST = 3


def few_matches(case: Recorded) -> Diagnosis | None:
    """Too few inliers on most pairs that should match: low overlap or low texture."""
    done = case.done
    if done.features is None or not len(done.features):
        return None
    keypoints = np.array([done.features[i].num_keypoints for i in sorted(done.features)])
    coverage = float(np.median([done.features[i].coverage for i in sorted(done.features)]))
    median = int(np.median(keypoints))
    figures: dict[str, object] = {"keypoints": median, "coverage": coverage}
    texture = f"a photo has {median:,} keypoints (median), which cover {coverage:.0%} of it"
    if done.match is None:
        if median >= _FEW_KEYPOINTS or case.stopped is None:
            return None
        return _poor_texture(texture, figures)
    graph, overlap = done.match.view_graph, done.retrieval.overlap
    rows = _rows_of(graph.pairs, done.retrieval.pairs)
    overlap = np.where(rows >= 0, overlap[rows], np.nan)
    typical = done.routing.overlap
    if np.isfinite(overlap).any():
        expected = overlap >= min(_OVERLAPS, typical)
        what = f"candidate pairs that should overlap by {min(_OVERLAPS, typical):.0%} or more"
        share = float(np.mean(~graph.is_edge[expected])) if expected.any() else 0.0
        count = f"{int((~graph.is_edge[expected]).sum())} of {int(expected.sum())} {what}"
    else:
        edges = np.bincount(graph.pairs[graph.is_edge].ravel(), minlength=len(done.photos))
        share = float(np.mean(edges == 0))
        count = f"{int((edges == 0).sum())} of {len(edges)} photos, whose overlap is not known,"
    if share <= _MOST:
        return None
    putative = int(np.median(graph.num_putative))
    least = done.settings["match"].min_inliers
    figures |= {"share_without_edge": share, "putative": putative, "min_inliers": least, "largest_overlap": typical}
    begin = f"{count} have fewer than {least} verified matches ({putative} before verification, median)"
    if median < _FEW_KEYPOINTS or coverage < _THIN_COVERAGE:
        return _poor_texture(f"{begin}; {texture}", figures)
    if np.isfinite(typical) and typical >= _OVERLAPS and putative >= _FEW_MATCHES:
        return None  # there are matches, and they do not fit: another rule's
    overlaps = f"a photo overlaps with its best partner by {typical:.0%} (median)" if np.isfinite(typical) else ""
    known = f"{begin}; {texture}" + (f"; {overlaps}" if overlaps else "")
    if np.isfinite(typical) and typical >= _OVERLAPS:
        return Diagnosis(
            name="few matches",
            cause=f"{known}. There is overlap and there are keypoints, but they do not agree: blur, water, or ground "
            "that looks alike everywhere.",
            cure="Set features.contrast_threshold=0.02 and features.nfeatures=16000, or fly again with a shorter "
            "exposure.",
            figures=figures,
        )
    return Diagnosis(
        name="few matches",
        cause=f"{known}. There is texture, so the photos overlap too little.",
        cure="Fly more overlap: 75% along a line and 60% between lines; until then raise features.nfeatures and "
        "match.ratio.",
        figures=figures,
    )


def _poor_texture(text: str, figures: dict[str, object]) -> Diagnosis:
    return Diagnosis(
        name="few matches",
        cause=f"{text}. The photos have too little texture: blur, water, snow, sand or darkness.",
        cure="Set features.contrast_threshold=0.02 and features.nfeatures=16000; look at the photos for blur, and fly "
        "again with a shorter exposure, higher, or with more overlap.",
        figures=figures,
    )


def several_groups(case: Recorded) -> Diagnosis | None:
    """More than one component: which photos fall apart, and which pairs would join them."""
    done = case.done
    if done.match is None:
        return None
    graph, names = done.match.view_graph, [photo.name for photo in done.photos]
    groups = [
        group
        for group in components(graph.pairs[graph.is_edge], len(names))
        if any(i in done.features and done.features[i].num_keypoints for i in group)
    ]
    if len(groups) < 2:
        return None
    between = pairs_between(groups, graph)
    shown = "; ".join(f"{len(group)} photos ({some([names[i] for i in group], 3)})" for group in groups[:_NEAREST])
    more = f"; and {len(groups) - _NEAREST} more" if len(groups) > _NEAREST else ""
    cause = f"The photos fall into {len(groups)} groups that no verified pair joins: {shown}{more}."
    joining = [f"{names[i]}, {names[j]}" for i, j in graph.pairs[between[:_NEAREST]].tolist()]
    if joining:
        most = int(graph.num_putative[between[0]])
        cause += f" {len(between)} candidate pairs lie between them, with {most} matches before verification at most: "
        cause += "too little in common that can be recognised, across water or woods, or after the light has changed."
    else:
        joining, how = _nearest_between(case, groups)
        cause += f" No candidate pair lies between them{how}: a missing line, or lines too far apart."
    return Diagnosis(
        name="several groups",
        cause=cause,
        cure=f"Pairs that would join them: {'; '.join(joining)}. Fly photos between these, or set "
        "pairs.method=exhaustive and features.contrast_threshold=0.02 where they do overlap.",
        figures={"groups": [[names[i] for i in group] for group in groups], "joining": joining},
    )


def _nearest_between(case: Recorded, groups: list[tuple[int, ...]]) -> tuple[list[str], str]:
    """Return the nearest pairs of photos of the largest group and each other one, and how far they are apart."""
    names, xyz = [photo.name for photo in case.done.photos], case.done.crs.reference.xyz_m
    found = []
    for group in groups[1:]:
        away = np.linalg.norm(xyz[list(groups[0]), None, :2] - xyz[None, list(group), :2], axis=-1)
        if np.isfinite(away).any():
            row, column = np.unravel_index(np.nanargmin(away), away.shape)
            found.append((float(away[row, column]), f"{names[groups[0][row]]}, {names[group[column]]}"))
    if not found:
        return [f"{names[groups[0][0]]}, {names[group[0]]}" for group in groups[1 : 1 + _NEAREST]], ""
    found.sort()
    return [text for _, text in found[:_NEAREST]], f", the nearest photos are {found[0][0]:.0f} m apart"


def degenerate(case: Recorded) -> Diagnosis | None:
    """Rays that hardly meet: photos from one place, or points on a line, whose depth is negative or not finite."""
    done = case.done
    if done.tracks is None:
        return None
    graph, names = done.match.view_graph, [photo.name for photo in done.photos]
    edges = np.flatnonzero(graph.is_edge)
    if not len(edges):
        return None
    angle = np.rad2deg(graph.angle_rad[edges])
    narrow = ~(angle >= _LEAST_ANGLE)  # NaN: no relative pose at all
    block = (done.adjust or done.start).block if done.adjust or done.start else None
    tracks = done.tracks.tracks
    is_point = np.zeros(tracks.num_tracks, bool)
    if block is not None:
        is_point[block.track_index] = True
    lost = float(np.mean(~is_point)) if block is not None and len(is_point) else np.nan
    if narrow.mean() <= _MOST and not lost > _LOST_TRACKS:
        return None
    if narrow.mean() <= _MOST and block is not None and done.adjust is not None and case.stopped is None:
        return None  # rejected by their errors, not by their angles
    worst = edges[narrow][np.argsort(-graph.num_inliers[edges[narrow]], kind="stable")]
    pairs = [f"{names[i]}, {names[j]}" for i, j in graph.pairs[worst].tolist()]
    known = angle[np.isfinite(angle)]
    text = f"{int(narrow.sum())} of {len(edges)} pairs have rays that meet at less than {_LEAST_ANGLE:g} degrees"
    text += f" (median {np.median(known):.2f})" if len(known) else " or no relative pose at all"
    dropped = (
        f"; {np.count_nonzero(~is_point):,} of {len(is_point):,} tracks give no point" if block is not None else ""
    )
    none = "; no track gives a point" if block is None and case.stopped is not None else ""
    return Diagnosis(
        name="degenerate geometry",
        cause=f"{text}{dropped}{none}. Depths are then negative or not finite: the photos were taken from one place "
        f"(turned, not moved), or their points lie on one line. The pairs: {some(pairs, 3)}.",
        cure="Leave out photos that were taken while hovering or turning, and fly a base of a tenth of the height or "
        "more; or lower start.min_angle.",
        figures={"narrow_pairs": int(narrow.sum()), "pairs": len(edges), "median_angle_deg": _median(known),
                 "tracks_dropped": int(np.count_nonzero(~is_point)), "tracks": len(is_point)},
    )  # fmt: skip


def _median(values: np.ndarray) -> float | None:
    return float(np.median(values)) if len(values) else None


def _rows_of(pairs: Int[np.ndarray, "pairs 2"], candidates: Int[np.ndarray, "candidates 2"]) -> np.ndarray:
    """Return the candidate's row of each pair."""
    row = {tuple(pair): k for k, pair in enumerate(candidates.tolist())}
    return np.array([row.get(tuple(pair), -1) for pair in pairs.tolist()], dtype=np.int64)
