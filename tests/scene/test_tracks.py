"""Tracks against a union-find over dictionaries, and against the points of a simulated survey with wrong matches."""

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from jaxba.scene import EdgeStatus, Features, Tracks, ViewGraph, build_tracks


def make_features(xy_px, rgb=None) -> Features:
    xy_px = np.asarray(xy_px, float).reshape(-1, 2)
    count = len(xy_px)
    rgb = np.zeros((count, 3), np.uint8) if rgb is None else np.asarray(rgb, np.uint8)
    return Features(
        detector="sift", xy_px=xy_px, size_px=np.ones(count), angle_rad=np.zeros(count),
        descriptors=np.zeros((count, 128), np.uint8), rgb=rgb, mean_brightness=99.0, coverage=0.5,
    )  # fmt: skip


def distinct_features(num_images: int, count: int) -> dict[int, Features]:
    return {i: make_features(np.stack([np.arange(count), np.full(count, i)], axis=1)) for i in range(num_images)}


def make_graph(edges: dict[tuple[int, int], list[tuple[int, int]]], weak=()) -> ViewGraph:
    pairs = sorted(edges)
    count = len(pairs)
    lengths = [len(edges[pair]) for pair in pairs]
    status = [EdgeStatus.WEAK if p in weak else EdgeStatus.GOOD if n else EdgeStatus.REJECTED
              for p, n in zip(pairs, lengths, strict=True)]  # fmt: skip
    return ViewGraph(
        pairs=np.array(pairs, np.int32).reshape(-1, 2),
        status=np.array(status, np.uint8),
        offsets=np.concatenate([[0], np.cumsum(lengths)]).astype(np.int64),
        matches=np.array([match for pair in pairs for match in edges[pair]], np.int32).reshape(-1, 2),
        num_putative=np.array(lengths, np.int32) + 5,
        is_planar=np.zeros(count, bool),
        quaternion=np.zeros((count, 4)), direction=np.zeros((count, 3)), residual_px=np.zeros(count),
        distinctiveness=np.zeros(count), angle_rad=np.zeros(count),
    )  # fmt: skip


def as_sets(tracks: Tracks) -> set[frozenset[tuple[int, int]]]:
    members: dict[int, set[tuple[int, int]]] = {}
    rows = zip(tracks.track_index.tolist(), tracks.image_index.tolist(), tracks.feature_index.tolist(), strict=True)
    for track, image, feature in rows:
        members.setdefault(track, set()).add((image, feature))
    return {frozenset(member) for member in members.values()}


matches = st.lists(st.tuples(st.integers(0, 5), st.integers(0, 5)), max_size=5, unique=True)
graphs = st.dictionaries(st.sampled_from([(i, j) for i in range(5) for j in range(i + 1, 5)]), matches, max_size=8)


def components_by_dictionary(edges) -> set[frozenset[tuple[int, int]]]:
    group: dict[tuple[int, int], frozenset[tuple[int, int]]] = {}
    for (i, j), both in edges.items():
        for a, b in both:
            merged = group.get((i, a), frozenset([(i, a)])) | group.get((j, b), frozenset([(j, b)]))
            for node in merged:
                group[node] = merged
    return set(group.values())


@given(graphs)
@settings(max_examples=150, deadline=None)
def test_tracks_are_the_components_and_parts_of_those_that_show_an_image_twice(edges):
    tracks = build_tracks(make_graph(edges), distinct_features(5, 6), 5)
    found, expected = as_sets(tracks), components_by_dictionary(edges)
    consistent = {group for group in expected if len({image for image, _ in group}) == len(group)}
    assert consistent <= found
    for track in found - consistent:
        assert len({image for image, _ in track}) == len(track) >= 2
        assert any(track < group for group in expected - consistent)
    # no two parts of a component that a match joins could still be one track, and what is left out is counted
    part = {node: track for track in found for node in track}
    for (i, j), both in edges.items():
        for a, b in both:
            one, two = (part.get(node, frozenset([node])) for node in ((i, a), (j, b)))
            assert one == two or {image for image, _ in one} & {image for image, _ in two}
    assert tracks.num_conflicts == len(frozenset().union(*expected) if expected else ()) - len(part)


@given(graphs)
@settings(max_examples=50, deadline=None)
def test_rows_are_sorted_and_tracks_numbered_by_their_first_observation(edges):
    tracks = build_tracks(make_graph(edges), distinct_features(5, 6), 5)
    rows = np.stack([tracks.track_index, tracks.image_index, tracks.feature_index], axis=1).tolist()
    assert rows == sorted(rows)
    first = [rows[k][1:] for k in range(len(rows)) if k == 0 or rows[k][0] != rows[k - 1][0]]
    assert first == sorted(first)
    assert tracks.num_tracks == len(first)
    np.testing.assert_array_equal(tracks.xy_px, np.stack([tracks.feature_index, tracks.image_index], axis=1))
    assert sorted(image for group in tracks.components for image in group) == list(range(5))


