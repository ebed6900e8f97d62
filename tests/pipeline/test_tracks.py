"""The stage names the groups that photos fall into, what would join them, and stops where nothing is joined."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from jaxba._errors import JaxbaError
from jaxba.pipeline import tracks
from jaxba.scene import EdgeStatus, Features, Photo, ViewGraph


def make_inputs(edges: dict[tuple[int, int], int], num_photos: int, *, empty=(), failed=()) -> tracks.Inputs:
    """Photos whose pairs share so many features, feature k with feature k; a pair of none is a rejected one."""
    pairs = sorted(edges)
    counts = [edges[pair] for pair in pairs]
    n = len(pairs)
    graph = ViewGraph(
        pairs=np.array(pairs, np.int32).reshape(-1, 2),
        status=np.array([EdgeStatus.GOOD if count else EdgeStatus.REJECTED for count in counts], np.uint8),
        offsets=np.concatenate([[0], np.cumsum(counts)]).astype(np.int64),
        matches=np.concatenate([np.zeros((0, 2), np.int32), *[np.arange(c, dtype=np.int32)[:, None].repeat(2, axis=1)
                                                              for c in counts]]),
        num_putative=np.array([count + 7 + i for (i, _), count in zip(pairs, counts, strict=True)], np.int32),
        is_planar=np.zeros(n, bool),
        quaternion=np.zeros((n, 4)), direction=np.zeros((n, 3)), residual_px=np.zeros(n),
        distinctiveness=np.zeros(n), angle_rad=np.zeros(n),
    )  # fmt: skip
    features = {
        i: Features(
            detector="sift",
            xy_px=np.random.default_rng(i).uniform(0, 99, size=(0 if i in empty else 60, 2)),
            size_px=np.ones(0 if i in empty else 60),
            angle_rad=np.zeros(0 if i in empty else 60),
            descriptors=np.zeros((0 if i in empty else 60, 128), np.uint8),
            rgb=np.zeros((0 if i in empty else 60, 3), np.uint8),
            mean_brightness=99.0,
            coverage=0.5,
        )
        for i in range(num_photos)
        if i not in failed
    }
    photos = tuple(
        Photo(name=f"{i}.jpg", path=Path(f"{i}.jpg"), sha256="", width_px=99, height_px=99, camera="a")
        for i in range(num_photos)
    )
    return tracks.Inputs(photos=photos, features=features, view_graph=graph)


CONNECTED = {(0, 1): 40, (1, 2): 40, (2, 3): 40, (3, 4): 40}
APART = {(0, 1): 40, (1, 2): 40, (2, 3): 0, (3, 4): 40, (1, 3): 0}


def test_connected_photos_give_tracks_through_all_of_them():
    outputs = tracks.run(make_inputs(CONNECTED, 5), tracks.Params(require_connected=True))
    assert outputs.tracks.num_tracks == 40
    assert outputs.tracks.num_observations == 200
    assert outputs.tracks.components == ((0, 1, 2, 3, 4),)
    assert outputs.notes == ()


def test_groups_are_named_with_the_pairs_that_would_join_them():
    outputs = tracks.run(make_inputs(APART, 5), tracks.Params())
    assert outputs.tracks.components == ((0, 1, 2), (3, 4))
    (note,) = outputs.notes
    assert "2 groups" in note
    assert "3 photos (0.jpg, 1.jpg, 2.jpg); 2 photos (3.jpg, 4.jpg)" in note
    assert "at most 9 before verification): 2.jpg, 3.jpg; 1.jpg, 3.jpg" in note  # that of most matches first
    assert note.endswith("Only the largest group, 3 photos, is solved.")


def test_require_connected_stops_where_photos_fall_apart():
    with pytest.raises(JaxbaError, match=r"2 groups.*3\.jpg, 4\.jpg.*2\.jpg, 3\.jpg.*without --require-connected"):
        tracks.run(make_inputs(APART, 5), tracks.Params(require_connected=True))


def test_groups_that_no_candidate_pair_joins_are_told_so():
    edges = {pair: count for pair, count in APART.items() if count}
    (note,) = tracks.run(make_inputs(edges, 5), tracks.Params()).notes
    assert "No candidate pair joins them: set pairs.method=exhaustive" in note


def test_many_groups_are_named_by_their_first_photos():
    edges = {(2 * k, 2 * k + 1): 40 for k in range(20)}
    (note,) = tracks.run(make_inputs(edges, 40), tracks.Params()).notes
    assert "20 groups" in note
    assert "15 smaller groups, that of 10.jpg, 12.jpg, 14.jpg, 16.jpg, 18.jpg and 10 more" in note


def test_photos_without_keypoints_are_no_group_to_connect():
    inputs = make_inputs(CONNECTED, 7, empty=[5], failed=[6])
    outputs = tracks.run(inputs, tracks.Params(require_connected=True))
    assert outputs.tracks.components == ((0, 1, 2, 3, 4), (5,), (6,))
    with pytest.raises(JaxbaError, match="2 groups"):
        tracks.run(make_inputs(CONNECTED, 7, empty=[5]), tracks.Params(require_connected=True))


def test_nothing_joined_stops_with_the_figures_and_the_cure():
    with pytest.raises(JaxbaError, match=r"none of the 2 candidate pairs of 4 photos \(3 have keypoints\).* 8 at most"):
        tracks.run(make_inputs({(0, 1): 0, (1, 2): 0}, 4, empty=[3]), tracks.Params())
    with pytest.raises(JaxbaError, match=r"no candidate pair.*pairs\.method=exhaustive"):
        tracks.run(make_inputs({}, 3), tracks.Params())
    with pytest.raises(JaxbaError, match=r"0\.jpg is the only photo that can be used; give two or more"):
        tracks.run(make_inputs({}, 1), tracks.Params())


def test_features_left_out_for_conflicts_are_counted_in_a_note():
    inputs = make_inputs(CONNECTED, 5)
    graph = inputs.view_graph
    doubled = dataclasses.replace(  # feature 50 of photo 0 is matched with feature 0 of photo 1, as feature 0 is
        graph,
        matches=np.insert(graph.matches, 40, [50, 0], axis=0),
        offsets=graph.offsets + (np.arange(len(graph.offsets)) > 0),
    )
    outputs = tracks.run(dataclasses.replace(inputs, view_graph=doubled), tracks.Params())
    assert outputs.tracks.num_conflicts == 1
    assert outputs.tracks.num_observations == 200
    assert outputs.notes == ("Features left out, since their tracks would have had two of one photo: 1 (0.5%).",)
