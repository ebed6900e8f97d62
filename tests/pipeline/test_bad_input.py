"""Folders as users have them: what cannot be used is named, the rest goes on, and what makes no sense is refused."""

import errno
import io
import json
import os
import shutil
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from small_survey import NUM_PHOTOS, Survey

from jaxba import JaxbaError
from jaxba.engine import _store as store, changed
from jaxba.pipeline import PIPELINE, Run

SAME_PLACE = ("crs.min_positions=1",)


def with_pixels(content: bytes, pixels: np.ndarray) -> bytes:
    """Return a JPEG with other pixels and the segments of its tags as they are."""
    changed = io.BytesIO()
    Image.fromarray(pixels).save(changed, "JPEG", quality=95)
    tables = b"\xff\xdb"
    return content[: content.index(tables)] + changed.getvalue()[changed.getvalue().index(tables) :]


def pixels_of(content: bytes) -> np.ndarray:
    with Image.open(io.BytesIO(content)) as image:
        return np.array(image)


def resized(content: bytes, width: int, height: int) -> bytes:
    return with_pixels(content, np.array(Image.fromarray(pixels_of(content)).resize((width, height))))


@pytest.fixture(scope="module")
def mixed(photos: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Survey, Run]:
    """A whole run on a folder with all kinds of files among six good photos of one camera and two of another."""
    place = tmp_path_factory.mktemp("mixed")
    folder = place / "photos"
    (folder / "Flug 1, späte Aufnahmen").mkdir(parents=True)
    good = [(photos / f"SIM_{number:04d}.JPG").read_bytes() for number in range(1, NUM_PHOTOS + 1)]
    (folder / "Flug 1, späte Aufnahmen" / "Bild 1 größer.JPG").write_bytes(good[0])
    for number, suffix in ((2, "JPG"), (3, "jpg"), (4, "JPEG"), (5, "jpeg"), (6, "Jpg")):
        (folder / f"photo {number}.{suffix}").write_bytes(good[number - 1])
    for number in (7, 8):
        (folder / f"small {number}.jpg").write_bytes(resized(good[number - 1], 480, 360))
    (folder / "copy.jpg").write_bytes(good[1])
    (folder / "cut.jpg").write_bytes(good[2][: len(good[2]) // 2])
    (folder / "black.jpg").write_bytes(with_pixels(good[3], np.zeros((480, 640, 3), np.uint8)))
    (folder / "text.jpg").write_text("no photo")
    (folder / "empty.jpg").touch()
    (folder / "raw.DNG").write_bytes(b"II*\0")
    (folder / "notes.txt").write_text("wind from the west")
    (folder / "flight.srt").touch()
    survey = Survey(folder, place / "project")
    return survey, survey.run()


def test_nothing_is_dropped_in_silence(mixed: tuple[Survey, Run]):
    survey, run = mixed
    files = {path.relative_to(survey.photos).as_posix() for path in survey.photos.rglob("*") if path.is_file()}
    facts = run.facts
    adjusted = {run.done.photos[i].name for i in run.done.adjust.block.image_index}
    left_out = [entry["name"] for entry in facts["left_out"]]
    assert len(left_out) == len(set(left_out)) and adjusted.isdisjoint(left_out)
    assert files - adjusted - set(left_out) == {"notes.txt", "flight.srt"}
    assert any("no photos are passed over, 2 files: 1 .srt, 1 .txt" in line for line in facts["stages"]["metadata"])
    assert json.loads((survey.project / "summary.json").read_text()) == facts


def test_each_bad_file_is_named_with_its_reason_and_the_rest_goes_on(mixed: tuple[Survey, Run]):
    _, run = mixed
    reasons = {entry["name"]: (entry["stage"], entry["reason"]) for entry in run.facts["left_out"]}
    expected = {
        "photo 2.JPG": ("metadata", "same file as copy.jpg"),
        "cut.jpg": ("features", "cannot be decoded (image file is truncated"), "black.jpg": ("features", "no texture"),
        "text.jpg": ("metadata", "is no image that can be read (8 bytes)"),
        "empty.jpg": ("metadata", "is no image that can be read (it is empty)"), "raw.DNG": ("metadata", "RAW"),
    }  # fmt: skip
    assert set(reasons) == set(expected)
    for name, (stage, words) in expected.items():
        assert reasons[name][0] == stage and words in reasons[name][1], (name, reasons[name])
        assert name not in reasons[name][1]
    assert len(run.done.adjust.block.image_index) == NUM_PHOTOS


def test_two_cameras_are_allowed_and_said(mixed: tuple[Survey, Run]):
    survey, run = mixed
    lines = run.facts["stages"]["metadata"]
    assert lines[0] == "10 photos, 2 cameras, 4 files left out"
    assert any("2 cameras, each with its own intrinsics" in line for line in lines)
    sizes = {photo.camera: (photo.width_px, photo.height_px) for photo in run.done.photos}
    assert set(sizes.values()) == {(640, 480), (480, 360)}
    assert survey.run().stages_run == ()


def test_photos_without_features_are_groups_of_their_own_by_name(mixed: tuple[Survey, Run]):
    _, run = mixed
    groups = run.facts["groups"]
    assert len(groups[0]) == NUM_PHOTOS and sorted(groups[1:]) == [["black.jpg"], ["cut.jpg"]]


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda place: place.mkdir(), "there is no photo: the folder holds 0 files; give one with JPEG or TIFF"),
        (
            lambda place: (place.mkdir(), (place / "a.txt").touch()),
            "there is no photo: the folder holds 1 file: 1 .txt",
        ),
        (lambda place: None, "there is no such folder; give the folder that holds the photos"),
        (lambda place: place.touch(), "is a file; give the folder that holds the photos"),
        (lambda place: (place.mkdir(), (place / "a.jpg").symlink_to("gone")), r"a\.jpg: cannot be read \(No such file"),
        (lambda place: (place.mkdir(), (place / "a\nb.jpg").touch()), "characters in its name .* rename it"),
        (lambda place: (place.mkdir(), (place / "a.jpg").touch()), r"none of the 1 photos can be used. a\.jpg: "),
    ],
)
def test_a_folder_without_photos_is_refused(tmp_path: Path, make, message: str):
    make(tmp_path / "photos")
    with pytest.raises(JaxbaError, match=message):
        Survey(tmp_path / "photos", tmp_path / "project").run(until="metadata")
    assert not (tmp_path / "project").exists()