def test_a_weak_match_gives_way_to_the_strong_ones_that_it_contradicts():
    strong = [(0, 0), (1, 1), (2, 2)]
    edges = {(0, 1): strong, (1, 2): strong, (0, 3): strong, (2, 3): [(0, 1)]}
    tracks = build_tracks(make_graph(edges, weak=[(2, 3)]), distinct_features(4, 3), 4)
    assert as_sets(tracks) == {frozenset((image, k) for image in range(4)) for k in range(3)}
    assert tracks.num_conflicts == 0
    assert tracks.components == ((0, 1, 2, 3),)


def test_matches_that_close_triangles_come_before_those_that_do_not():
    edges = {(0, 1): [(0, 0)], (0, 2): [(0, 0)], (1, 2): [(0, 0)], (2, 3): [(0, 0), (5, 5), (4, 4)], (1, 3): [(0, 1)]}
    tracks = build_tracks(make_graph(edges), distinct_features(4, 6), 4)
    assert frozenset([(0, 0), (1, 0), (2, 0), (3, 0)]) in as_sets(tracks)
    assert tracks.num_conflicts == 1


def test_features_at_one_position_are_one_feature_and_no_conflict():
    features = distinct_features(3, 3)
    features[1] = make_features([[7, 7], [4, 4], [7, 7]])
    tracks = build_tracks(make_graph({(0, 1): [(0, 2)], (1, 2): [(0, 1), (1, 0)]}), features, 3)
    assert as_sets(tracks) == {frozenset([(0, 0), (1, 0), (2, 1)]), frozenset([(1, 1), (2, 0)])}
    assert tracks.num_conflicts == 0


def test_a_track_has_the_mean_colour_of_its_observations():
    features = {0: make_features([[1, 1]], [[10, 0, 255]]), 1: make_features([[2, 2]], [[21, 0, 255]])}
    tracks = build_tracks(make_graph({(0, 1): [(0, 0)]}), features, 2)
    assert tracks.rgb.tolist() == [[16, 0, 255]]  # 15.5 is rounded to even


def test_an_edge_whose_matches_gave_way_joins_no_images():
    true = [(k, k) for k in range(20)]
    edges = {(0, 1): true, (0, 2): true, (1, 2): true, (3, 4): true, (2, 3): [(0, k) for k in range(12)]}
    tracks = build_tracks(make_graph(edges), distinct_features(5, 20), 5)
    assert tracks.components == ((0, 1, 2), (3, 4))
    edges[2, 3] = [(k, k) for k in range(12)]
    assert build_tracks(make_graph(edges), distinct_features(5, 20), 5).components == ((0, 1, 2, 3, 4),)


def test_no_matches_make_no_tracks():
    tracks = build_tracks(ViewGraph.empty(), {}, 3)
    assert tracks.num_tracks == tracks.num_observations == 0
    assert tracks.components == ((0,), (1,), (2,))


@pytest.fixture(scope="module")
def simulated() -> tuple[ViewGraph, dict[int, Features], list[np.ndarray]]:
    """Twenty images that each see runs of points, with one match in fifty wrong; and the point of each feature."""
    rng = np.random.default_rng(0)
    first = rng.integers(-6, 20, size=4000)
    points = [rng.permutation(np.flatnonzero((first <= i) & (first > i - 7) & (rng.random(4000) < 0.7)))
              for i in range(20)]  # fmt: skip
    edges = {}
    for i in range(20):
        for j in range(i + 1, min(20, i + 7)):
            _, a, b = np.intersect1d(points[i], points[j], return_indices=True)
            is_wrong = rng.random(len(a)) < 0.02
            b = np.where(is_wrong, rng.integers(0, len(points[j]), len(a)), b)
            edges[i, j] = list(zip(a.tolist(), b.tolist(), strict=True))
    features = {i: make_features(rng.uniform(0, 999, size=(len(points[i]), 2))) for i in range(20)}
    return make_graph(edges), features, points


def test_few_tracks_mix_points_though_wrong_matches_join_a_tenth_of_them(simulated):
    graph, features, points = simulated
    tracks = build_tracks(graph, features, 20)
    seen = [points[i][f] for i, f in zip(tracks.image_index.tolist(), tracks.feature_index.tolist(), strict=True)]
    pure = [len(set(part.tolist())) == 1 for part in
            np.split(np.array(seen), np.flatnonzero(np.diff(tracks.track_index)) + 1)]  # fmt: skip
    observable = np.bincount(np.concatenate(points), minlength=4000)
    assert np.mean(pure) > 0.98
    assert np.sum(pure) > 0.95 * np.sum(observable >= 2)
    assert 0 < tracks.num_conflicts < 0.01 * tracks.num_observations


def test_the_same_matches_give_the_same_bytes(simulated):
    graph, features, _ = simulated
    one, two = (build_tracks(graph, features, 20) for _ in range(2))
    for name in ("track_index", "image_index", "feature_index", "xy_px", "rgb"):
        assert getattr(one, name).tobytes() == getattr(two, name).tobytes()
