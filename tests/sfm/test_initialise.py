"""Start values of every image come near the truth, from wrong edges, wrong positions, no positions."""

import dataclasses

import numpy as np
import pytest
from surveys import Case, make_case

from jaxba._errors import JaxbaError
from jaxba.geometry import OpenCV, OpenCVFisheye
from jaxba.scene import Block
from jaxba.sfm import initialise

ANGLE = np.deg2rad(1.5)


def start(case: Case, **changes: object) -> Block:
    inputs = {
        "photos": case.photos,
        "reference": case.reference,
        "view_graph": case.view_graph,
        "tracks": case.tracks,
        "camera_model": "OPENCV",
        "min_angle_rad": ANGLE,
    }
    return initialise(**(inputs | changes))  # pyright: ignore[reportArgumentType]


def misfit_m(block: Block, case: Case) -> np.ndarray:
    """Distances of the centres from the true ones after the best similarity (Umeyama 1991)."""
    true = case.centers[block.image_index]
    a, b = block.centers_m - block.centers_m.mean(axis=0), true - true.mean(axis=0)
    u, s, vt = np.linalg.svd(b.T @ a)
    sign = np.array([1, 1, np.linalg.det(u @ vt)])
    scale = (s * sign).sum() / (a * a).sum()
    return np.linalg.norm(scale * a @ (u @ (sign[:, None] * vt)).T - b, axis=1)


# 1.5% of the height of 100 m: the principal point, 12 px off the centre and not solved for here, moves an image by
# 0.3 m and turns it by 0.003
LIMIT_M = 1.5
CENTRED = OpenCV(fx=3650.0, fy=3650.0, cx=2736.0, cy=1824.0, k1=-0.045, k2=0.015, p1=0.0, p2=0.0)


@pytest.mark.parametrize(
    "options",
    [
        {},
        {"wrong_edges": 0.2},
        {"wrong_edges": 0.2, "gnss_std_m": None},
        {"terrain_relief_m": 0.0, "gnss_std_m": None, "wrong_edges": 0.1},
        {"terrain_relief_m": 60.0, "gnss_std_m": None},
        {"focal_error": 0.2, "gnss_std_m": None},
        {"attitude_jitter_rad": 0.2, "gnss_std_m": None, "wrong_edges": 0.1},
        {"outlier_fraction": 0.1, "wrong_edges": 0.1},
    ],
    ids=["plain", "wrong edges", "no gnss", "flat", "hills", "wrong focal", "tilted", "wrong features"],
)
def test_every_image_is_registered_near_the_truth(options: dict[str, object]) -> None:
    case = make_case(16, seed=3, camera=CENTRED, **options)
    block = start(case)
    assert block.num_images == 16 and not block.unregistered
    assert misfit_m(block, case).max() < 0.5  # k2, not solved for here, bends the block by 0.3 m
    wrong = case.survey.truth.is_outlier.mean()
    assert block.num_observations > (0.97 - wrong) * case.tracks.num_observations
    assert block.is_georeferenced == (case.reference.frame is not None)


def test_wrong_positions_are_survived_and_named() -> None:
    case = make_case(20, seed=1, gnss_outlier_fraction=0.2, gnss_outlier_m=(12.0, 60.0))
    block = start(case)
    off = np.linalg.norm(block.centers_m - case.centers, axis=1)
    assert off.max() < 3  # sigma 1 m, 1 m, 2 m on 16 good positions
    note = next(note for note in block.notes if "contradict" in note)
    assert note.startswith("4 of 20 measured positions")
    worst = np.argmax(np.linalg.norm(case.reference.xyz_m - case.centers, axis=1))
    assert case.photos[worst].name in note


def test_a_strip_without_attitudes_hangs_level() -> None:
    case = make_case(15, seed=2, num_lines=1, wrong_edges=0.05)
    block = start(case)
    assert block.num_images == 15
    # the mean of 15 views that tilt by 0.03: 0.01 rad, at a height of 100 m; and GNSS's metre
    assert np.linalg.norm(block.centers_m - case.centers, axis=1).max() < 4


def test_without_positions_the_unit_is_the_flight_height_and_the_cameras_look_down() -> None:
    block = start(make_case(12, gnss_std_m=None))
    assert not block.is_georeferenced
    height = np.median(block.centers_m[:, 2]) - np.median(block.points_m[:, 2])
    assert height == pytest.approx(1, abs=0.3)
    assert any("a frame of its own" in note for note in block.notes)


def test_an_image_without_relative_poses_is_found_from_the_points() -> None:
    case = make_case(16, seed=4)
    quaternion, direction = case.view_graph.quaternion.copy(), case.view_graph.direction.copy()
    without = (case.view_graph.pairs == 5).any(axis=1)
    quaternion[without], direction[without] = np.nan, np.nan
    graph = dataclasses.replace(case.view_graph, quaternion=quaternion, direction=direction)
    block = start(case, view_graph=graph)
    assert 5 in block.image_index
    assert misfit_m(block, case).max() < LIMIT_M


