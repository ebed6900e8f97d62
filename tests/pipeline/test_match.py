from collections.abc import Sequence
from dataclasses import fields, replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jaxba.pipeline import match
from jaxba.report import Told, pair_facts, pair_lines
from jaxba.scene import EdgeStatus, Fallback, Features, Missed, Model, Photo, Reference, ViewGraph
from jaxba.vision import PairMatches, Pixels, TwoView, _pair, decode, detect_features

FOCAL_PX = 936.0


def photo_of(name: str, **kept: float | None) -> Photo:
    photo = Photo(name=name, path=Path(name), sha256="", width_px=1600, height_px=900, camera="a", focal_px=FOCAL_PX)
    return replace(photo, **kept)  # pyright: ignore[reportArgumentType]


def reference_of(num_images: int) -> Reference:
    nothing = np.full((num_images, 3), np.nan)
    return Reference(
        frame=None,
        xyz_m=nothing,
        std_m=nothing,
        quaternion=np.full((num_images, 4), np.nan),
        attitude_std_rad=nothing,
        is_used=np.zeros(num_images, bool),
        height_above_ground_m=nothing[:, 0],
    )


def inputs_of(features: Sequence[Features], reference: Reference | None = None, **photo: float | None) -> match.Inputs:
    """Return the first image with all others as partners."""
    return match.Inputs(
        image=0,
        partners=np.arange(1, len(features)),
        overlap=np.full(len(features) - 1, np.nan),
        photos=tuple(photo_of(f"{i}.jpg", **photo) for i in range(len(features))),
        reference=reference or reference_of(len(features)),
        features=dict(enumerate(features)),
    )


def detect(gray: np.ndarray, nfeatures: int = 2000, detector: str = "sift") -> Features:
    rgb = np.repeat(gray[:, :, None], 3, axis=2)
    return detect_features(Pixels(gray=gray, rgb=rgb), nfeatures=nfeatures, detector=detector)


def warped(gray: np.ndarray, homography: np.ndarray) -> np.ndarray:
    """Return an image of the same size, `homography` mapping pixels whose first has its centre at (0.5, 0.5)."""
    half = np.array([[1.0, 0, -0.5], [0, 1, -0.5], [0, 0, 1]])
    size = (gray.shape[1], gray.shape[0])
    return cv2.warpPerspective(gray, half @ homography @ np.linalg.inv(half), size, flags=cv2.INTER_CUBIC)


@pytest.fixture(scope="session")
def frames(data_dir: Path) -> list[Features]:
    """Three photos in sequence and one of another place."""
    brighton = sorted((data_dir / "images" / "brighton").glob("*.JPG"))
    other = sorted((data_dir / "images" / "copr").glob("*.[jJ][pP][gG]"))[0]
    return [detect_features(decode(path), nfeatures=3000) for path in [*brighton[6:9], other]]


@pytest.fixture(scope="session")
def gray(data_dir: Path) -> np.ndarray:
    return decode(sorted((data_dir / "images" / "brighton").glob("*.JPG"))[4]).gray


def test_neighbours_are_good_and_a_stranger_is_rejected(frames: list[Features]) -> None:
    graph = match.run(inputs_of(frames), match.Params()).view_graph
    assert graph.pairs.tolist() == [[0, 1], [0, 2], [0, 3]]
    assert graph.status[0] == EdgeStatus.GOOD and graph.status[2] == EdgeStatus.REJECTED
    assert graph.num_inliers[0] >= 100 and graph.num_inliers[2] == 0
    assert graph.inlier_ratio[0] > 0.7 and graph.residual_px[0] < 1.5
    assert np.isnan([graph.residual_px[2], graph.distinctiveness[2], graph.angle_rad[2]]).all()
    assert np.isnan(graph.quaternion[2]).all() and np.linalg.norm(graph.direction[0]) == pytest.approx(1)
    assert 0.25 < graph.distinctiveness[0] < 1 and 0.02 < graph.angle_rad[0] < 1
    assert graph.coverage is not None and graph.coverage[0] > 0.2 and graph.coverage[2] == 0
    for k in range(3):
        matches = graph.matches_of(k)
        assert all(len(np.unique(side)) == len(side) for side in matches.T)  # a feature is matched once
        for side, image in enumerate(graph.pairs[k]):
            at = frames[image].xy_px[matches[:, side]]
            assert len(np.unique(at, axis=0)) == len(at)  # and so is a position