@pytest.mark.parametrize(
    ("change", "gcp"),
    [
        ("crs.target_crs=EPSG:99999", None),
        ("crs.target_crs=EPSG:4326", None),
        ("crs.target_crs=EPSG:32715", None),
        ("crs.target_crs=UTM 15", None),
        ("crs.target_crs=EPSG:32615", "gone.txt"),
        ("crs.target_crs=EPSG:32615", "empty.txt"),
    ],
)
@pytest.mark.parametrize("there", ["nothing", "an empty folder", "a file beside it", "a project"])
def test_what_is_refused_leaves_no_new_project(photos: Path, tmp_path: Path, change: str, gcp: str | None, there: str):
    (tmp_path / "empty.txt").write_text("EPSG:32615\n")
    project = tmp_path / "surveys" / "project"
    if there == "an empty folder":
        project.mkdir(parents=True)
    if there == "a file beside it":
        project.parent.mkdir()
        (project.parent / "notes.txt").touch()
    if there == "a project":
        Survey(photos, project).run(until="metadata")
    before = sorted(path.relative_to(tmp_path) for path in (tmp_path / "surveys").rglob("*"))
    with pytest.raises(JaxbaError):
        Survey(photos, project).run(change, gcp=None if gcp is None else tmp_path / gcp, until="pairs")
    after = sorted(path.relative_to(tmp_path) for path in (tmp_path / "surveys").rglob("*"))
    if there == "a project":
        assert set(before) <= set(after)  # its records stay
    else:
        assert after == before and (tmp_path / "surveys").exists() == (there != "nothing")


@pytest.mark.parametrize("has_position", [True, False])
def test_one_photo_alone_is_refused_with_what_is_needed(photos: Path, tmp_path: Path, has_position: bool):
    (tmp_path / "photos").mkdir()
    with Image.open(photos / "SIM_0001.JPG") as image:
        if has_position:
            shutil.copy(photos / "SIM_0001.JPG", tmp_path / "photos")
        else:
            image.save(tmp_path / "photos" / "bare.jpg", quality=95)
    with pytest.raises(JaxbaError, match=r"only .*photo that can be used; give two or more that overlap"):
        Survey(tmp_path / "photos", tmp_path / "project").run(until="tracks")


@pytest.mark.parametrize(
    ("crs", "message"),
    [
        ("EPSG:4326", r"is geographic: .* EPSG:32615 \(WGS 84 / UTM zone 15N\) fits the survey"),
        ("EPSG:32633", "does not contain the survey: .* a wrong zone[?] EPSG:32615"),
        ("UTM 15", "'UTM 15' is no CRS that PROJ knows; give an EPSG code"),
    ],
)
def test_a_target_crs_that_cannot_be_meant_is_refused(made: Survey, tmp_path: Path, crs: str, message: str):
    survey = made.copy(tmp_path)
    with pytest.raises(JaxbaError, match=message):
        survey.run(f"crs.target_crs={crs}", until="crs")
    stopped = json.loads((survey.project / "summary.json").read_text())["stopped"]
    assert stopped["stage"] == "crs" and "EPSG" in stopped["reason"]