def test_images_that_hang_on_one_pair_are_left_out_by_name_unless_positions_hold_them() -> None:
    case = make_case(20, seed=5, num_lines=1)
    # no track joins both halves through three images: only 9 and 10 share points
    seen = case.tracks
    first = np.zeros(seen.num_tracks, bool)
    first[seen.track_index[seen.image_index <= 9]] = True
    second = np.zeros(seen.num_tracks, bool)
    second[seen.track_index[seen.image_index >= 10]] = True
    across = (first & second)[seen.track_index]
    keep = ~across | (seen.image_index == 9) | (seen.image_index == 10)
    length = np.bincount(seen.track_index[keep], minlength=seen.num_tracks)
    keep &= length[seen.track_index] >= 2
    _, track = np.unique(seen.track_index[keep], return_inverse=True)
    tracks = dataclasses.replace(
        seen,
        track_index=track,
        image_index=seen.image_index[keep],
        feature_index=seen.feature_index[keep],
        xy_px=seen.xy_px[keep],
        rgb=seen.rgb[: track.max() + 1],
    )
    assert start(case, tracks=tracks).num_images == 20
    nothing = dataclasses.replace(
        case.reference, frame=None, is_used=np.zeros(20, bool), xyz_m=np.full((20, 3), np.nan)
    )
    block = start(case, tracks=tracks, reference=nothing)
    assert block.num_images == 10 and len(block.unregistered) == 10
    assert all("two images of the rest" in left.reason for left in block.unregistered)


def test_images_outside_the_largest_component_are_named() -> None:
    case = make_case(12, seed=6)
    outside = np.isin(case.tracks.image_index, [0, 1])
    tracks = dataclasses.replace(
        case.tracks,
        track_index=np.unique(case.tracks.track_index[~outside], return_inverse=True)[1],
        image_index=case.tracks.image_index[~outside],
        feature_index=case.tracks.feature_index[~outside],
        xy_px=case.tracks.xy_px[~outside],
        components=(tuple(range(2, 12)), (0, 1)),
    )
    block = start(case, tracks=tracks)
    assert block.image_index.tolist() == list(range(2, 12))
    assert [left.name for left in block.unregistered] == ["000.jpg", "001.jpg"]
    assert "in a group of 2 photos that no edge joins with the largest group of 10" in block.unregistered[0].reason


def test_cameras_are_grouped_and_a_missing_focal_length_is_guessed_and_noted() -> None:
    case = make_case(16, seed=7, num_cameras=2)
    photos = tuple(
        dataclasses.replace(photo, camera="ab"[k // 8], focal_px=None if k >= 8 else photo.focal_px)
        for k, photo in enumerate(case.photos)
    )
    block = start(case, photos=photos)
    assert block.camera_names == ("a", "b")
    assert block.camera_index.tolist() == [0] * 8 + [1] * 8
    assert any("Camera b: no focal length is known" in note for note in block.notes)
    assert misfit_m(block, case).max() < 3 * LIMIT_M  # 1.2 x the width is 80% too long, and pulled in by 20% at a sigma


def test_no_relative_pose_at_all_is_an_error_that_names_the_cure() -> None:
    case = make_case(8)
    graph = dataclasses.replace(case.view_graph, quaternion=np.full_like(case.view_graph.quaternion, np.nan))
    with pytest.raises(JaxbaError, match=r"none of the \d+ edges among 8 photos has a relative pose.*metadata.focal"):
        start(case, view_graph=graph)


def test_features_that_show_nothing_in_common_are_an_error_that_names_the_focal_length() -> None:
    case = make_case(8)
    scattered = np.random.default_rng(0).uniform(0, [5472, 3648], case.tracks.xy_px.shape)
    with pytest.raises(JaxbaError, match=r"start values failed: .*focal length.*camera c: .* px"):
        start(case, tracks=dataclasses.replace(case.tracks, xy_px=scattered))


def test_photos_without_edges_are_an_error_that_names_the_cure() -> None:
    case = make_case(8)
    tracks = dataclasses.replace(case.tracks, components=tuple((k,) for k in range(8)))
    with pytest.raises(JaxbaError, match="no two of the 8 photos are joined"):
        start(case, tracks=tracks)


def test_the_same_input_gives_the_same_bytes() -> None:
    case = make_case(10, wrong_edges=0.1)
    first, second = start(case), start(case)
    for name in ("quaternion", "translation_m", "points_m", "observation_xy_px", "camera_parameters"):
        assert getattr(first, name).tobytes() == getattr(second, name).tobytes()


@pytest.mark.parametrize("model", ["SIMPLE_RADIAL", "RADIAL"])
def test_every_camera_model_starts(model: str) -> None:
    case = make_case(10, seed=8)
    block = start(case, camera_model=model)
    assert block.num_images == 10
    assert misfit_m(block, case).max() < LIMIT_M


def test_a_fisheye_starts() -> None:
    camera = OpenCVFisheye(fx=2400.0, fy=2400.0, cx=2736.0, cy=1824.0, k1=-0.02, k2=0.0, k3=0.0, k4=0.0)
    case = make_case(10, seed=8, camera=camera, gnss_std_m=None, wrong_edges=0.1, num_check=0)
    block = start(case, camera_model="OPENCV_FISHEYE")
    assert block.num_images == 10
    # the model is the true one but for its last terms, which are zero
    assert misfit_m(block, case).max() < 0.1
    np.testing.assert_allclose(block.camera_parameters[0, [0, 4]], [2400, -0.02], rtol=0.02)
