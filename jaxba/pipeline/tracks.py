"""Stage tracks: matches joined to tracks, images to connected components."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from jaxba._errors import JaxbaError
from jaxba.engine._parameters import Parameters, parameter
from jaxba.engine._words import many, some
from jaxba.report import Told
from jaxba.scene import Features, Photo, Tracks, ViewGraph, build_tracks, pairs_between

_NAMED = 5  # images and pairs of each group that a message names


@dataclass(frozen=True, kw_only=True)
class Inputs:
    """- `photos`: of the metadata stage. `features`: by image index. `view_graph`: of the match stage."""

    photos: tuple[Photo, ...]
    features: Mapping[int, Features]
    view_graph: ViewGraph


@dataclass(frozen=True, kw_only=True)
class Params(Parameters):
    """What the user may set."""

    require_connected: bool = parameter(False, help="stop where the photos fall into several groups")


@dataclass(frozen=True, kw_only=True)
class Outputs:
    """- `tracks`: of all images; those of the largest component are solved. `notes`: what was found, in sentences."""

    tracks: Tracks
    notes: tuple[str, ...] = ()


def run(inputs: Inputs, params: Params) -> Outputs:
    """Join verified matches to tracks.

    Raises `JaxbaError` where no two photos are joined, and, with `require_connected`, where the photos that have
    keypoints fall into several groups.
    """
    tracks = build_tracks(inputs.view_graph, inputs.features, len(inputs.photos))
    if not tracks.components or len(tracks.components[0]) < 2:
        raise JaxbaError(_nothing_joined(inputs))
    groups = [group for group in tracks.components if any(_has_keypoints(inputs, image) for image in group)]
    notes = []
    if len(groups) > 1:
        text = _describe(groups, inputs)
        if params.require_connected:
            raise JaxbaError(text + " Or solve the largest group alone, without --require-connected.")
        notes.append(text + f" Only the largest group, {len(groups[0])} photos, is solved.")
    if tracks.num_conflicts:
        share = tracks.num_conflicts / (tracks.num_conflicts + tracks.num_observations)
        notes.append(
            f"Features left out, since their tracks would have had two of one photo: {tracks.num_conflicts:,} "
            f"({share:.1%})."
        )
    return Outputs(tracks=tracks, notes=tuple(notes))


def lines(outputs: Outputs, told: Told) -> list[str]:
    """Return what was made, in words."""
    tracks = outputs.tracks
    largest = f"{len(tracks.components[0])} of {many(len(told.photos), 'photo')} in the largest group"
    first = f"{tracks.num_tracks:,} tracks, {tracks.num_observations:,} observations; {largest}"
    return [first, *outputs.notes]


def facts(outputs: Outputs, told: Told) -> dict[str, Any]:
    """Return the photos of each group without common tracks, where there is more than one, the largest first."""
    groups = outputs.tracks.components
    return {"groups": [[told.photos[image] for image in group] for group in groups]} if len(groups) > 1 else {}


def _has_keypoints(inputs: Inputs, image: int) -> bool:
    return image in inputs.features and inputs.features[image].num_keypoints > 0


def _nothing_joined(inputs: Inputs) -> str:
    graph = inputs.view_graph
    if len(inputs.photos) == 1:
        return f"{inputs.photos[0].name} is the only photo that can be used; give two or more that overlap."
    described = sum(_has_keypoints(inputs, image) for image in range(len(inputs.photos)))
    if len(graph.pairs) == 0:
        return (
            f"none of the {len(inputs.photos)} photos was matched with another ({described} have keypoints): there is "
            "no candidate pair of photos with keypoints; set pairs.method=exhaustive, or give photos that overlap."
        )
    return (
        f"none of the {len(graph.pairs):,} candidate pairs of {len(inputs.photos)} photos ({described} have keypoints) "
        f"has enough verified matches; before verification a pair has {np.median(graph.num_putative):.0f} matches "
        f"(median), {graph.num_putative.max()} at most: too little overlap or texture (water, snow, blur). Lower "
        "features.contrast_threshold, raise features.nfeatures, or fly more overlap; if the photos do overlap, set "
        "pairs.method=exhaustive."
    )


def _describe(groups: Sequence[tuple[int, ...]], inputs: Inputs) -> str:
    """Return which photos fall apart and which pairs would join them."""
    graph, photos = inputs.view_graph, inputs.photos
    shown = [f"{len(group)} photos ({some([photos[i].name for i in group])})" for group in groups[:_NAMED]]
    if len(groups) > _NAMED:
        rest = [photos[group[0]].name for group in groups[_NAMED:]]
        shown.append(f"{len(rest)} smaller groups, that of {some(rest)}")
    between = pairs_between(groups, graph)
    text = f"The photos fall into {len(groups)} groups without common tracks: {'; '.join(shown)}."
    if len(between) == 0:
        return text + " No candidate pair joins them: set pairs.method=exhaustive, or fly photos between them."
    joining = [f"{photos[i].name}, {photos[j].name}" for i, j in graph.pairs[between[:_NAMED]].tolist()]
    most = graph.num_putative[between[0]]
    return (
        f"{text} {len(between)} candidate pairs would join them but have too few verified matches (at most {most} "
        f"before verification): {'; '.join(joining)}{' and others' if len(between) > _NAMED else ''}. Lower "
        "features.contrast_threshold, raise features.nfeatures, or fly more overlap between them."
    )
