"""Tracks of a simulated block of which observations were taken away, and which were cut in two, are made whole."""

from dataclasses import replace

import numpy as np
import pytest
from completion import features_of, reduced

from jaxba.scene import Tracks
from jaxba.sfm import with_points
from jaxba.sfm._complete import complete_tracks
from jaxba.simulation.staged import Simulated, simulate, true_block


@pytest.fixture(scope="module")
def scene() -> Simulated:
    return simulate(12, seed=4, pixel_std_px=0.3)


def observations(tracks: Tracks) -> dict[tuple[int, int], int]:
    seen = zip(tracks.image_index.tolist(), tracks.feature_index.tolist(), strict=True)
    return dict(zip(seen, tracks.track_index.tolist(), strict=True))


def partners(tracks: Tracks) -> set[tuple[tuple[int, int], tuple[int, int]]]:
    """Return every observation with the first one of its track."""
    first: dict[int, tuple[int, int]] = {}
    return {(first.setdefault(track, seen), seen) for seen, track in sorted(observations(tracks).items())}


def complete(scene: Simulated, tracks: Tracks) -> Tracks:
    block = with_points(true_block(scene), tracks, min_angle_rad=0.02, max_error_px=2.0)
    return complete_tracks(block, tracks, features_of(scene, 1), scene.photos, radius_px=4.0)


def test_observations_taken_away_are_found_again(scene: Simulated) -> None:
    index = scene.tracks.track_index
    kept = reduced(scene.tracks, np.arange(len(index)) - np.searchsorted(index, index) < 2, index)
    missing = scene.tracks.num_observations - kept.num_observations
    assert missing > 1000
    completed = complete(scene, kept)
    right, found = partners(scene.tracks), partners(completed)
    assert len(found - right) < 0.002 * missing
    assert len(right - found) < 0.15 * missing  # the limit on descriptors is the 90% quantile


def test_a_track_cut_in_two_is_joined(scene: Simulated) -> None:
    tracks = scene.tracks
    long = np.bincount(tracks.track_index) >= 4
    place = np.arange(tracks.num_observations) - np.searchsorted(tracks.track_index, tracks.track_index)
    second_half = long[tracks.track_index] & (place >= 2)
    cut = reduced(tracks, np.ones(len(place), bool), tracks.track_index + second_half * tracks.num_tracks)
    completed = complete(scene, cut)
    assert cut.num_tracks == tracks.num_tracks + long.sum()
    assert completed.num_tracks < tracks.num_tracks + 0.1 * long.sum()
    assert len(partners(completed) - partners(tracks)) < 0.1 * long.sum()


def test_no_track_has_two_features_of_an_image_and_no_feature_two_tracks(scene: Simulated) -> None:
    rng = np.random.default_rng(0)
    kept = reduced(scene.tracks, rng.random(scene.tracks.num_observations) < 0.7, scene.tracks.track_index)
    completed = complete(scene, kept)
    pairs = np.stack([completed.track_index, completed.image_index], axis=1)
    assert len(np.unique(pairs, axis=0)) == len(pairs)
    assert len(observations(completed)) == len(pairs)
    assert np.all(np.diff(completed.track_index) >= 0) and completed.track_index.max() + 1 == completed.num_tracks
    assert set(observations(kept)) <= set(observations(completed))


def test_too_few_points_to_know_how_near_descriptors_are_change_nothing(scene: Simulated) -> None:
    block = with_points(true_block(scene), scene.tracks, min_angle_rad=0.02, max_error_px=2.0)
    few = replace(block, track_index=block.track_index[:10], points_m=block.points_m[:10], rgb=block.rgb[:10])
    assert complete_tracks(few, scene.tracks, features_of(scene, 1), scene.photos, radius_px=4.0) is scene.tracks