@pytest.mark.parametrize("detector", ["sift", "orb"])
def test_matches_follow_the_homography_by_which_the_image_was_warped(gray: np.ndarray, detector: str) -> None:
    turn, scale = 0.4, 0.9
    cosine, sine = scale * np.cos(turn), scale * np.sin(turn)
    homography = np.array([[cosine, -sine, 300.0], [sine, cosine, -150.0], [2e-5, -1e-5, 1]])
    first, second = detect(gray, detector=detector), detect(warped(gray, homography), detector=detector)
    graph = match.run(inputs_of([first, second]), match.Params()).view_graph
    matches = graph.matches_of(0)
    moved = cv2.perspectiveTransform(first.xy_px[matches[:, 0]][None], homography)[0]
    offset = second.xy_px[matches[:, 1]] - moved
    assert graph.status[0] == EdgeStatus.GOOD and bool(graph.is_planar[0])
    assert np.quantile(np.linalg.norm(offset, axis=1), 0.95) < 3
    assert np.abs(np.median(offset, axis=0)).max() < 0.05  # no half pixel is lost on the way


def test_same_inputs_give_the_same_bytes(frames: list[Features]) -> None:
    one, two = (match.run(inputs_of(frames[:2]), match.Params()).view_graph for _ in range(2))
    for field in fields(ViewGraph):
        assert np.array_equal(getattr(one, field.name), getattr(two, field.name), equal_nan=True)


def test_frame_without_texture_rejects_its_pairs(frames: list[Features]) -> None:
    black = detect(np.zeros((900, 1600), np.uint8))
    for pair in ([frames[0], black], [black, frames[0]], [black, black]):
        graph = match.run(inputs_of(pair), match.Params()).view_graph
        assert graph.status.tolist() == [EdgeStatus.REJECTED] and graph.num_putative.tolist() == [0]


def test_a_pair_whose_common_ground_fails_is_matched_without_it_and_named(
    frames: list[Features], monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*arguments: object) -> None:
        raise np.linalg.LinAlgError("Singular matrix")

    inputs = inputs_of(frames[:3])
    monkeypatch.setattr(_pair, "_AGREED", 3000)  # by the largest features alone
    plain = match.run(inputs, match.Params())
    monkeypatch.setattr(_pair, "common_ground", fail)
    found = match.run(inputs, match.Params())
    assert np.array_equal(found.view_graph.status, plain.view_graph.status)
    assert plain.notes == () and len(found.notes) == len(found.view_graph.pairs)
    assert "common ground could not be measured" in found.notes[0].reason
    (line,) = [line for line in match.lines(found, Told()) if "common ground" in line]
    assert "LinAlgError: Singular matrix" in line


