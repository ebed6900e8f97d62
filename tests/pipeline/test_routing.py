"""The detector of a block by ground sample distance and overlap, with the figures said."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jaxba.pipeline._routing import Routing, route
from jaxba.scene import Attitude, Photo, Reference, cam_from_enu

COUNT = 12


def block(gsd_m: float, overlap: float, **kept) -> Routing:
    """Route photos in a line, each with its neighbours, 60 m over the ground."""
    focal = 60.0 / gsd_m
    photo = Photo(name="a", path=Path("a"), sha256="", width_px=4000, height_px=3000, camera="a", focal_px=focal)
    pairs = np.array([(i, j) for i in range(COUNT) for j in range(i + 1, min(i + 3, COUNT))])
    shares = np.where(pairs[:, 1] - pairs[:, 0] == 1, overlap, overlap / 2)
    heights = kept.pop("height_m", np.full(COUNT, 60.0))
    pitch = kept.pop("pitch_deg", np.full(COUNT, -90.0))
    attitudes = [Attitude(yaw_deg=30.0 * k, pitch_deg=float(p), roll_deg=0.0) for k, p in enumerate(pitch)]
    turn = Rotation.from_matrix(np.stack([cam_from_enu(attitude) for attitude in attitudes]))
    reference = Reference(
        frame=None,
        xyz_m=np.zeros((COUNT, 3)),
        std_m=np.ones((COUNT, 3)),
        quaternion=turn.as_quat(scalar_first=True),
        attitude_std_rad=np.full((COUNT, 3), 0.03),
        is_used=np.ones(COUNT, bool),
        height_above_ground_m=heights,
    )
    photos = (replace(photo, **{"focal_px": kept.pop("focal_px", focal)}),) * COUNT
    return route(photos, reference, pairs, shares, **kept)


@pytest.mark.parametrize(
    ("gsd_m", "overlap", "detector", "reason"),
    [
        (0.02, 0.80, "orb", "2.0 cm/px (median of 12 photos), not over 5; largest overlap of a photo 80%"),
        (0.05, 0.70, "orb", "not over 5"),
        (0.051, 0.80, "sift", "ground sample distance 5.1 cm/px (median of 12 photos), over 5 (features.sift_gsd)"),
        (0.02, 0.69, "sift", "largest overlap of a photo 69% (median of 12), under 70% (features.sift_overlap)"),
        (0.02, np.nan, "sift", "overlap unknown"),
        (0.08, 0.50, "sift", "over 5 (features.sift_gsd); largest overlap"),
    ],
)
def test_orb_is_for_fine_photos_with_much_overlap(gsd_m: float, overlap: float, detector: str, reason: str) -> None:
    found = block(gsd_m, overlap)
    assert found.detector == detector and found.reasons[0].startswith(f"Detector {detector.upper()}: ")
    assert reason in found.reasons[0]
    assert found.gsd_m == pytest.approx(gsd_m)
    assert found.overlap == pytest.approx(overlap, nan_ok=True)


def test_what_is_unknown_makes_it_sift_and_is_named() -> None:
    no_height = block(0.02, 0.8, height_m=np.full(COUNT, np.nan))
    assert no_height.detector == "sift" and "unknown (no heights above ground)" in no_height.reasons[0]
    no_focal = block(0.02, 0.8, focal_px=None)
    assert no_focal.detector == "sift" and "unknown (no focal lengths)" in no_focal.reasons[0]
    assert np.isnan(no_focal.gsd_m) and no_focal.num_gsd == 0 and no_focal.num_overlap == COUNT


def test_photos_without_a_height_are_left_out_of_the_median() -> None:
    heights = np.full(COUNT, 60.0)
    heights[:5] = np.nan
    found = block(0.02, 0.8, height_m=heights)
    assert found.detector == "orb" and found.num_gsd == 7 and found.num_photos == COUNT


def test_limits_and_the_detector_itself_are_parameters() -> None:
    assert block(0.06, 0.8, sift_gsd_m=0.07).detector == "orb"
    assert block(0.02, 0.6, sift_overlap=0.5).detector == "orb"
    assert block(0.02, 0.8, sift_overlap=0.85).detector == "sift"
    chosen = block(0.02, 0.8, detector="sift")
    assert chosen.detector == "sift" and chosen.reasons[0] == "Detector SIFT: set by features.detector."


def test_heights_and_tilts_tell_of_varying_scale() -> None:
    level = block(0.02, 0.8)
    assert not level.is_height_varying and level.height_ratio == 1 and level.oblique_share == 0
    high = block(0.02, 0.8, height_m=np.linspace(50, 75, COUNT))
    assert high.is_height_varying and "differ by a factor of 1.4" in high.reasons[1]
    tilted = block(0.02, 0.8, pitch_deg=np.where(np.arange(COUNT) % 4 == 0, -60.0, -90.0))
    assert tilted.is_height_varying and "25% of the photos are tilted by over 20 degrees" in tilted.reasons[1]
    assert not block(0.02, 0.8, pitch_deg=np.full(COUNT, -75.0)).is_height_varying


def test_a_block_of_one_photo_is_routed() -> None:
    nothing = np.full((1, 3), np.nan)
    reference = Reference(
        frame=None, xyz_m=nothing, std_m=nothing, quaternion=np.full((1, 4), np.nan), attitude_std_rad=nothing,
        is_used=np.zeros(1, bool), height_above_ground_m=np.full(1, np.nan),
    )  # fmt: skip
    photo = Photo(name="a", path=Path("a"), sha256="", width_px=40, height_px=30, camera="a")
    found = route((photo,), reference, np.zeros((0, 2), int), np.zeros(0))
    assert found.detector == "sift" and np.isnan(found.height_ratio) and np.isnan(found.oblique_share)
