"""What stops a run early, and which failures a further run tries again."""

import dataclasses
import json
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest
from small_survey import NUM_PHOTOS, Survey

from jaxba import JaxbaError
from jaxba.engine import Resources
from jaxba.engine._key import Key
from jaxba.engine._limits import check_failures
from jaxba.engine._store import read_record
from jaxba.engine._work import run_one
from jaxba.pipeline import Event, features
from jaxba.pipeline.features import check_store
from jaxba.scene import LeftOut, Photo
from jaxba.vision import store_bytes


@pytest.fixture
def cut(photos: Path, tmp_path: Path) -> Survey:
    """Four photos of which three are cut short."""
    (tmp_path / "photos").mkdir()
    for number in range(1, 5):
        path = tmp_path / "photos" / f"SIM_{number:04d}.JPG"
        shutil.copy(photos / path.name, path)
        if number > 1:
            path.write_bytes(path.read_bytes()[:-20000])
    return Survey(tmp_path / "photos", tmp_path / "project")


def test_too_many_photos_that_fail_stop_the_run_with_the_reasons_and_the_rest_is_kept(cut: Survey):
    message = (
        "stage features: 3 of 4 photos failed, and --max-failed 0.5 allows 2: SIM_000[2-4].JPG.*: cannot be decoded "
        ".*What is done is kept; see to these photos and run again, or raise --max-failed"
    )
    with pytest.raises(JaxbaError, match=message):
        cut.run(until="features", workers=1)
    records = list((cut.project / "stages" / "features").glob("*/record.json"))
    assert (
        len(records) == 4 and json.loads((cut.project / "summary.json").read_text())["stopped"]["stage"] == "features"
    )
    events: list[Event] = []
    with pytest.raises(JaxbaError, match="3 of 4 photos failed"):  # as soon as it is clear, with nothing done again
        cut.run(until="features", tell=events.append)
    assert [event.kind for event in events if event.stage == "features"] == ["begin"]
    assert len(cut.run("workers.max_failed=3", until="features").done.features) == 1


def test_reasons_are_said_once_with_their_photos_the_commonest_first():
    reasons = {"a": "odd.", **dict.fromkeys("bcde", "cut"), "f": "x", "g": "y"}
    failed = [LeftOut(name=name, reason=reason) for name, reason in reasons.items()]
    with pytest.raises(JaxbaError) as error:
        check_failures("match", failed, 10, Resources(max_failed=0.6))
    assert (
        "7 of 10 photos failed, and --max-failed 0.6 allows 6: b, c, d and 1 more: cut; a: odd; f: x; and 1 other"
        in (str(error.value))
    )
    check_failures("match", failed, 10, Resources(max_failed=0.7))


@pytest.fixture
def photo(photos: Path, tmp_path: Path) -> Photo:
    return Survey(photos, tmp_path / "project").run(until="metadata").done.photos[0]


@pytest.mark.parametrize(
    ("spoil", "is_final", "words"),
    [
        (lambda path: path.write_bytes(path.read_bytes()[:-20000]), True, "cannot be decoded"),
        (lambda path: path.unlink(), False, "does not exist"),
        (lambda path: (path.unlink(), path.mkdir()), False, "cannot be decoded"),  # as a disk that does not answer
    ],
)
def test_a_bad_photo_is_not_tried_again_and_a_photo_that_could_not_be_read_is(
    photo: Photo, tmp_path: Path, spoil: Callable[[Path], object], is_final: bool, words: str
):
    path = tmp_path / photo.name
    shutil.copy(photo.path, path)
    spoil(path)
    params = features.Params(nfeatures=2000)
    inputs = features.Inputs(photo=dataclasses.replace(photo, path=path))
    reason = run_one(features.__name__, tmp_path / "out", inputs, params, Key.of(features.__name__, params, {}))
    record = read_record(tmp_path / "out")
    assert reason is not None and words in reason
    assert (record is not None and record.failed == reason) if is_final else record is None


def test_the_features_of_a_survey_take_no_more_than_was_estimated(made: Survey):
    files = (made.project / "stages" / "features").rglob("*")
    taken = sum(path.stat().st_size for path in files if path.is_file())
    estimated = store_bytes(NUM_PHOTOS, "sift", 2000)
    assert 0.6 * estimated < taken <= estimated


def test_features_that_do_not_fit_are_refused_with_the_figures_and_the_cures(tmp_path: Path):
    message = (
        r"the features of 10,000 photos take up to 17.0 GB on the disk, at 8,000 keypoints a photo; --max-store 1GB "
        r"allows 1.0 GB, .* are free. Set fewer features.nfeatures, take fewer photos, raise --max-store, or choose"
    )
    store = tmp_path / "stages" / "features"
    with pytest.raises(JaxbaError, match=message):
        check_store(store, 10_000, "sift", features.Params(), Resources(max_store="1GB"))
    check_store(store, 500, "sift", features.Params(), Resources(max_store="1GB"))
    check_store(store, 10_000, "orb", features.Params(nfeatures=2000), Resources(max_store="2GB"))


def test_what_is_stored_already_counts_as_free(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(shutil, "disk_usage", lambda path: type("Usage", (), {"free": 1_000_000}))
    params = features.Params(nfeatures=2000)
    with pytest.raises(JaxbaError, match=r"up to 4\.\d MB .* --max-store 0.9 allows 900.0 kB, 1.0 MB are free"):
        check_store(tmp_path, 10, "sift", params, Resources())
    with pytest.raises(JaxbaError, match=r"--max-store 1GB allows 1.0 MB, 1.0 MB are free"):
        check_store(tmp_path, 10, "sift", params, Resources(max_store="1GB"))
    (tmp_path / "SIM_0001.JPG").mkdir()
    (tmp_path / "SIM_0001.JPG" / "features.descriptors.npy").write_bytes(bytes(4_000_000))
    check_store(tmp_path, 10, "sift", params, Resources())


def test_a_run_without_room_for_its_features_stops_before_the_first(photos: Path, tmp_path: Path):
    survey = Survey(photos, tmp_path / "project")
    with pytest.raises(JaxbaError, match=r"the features of 8 photos take up to 3\.4 MB"):
        survey.run("workers.max_store=1MB")
    assert not (survey.project / "stages" / "features").exists()
