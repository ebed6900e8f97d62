"""Pairs that fail with ORB, since it left them too few features, on ground where SIFT finds hundreds."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from jaxba.engine._fingerprint import fingerprint
from jaxba.engine._key import Key
from jaxba.engine._store import save
from jaxba.pipeline import PIPELINE, _stages, match, metadata, retrieval, tracks
from jaxba.pipeline._fallback import WithFallback, detect_fallback
from jaxba.report import pair_lines
from jaxba.scene import Block, EdgeStatus, Fallback, Features, Missed, Photo, Reference, Tracks
from jaxba.sfm._complete import complete_tracks
from jaxba.vision import decode, detect_features

SHIFT_PX = np.array([120.0, 40.0])
FOCAL_PX = 500.0
COARSE_M = 25.0  # height at which a pixel is 5 cm


@pytest.fixture(scope="module")
def photos(tmp_path_factory: pytest.TempPathFactory) -> tuple[Photo, ...]:
    """Three photos, each shifted against the one before it by whole pixels."""
    folder = tmp_path_factory.mktemp("soft")
    noise = np.random.default_rng(0).normal(size=(700, 1000))
    soft = sum(s * cv2.GaussianBlur(noise, (0, 0), s) for s in (3.0, 6.0))
    ground = np.clip(110 + 25 * (soft - np.mean(soft)) / np.std(soft), 0, 255).astype(np.uint8)
    made = []
    for k in range(3):
        x, y = (k * SHIFT_PX).astype(int)
        path = folder / f"{k}.png"
        cv2.imwrite(str(path), ground[y : y + 450, x : x + 600])
        made.append(
            Photo(name=path.name, path=path, sha256=str(k), width_px=600, height_px=450, camera="a", focal_px=FOCAL_PX)
        )
    return tuple(made)


@pytest.fixture(scope="module")
def orb(photos: tuple[Photo, ...]) -> dict[int, Features]:
    """Five ORB features a photo: too few for an edge."""
    found = {i: detect_features(decode(photo.path), detector="orb") for i, photo in enumerate(photos)}
    names = ("xy_px", "size_px", "angle_rad", "descriptors", "rgb")
    return {i: replace(f, **{name: getattr(f, name)[:5] for name in names}) for i, f in found.items()}


def reference_of(num_images: int, height_m: float) -> Reference:
    unknown = np.full((num_images, 3), np.nan)
    return Reference(
        frame=None,
        xyz_m=unknown,
        std_m=unknown,
        quaternion=np.full((num_images, 4), np.nan),
        attitude_std_rad=unknown,
        is_used=np.zeros(num_images, bool),
        height_above_ground_m=np.full(num_images, height_m),
    )


def run(
    photos: tuple[Photo, ...], features: dict[int, Features], height_m: float, params: match.Params | None = None
) -> match.Outputs:
    inputs = match.Inputs(
        image=0,
        partners=np.arange(1, len(photos)),
        overlap=np.full(len(photos) - 1, 0.7),
        photos=photos,
        reference=reference_of(len(photos), height_m),
        features=features,
    )
    return match.run(inputs, params or match.Params())


@pytest.fixture(scope="module")
def outputs(photos: tuple[Photo, ...], orb: dict[int, Features]) -> match.Outputs:
    return run(photos, orb, COARSE_M)


def test_coarse_pair_that_fails_with_orb_is_matched_with_sift(outputs: match.Outputs, orb: dict[int, Features]) -> None:
    graph = outputs.view_graph
    assert graph.status.tolist() == [EdgeStatus.GOOD] * 2 and outputs.num_fallback == 2
    found = WithFallback(orb, outputs.fallback)
    for pair, (first, second) in enumerate(graph.pairs.tolist()):
        matches = graph.matches_of(pair)
        assert matches.min() >= 5  # behind the ORB features
        offset = found[first].xy_px[matches[:, 0]] - found[second].xy_px[matches[:, 1]]
        assert np.abs(offset - (second - first) * SHIFT_PX).max() < 4
        np.testing.assert_allclose(np.median(offset, axis=0), (second - first) * SHIFT_PX, atol=0.05)


@pytest.mark.parametrize("height_m", [10.0, np.nan])
def test_fine_or_unknown_ground_sample_distance_rejects_the_pair(
    photos: tuple[Photo, ...], orb: dict[int, Features], height_m: float
) -> None:
    outputs = run(photos[:2], orb, height_m)
    assert outputs.view_graph.status.tolist() == [EdgeStatus.REJECTED]
    assert outputs.fallback == () and outputs.num_fallback == 0
    assert outputs.record.fallback.tolist() == [Fallback.GSD_TOO_FINE if height_m == 10 else Fallback.GSD_UNKNOWN]
    lines = pair_lines(outputs.view_graph, outputs.record)
    why = (
        "1 pair too fine for SIFT, 2 cm/px (match.fallback_gsd)" if height_m == 10 else "1 pair without a known ground"
    )
    assert why in lines[-1] and "1 of these are rejected" in lines[-1]
    assert "No overlap, or none found (match.min_inliers): 1 pair with" in lines[-2]


def test_the_limit_is_a_parameter(photos: tuple[Photo, ...], orb: dict[int, Features]) -> None:
    assert run(photos[:2], orb, 10.0, match.Params(fallback_gsd=0.019)).num_fallback == 1
    assert run(photos[:2], orb, COARSE_M, match.Params(fallback_gsd=0.051)).num_fallback == 0


def test_a_weak_pair_falls_back_and_the_better_of_both_is_kept(photos: tuple[Photo, ...]) -> None:
    found = {i: detect_features(decode(p.path), detector="orb", nfeatures=150) for i, p in enumerate(photos[:2])}
    lenient, strict = match.Params(), match.Params(min_good=100)
    by_orb = run(photos[:2], found, np.nan, strict)
    assert by_orb.view_graph.status.tolist() == [EdgeStatus.WEAK]
    assert by_orb.record.missed.tolist() == [Missed.MIN_GOOD]
    assert run(photos[:2], found, COARSE_M, strict).record.fallback.tolist() == [Fallback.TAKEN]
    assert run(photos[:2], found, COARSE_M, lenient).record.fallback.tolist() == [Fallback.NONE]
    blank = photos[0].path.with_name("blank.png")
    cv2.imwrite(str(blank), np.zeros((450, 600), np.uint8))
    kept = run((photos[0], replace(photos[1], path=blank)), found, COARSE_M, strict)
    assert kept.record.fallback.tolist() == [Fallback.NOT_BETTER] and kept.fallback == ()
    assert np.array_equal(kept.view_graph.matches, by_orb.view_graph.matches)
    assert "1 pair no better with SIFT" in pair_lines(kept.view_graph, kept.record)[-1]


@pytest.mark.parametrize("changed", [{"fallback_contrast": 0.08}, {"fallback_edge": 5.0}])
def test_how_sift_looks_then_are_parameters(
    photos: tuple[Photo, ...], orb: dict[int, Features], outputs: match.Outputs, changed: dict[str, float]
) -> None:
    fewer = run(photos, orb, COARSE_M, match.Params(**changed))
    assert [len(a.xy_px) < len(b.xy_px) for a, b in zip(fewer.fallback, outputs.fallback, strict=True)] == [True] * 3


def test_the_most_keypoints_of_sift_are_a_parameter(photos: tuple[Photo, ...], tmp_path: Path) -> None:
    noise = cv2.GaussianBlur(np.random.default_rng(0).normal(size=(450, 600)), (0, 0), 1.2)
    cv2.imwrite(str(tmp_path / "rich.png"), np.clip(128 + 200 * noise, 0, 255).astype(np.uint8))
    rich = replace(photos[0], path=tmp_path / "rich.png")
    found = [detect_fallback(rich, nfeatures=count) for count in (2000, 12000)]
    assert [len(np.unique(f.xy_px, axis=0)) > 2000 for f in found] == [False, True]


def test_sift_features_have_no_fallback(photos: tuple[Photo, ...], orb: dict[int, Features]) -> None:
    few = {i: replace(f, detector="sift", descriptors=np.zeros((5, 128), np.uint8)) for i, f in orb.items()}
    outputs = run(photos[:2], few, COARSE_M)
    assert outputs.view_graph.status.tolist() == [EdgeStatus.REJECTED] and outputs.fallback == ()


def test_tracks_have_the_pixels_of_the_sift_keypoints(
    photos: tuple[Photo, ...], orb: dict[int, Features], outputs: match.Outputs
) -> None:
    found = WithFallback(orb, outputs.fallback)
    made = tracks.run(
        tracks.Inputs(photos=photos, features=found, view_graph=outputs.view_graph), tracks.Params()
    ).tracks
    assert made.components == ((0, 1, 2),) and made.num_tracks > 100
    on_ground = made.xy_px + made.image_index[:, None] * SHIFT_PX
    start = on_ground[np.searchsorted(made.track_index, made.track_index)]
    assert np.abs(on_ground - start).max() < 4
    sift = detect_fallback(photos[1])
    rows = made.image_index == 1
    assert np.array_equal(made.xy_px[rows], sift.xy_px[made.feature_index[rows] - 5])


def test_items_of_photos_are_merged_by_image_of_the_survey(
    photos: tuple[Photo, ...], orb: dict[int, Features], tmp_path: Path
) -> None:
    done = _stages.Done(files=(), settings=PIPELINE.settings)
    done.metadata = metadata.Outputs(photos=photos, left_out=())
    done.features = orb
    done.retrieval = retrieval.Outputs(
        pairs=np.array([[0, 1], [1, 2]], np.int32), overlap=np.full(2, 0.7), num_added=0, num_photos=0
    )
    for image in (0, 1):
        own = {row: orb[image + row] for row in (0, 1)}
        save(tmp_path / str(image), run(photos[image : image + 2], own, COARSE_M), Key("", {}, {}))
    merged = _stages._match_collected(done, {i: tmp_path / str(i) for i in (0, 1)}, {0: "a", 1: "b"})
    assert [entry.image for entry in merged.fallback] == [0, 1, 2] and merged.num_fallback == 2
    for entry, photo in zip(merged.fallback, photos, strict=True):
        assert np.array_equal(entry.xy_px, detect_fallback(photo).xy_px)
    done.match = merged
    features = _stages._tracks(done).features
    assert isinstance(features, WithFallback) and features[2].num_keypoints == 5 + len(merged.fallback[2].xy_px)
    assert fingerprint(features) == fingerprint(WithFallback(orb, merged.fallback))
    assert fingerprint(features) != fingerprint(WithFallback(orb, merged.fallback[:2]))
    done.match = replace(merged, fallback=())
    assert _stages._tracks(done).features is orb


def test_points_of_sift_keypoints_are_left_alone_where_tracks_are_completed(
    photos: tuple[Photo, ...], orb: dict[int, Features]
) -> None:
    """80 points in three images: the third image's ORB features of 60 are found, of 20 SIFT points none."""
    rng = np.random.default_rng(1)
    points_m = np.column_stack([rng.uniform(-2, 2, (80, 2)), np.full(80, 10.0)])
    step_m = np.array([1.0, 0, 0])
    pixels = np.stack([(points_m - k * step_m)[:, :2] / 10 * FOCAL_PX + [300, 225] for k in range(3)])
    bits = rng.integers(0, 256, (60, 32)).astype(np.uint8)
    features = {
        k: replace(
            orb[0], xy_px=pixels[k, :60], size_px=np.ones(60), angle_rad=np.zeros(60), descriptors=bits,
            rgb=np.zeros((60, 3), np.uint8),
        )
        for k in range(3)
    }  # fmt: skip
    index, image = np.repeat(np.arange(80), 2), np.tile([0, 1], 80)
    made = Tracks(
        track_index=index, image_index=image, feature_index=index, xy_px=pixels[image, index],
        rgb=np.zeros((80, 3), np.uint8), components=((0, 1, 2),),
    )  # fmt: skip
    model = "PINHOLE"
    parameters = np.array([[FOCAL_PX, FOCAL_PX, 300, 225]])
    block = Block(
        image_index=np.arange(3), quaternion=np.tile([1.0, 0, 0, 0], (3, 1)),
        translation_m=-np.arange(3)[:, None] * step_m, camera_model=model, camera_names=("a",),
        camera_parameters=parameters, camera_index=np.zeros(3, int), points_m=points_m, track_index=np.arange(80),
        rgb=np.zeros((80, 3), np.uint8), observation_image=image, observation_point=index,
        observation_xy_px=pixels[image, index], is_georeferenced=False,
    )  # fmt: skip
    completed = complete_tracks(block, made, features, photos, radius_px=4.0)
    added = completed.image_index == 2
    visible = ((pixels[2, :60] >= 0) & (pixels[2, :60] <= [600, 450])).all(axis=1)
    assert completed.track_index[added].tolist() == np.flatnonzero(visible).tolist() and visible.sum() > 50
