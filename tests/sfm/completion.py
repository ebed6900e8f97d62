"""Features and reduced tracks of simulated surveys, for tests that complete tracks."""

from dataclasses import replace

import numpy as np

from jaxba.scene import Features, Tracks
from jaxba.simulation.staged import Simulated


def features_of(scene: Simulated, seed: int) -> dict[int, Features]:
    """Return features at all true observations, descriptors alike for one point, and as many false ones elsewhere."""
    rng = np.random.default_rng(seed)
    of_track = rng.integers(0, 120, (scene.tracks.num_tracks, 128))
    found = {}
    for image, photo in enumerate(scene.photos):
        rows = np.flatnonzero(scene.tracks.image_index == image)
        false = len(rows)
        size = np.array([photo.width_px, photo.height_px])
        noise = rng.integers(-12, 13, (len(rows), 128))
        true = of_track[scene.tracks.track_index[rows]] + noise
        descriptors = np.concatenate([true, rng.integers(0, 120, (false, 128))])
        found[image] = Features(
            detector="sift",
            xy_px=np.concatenate([scene.tracks.xy_px[rows], rng.uniform(0, 1, (false, 2)) * size]),
            size_px=np.ones(2 * false),
            angle_rad=np.zeros(2 * false),
            descriptors=np.clip(descriptors, 0, 255).astype(np.uint8),
            rgb=np.zeros((2 * false, 3), np.uint8),
            mean_brightness=100.0,
            coverage=1.0,
        )
    return found


def reduced(tracks: Tracks, keep: np.ndarray, track_index: np.ndarray) -> Tracks:
    kept, number = np.unique(track_index[keep], return_inverse=True)
    order = np.lexsort((tracks.image_index[keep], number))
    return replace(
        tracks,
        track_index=number[order],
        image_index=tracks.image_index[keep][order],
        feature_index=tracks.feature_index[keep][order],
        xy_px=tracks.xy_px[keep][order],
        rgb=np.zeros((len(kept), 3), np.uint8),
    )