def test_few_inliers_make_a_weak_edge_and_fewer_none(frames: list[Features]) -> None:
    count = int(match.run(inputs_of(frames[:2]), match.Params()).view_graph.num_inliers[0])
    twenty = match.run(inputs_of(frames[:2]), match.Params()).view_graph.matches_of(0)[:: count // 20][:20]
    few = [
        replace(
            f, **{n: getattr(f, n)[twenty[:, side]] for n in ("xy_px", "size_px", "angle_rad", "descriptors", "rgb")}
        )
        for side, f in enumerate(frames[:2])
    ]
    weak = match.run(inputs_of(few), match.Params()).view_graph
    assert weak.status[0] == EdgeStatus.WEAK and 12 <= weak.num_inliers[0] < 30
    none = match.run(inputs_of(few), match.Params(min_inliers=25)).view_graph
    assert none.status[0] == EdgeStatus.REJECTED and none.num_inliers[0] == 0
    assert 12 <= none.num_putative[0] <= weak.num_putative[0] <= 20


def test_unknown_focal_length_gives_matches_without_a_pose(frames: list[Features]) -> None:
    graph = match.run(inputs_of(frames[:2], focal_px=None), match.Params()).view_graph
    assert graph.status[0] == EdgeStatus.GOOD
    assert np.isnan(graph.quaternion[0]).all() and np.isnan(graph.direction[0]).all()


def test_threshold_follows_overlap_and_resolution() -> None:
    small, medium, large = (
        photo_of("a"),
        photo_of("b", width_px=4864, height_px=3648),
        photo_of("c", width_px=8192, height_px=5460),
    )
    assert match._threshold_px(small, small, 0.9) == 2
    assert match._threshold_px(medium, medium, 0.8) == 3
    assert match._threshold_px(medium, medium, np.nan) == 3
    assert match._threshold_px(large, medium, 0.8) == 4
    video = photo_of("d", width_px=3840, height_px=2160)  # 8 MP
    assert match._threshold_px(video, video, 0.8) == 4 and match._threshold_px(video, video, 0.9) == 2
    twelve = photo_of("e", width_px=4000, height_px=3000)
    assert match._threshold_px(twelve, small, 0.8) == 3


def test_what_was_decided_on_each_pair_is_kept_with_its_figures(frames: list[Features]) -> None:
    inputs = replace(inputs_of(frames), overlap=np.array([0.9, 0.5, np.nan]))
    outputs = match.run(inputs, match.Params())
    record, graph = outputs.record, outputs.view_graph
    assert record.threshold_px.tolist() == [2, 3, 3]
    plane = [Model.HOMOGRAPHY if planar else Model.ESSENTIAL for planar in graph.is_planar[:2]]
    assert record.model.tolist() == [*plane, Model.NONE]
    assert record.num_verified[:2].tolist() == graph.num_inliers[:2].tolist() and record.num_verified[2] < 12
    assert record.missed[0] == Missed.NOTHING and record.missed[2] in (Missed.MATCHES, Missed.VERIFIED)
    assert record.fallback.tolist() == [Fallback.NONE] * 3
    lines = pair_lines(graph, record)
    assert lines[0] == "RANSAC threshold 3 px on 2 pairs, 2 px on 1 pair."
    assert any(line.startswith("No overlap, or none found (match.min_inliers): 1 pair with") for line in lines)
    assert pair_facts(graph, record)["thresholds_px"] == {"2": 1, "3": 2}
    unknown = match.run(inputs_of(frames[:2], focal_px=None), match.Params()).record
    assert unknown.model.tolist()[0] in (Model.FUNDAMENTAL, Model.HOMOGRAPHY)


def test_weak_pairs_are_counted_by_the_figure_that_they_miss(frames: list[Features]) -> None:
    outputs = match.run(inputs_of(frames), match.Params())
    graph = replace(outputs.view_graph, num_putative=np.array([80, 400, 9], np.int32))
    record = replace(
        outputs.record,
        missed=np.array([Missed.MIN_GOOD, Missed.MIN_INLIER_RATIO, Missed.MATCHES], np.uint8),
        num_verified=np.array([29, 100, 0], np.int32),
    )
    assert pair_lines(graph, record)[-2:] == [
        "No overlap, or none found (match.min_inliers): 1 pair with 9 matches before verification.",
        "Weak: 1 pair with 29 verified matches (match.min_good), 1 pair with 25% of the matches verified "
        "(match.min_inlier_ratio).",
    ]
    assert pair_facts(graph, record)["missed"] == {"matches": 1, "min_good": 1, "min_inlier_ratio": 1}


@pytest.mark.parametrize(
    ("num_matches", "num_inliers", "missed"),
    [
        (11, 0, Missed.MATCHES), (12, 11, Missed.VERIFIED), (400, 12, Missed.MIN_GOOD), (30, 29, Missed.MIN_GOOD),
        (100, 34, Missed.MIN_INLIER_RATIO), (100, 35, Missed.NOTHING), (30, 30, Missed.NOTHING),
    ],
)  # fmt: skip
def test_the_first_figure_that_is_missed_is_named(num_matches: int, num_inliers: int, missed: Missed) -> None:
    two_view = TwoView(
        is_inlier=np.arange(num_matches) < num_inliers, is_planar=False, model="essential", num_explained=num_inliers,
        rotation=np.eye(3), direction=np.array([1.0, 0, 0]), fundamental=np.eye(3), residual_px=1.0, angle_rad=0.1,
    )  # fmt: skip
    found = PairMatches(
        matches=np.zeros((num_matches, 2), int), distinctiveness=np.ones(num_matches), two_view=two_view,
        num_putative=num_matches,
    )  # fmt: skip
    assert match._missed(found, match.Params()) == missed


def test_epipolar_threshold_is_that_of_matches_off_the_plane(frames: list[Features]) -> None:
    counts = {}
    for threshold in (None, 3.0, 0.5):
        run = match.run(inputs_of(frames[:2]), match.Params(epipolar_threshold=threshold))
        counts[threshold] = int(run.view_graph.num_inliers[0])
        assert run.record.threshold_px.tolist() == [3]
    assert counts[None] == counts[3.0] > counts[0.5]


def test_prior_is_the_relative_pose_of_the_reference() -> None:
    rng = np.random.default_rng(0)
    attitudes = Rotation.from_rotvec(rng.normal(size=(2, 3)))
    reference = replace(
        reference_of(2),
        quaternion=attitudes.as_quat(scalar_first=True),
        attitude_std_rad=np.full((2, 3), 0.02),
        xyz_m=np.array([[0.0, 0, 50], [30, 5, 52]]),
        std_m=np.full((2, 3), 0.5),
        is_used=np.ones(2, bool),
    )
    prior = match._prior(reference, 0, 1)
    assert prior is not None and prior.direction is not None
    points = rng.normal(size=(20, 3)) * 100
    in_first, in_second = (a.apply(points - c) for a, c in zip(attitudes, reference.xyz_m, strict=True))
    base = np.linalg.norm(reference.xyz_m[0] - reference.xyz_m[1])
    np.testing.assert_allclose(in_first @ prior.rotation.T + base * prior.direction, in_second, atol=1e-9)
    assert prior.rotation_std_rad == pytest.approx(0.02 * np.sqrt(2))
    assert 0.02 < prior.direction_std_rad < 0.1
    imprecise = match._prior(replace(reference, std_m=np.full((2, 3), 20.0)), 0, 1)
    unused = match._prior(replace(reference, is_used=np.array([True, False])), 0, 1)
    assert imprecise is not None and imprecise.direction is None
    assert unused is not None and unused.direction is None
    assert match._prior(reference_of(2), 0, 1) is None
    no_height = match._prior(replace(reference, std_m=np.array([[0.5, 0.5, np.inf]] * 2)), 0, 1)
    assert no_height is not None and no_height.direction is None


def test_view_graphs_of_photos_are_joined_and_selected_with_their_figures(frames: list[Features]) -> None:
    graph = match.run(inputs_of(frames), match.Params()).view_graph
    parts = [graph.select(np.arange(3) == k) for k in (2, 0, 1)]
    joined = ViewGraph.concatenate(parts)
    for field in fields(ViewGraph):
        assert np.array_equal(getattr(joined, field.name), getattr(graph, field.name), equal_nan=True)
    assert ViewGraph.concatenate([replace(graph, coverage=None)]).coverage is None
    assert replace(graph, coverage=None).select(graph.is_edge).coverage is None