def test_unknown_parameters_are_refused_with_the_known_ones():
    with pytest.raises(JaxbaError, match=r"match\.rato; did you mean ratio\? the parameters of match are ratio"):
        changed(PIPELINE.settings, ["match.rato=0.7"])


def test_an_out_folder_that_cannot_be_made_is_refused(photos: Path, tmp_path: Path):
    (tmp_path / "file").touch()
    with pytest.raises(JaxbaError, match="file: is a file; choose a folder for --out"):
        Survey(photos, tmp_path / "file").run(until="metadata")
    with pytest.raises(JaxbaError, match="a file is in the way; choose another --out"):
        Survey(photos, tmp_path / "file" / "project").run(until="metadata")
    with pytest.raises(JaxbaError, match=r"/proc/project: .*choose another place \(--out\)"):
        Survey(photos, Path("/proc/project")).run(until="metadata")


@pytest.mark.parametrize(
    ("code", "message"),
    [
        (errno.ENOSPC, "No space left on device: free some space, .*; what was written before is kept"),
        (errno.EROFS, r"Read-only file system: .* choose another place \(--out\)"),
        (errno.EACCES, r"may not be written to: choose another place \(--out\), or change its permissions"),
    ],
)
def test_a_project_that_can_no_longer_be_written_stops_the_run_and_says_why(
    made: Survey, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, code: int, message: str
):
    survey = made.copy(tmp_path)

    def fail(*_: object, **__: object) -> None:
        raise OSError(code, os.strerror(code))

    monkeypatch.setattr(store.np, "save", fail)
    with pytest.raises(JaxbaError, match=message):
        survey.run("crs.yaw_std=4", until="crs")
    monkeypatch.undo()
    assert not list(survey.project.rglob("*.partial"))
    assert survey.run(until="pairs").stages_run == ()


@pytest.mark.skipif(os.geteuid() == 0, reason="root may read and write everywhere")
def test_what_may_not_be_read_or_written_is_named(made: Survey, tmp_path: Path):
    survey = made.copy(tmp_path, photos=True)
    (survey.photos / "SIM_0001.JPG").chmod(0)
    os.utime(survey.photos / "SIM_0001.JPG", (1e9, 1e9))
    with pytest.raises(JaxbaError, match=r"SIM_0001\.JPG: cannot be read .* check its permissions"):
        survey.run(until="metadata")
    survey.project.chmod(0o500)
    with pytest.raises(JaxbaError, match=r"may not be written to: choose another place \(--out\)"):
        survey.run(until="metadata")


def test_a_file_that_cannot_be_read_stops_the_run_by_name(
    made: Survey, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    def fail(path: Path) -> str:
        raise PermissionError(errno.EACCES, os.strerror(errno.EACCES), str(path))

    monkeypatch.setattr("jaxba.engine._project.sha256", fail)
    with pytest.raises(JaxbaError, match=r"SIM_0001\.JPG: cannot be read \(Permission denied\); check its permissions"):
        Survey(made.photos, tmp_path / "project").run(until="metadata")


def test_awkward_files_among_photos_are_read_or_named(data_dir: Path, tmp_path: Path):
    """Each broken or bare file of the collection, to the end of the features: none ends in a traceback."""
    survey = Survey(data_dir / "exif", tmp_path / "project")
    files = {path.name for path in survey.photos.iterdir()}
    run = survey.run(*SAME_PLACE, until="features")
    facts = run.facts
    used = {run.done.photos[i].name for i in run.done.features}
    left_out = {entry["name"] for entry in facts["left_out"]}
    assert used | left_out == files and len(files) == 11
    assert any(line.startswith("broken1.jpg: XMP is damaged") for line in facts["stages"]["metadata"])
    assert max(map(len, facts["stages"]["metadata"])) < 700


def test_links_to_folders_of_photos_are_followed_once(photos: Path, tmp_path: Path):
    (tmp_path / "photos").mkdir()
    (tmp_path / "photos" / "flight").symlink_to(photos)
    (tmp_path / "photos" / "back").symlink_to(tmp_path / "photos")
    run = Survey(tmp_path / "photos", tmp_path / "photos" / "project").run(until="metadata")
    assert [photo.name for photo in run.done.photos] == [f"flight/SIM_{i:04d}.JPG" for i in range(1, NUM_PHOTOS + 1)]
