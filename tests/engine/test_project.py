import hashlib
import json
from pathlib import Path

import pytest

from jaxba import JaxbaError
from jaxba.engine import _project
from jaxba.engine._project import Given, Project, read_lists


def read_geotags(photos: Path, path: Path | None = None) -> tuple[str, str] | None:
    return read_lists(Given(photos=photos, geotags=path))["geotags"]


@pytest.fixture
def photos(tmp_path: Path) -> Path:
    folder = tmp_path / "photos"
    (folder / "second flight").mkdir(parents=True)
    (folder / "b.JPG").write_bytes(b"b")
    (folder / "second flight" / "a.jpg").write_bytes(b"a")
    (folder / ".hidden.jpg").touch()
    (folder / ".trash").mkdir()
    (folder / ".trash" / "c.jpg").touch()
    return folder


def test_photo_files_are_those_below_the_folder_by_name_with_their_digests(photos: Path, tmp_path: Path):
    files = Project(tmp_path / "project").photo_files(photos)
    assert [file.name for file in files] == ["b.JPG", "second flight/a.jpg"]
    assert [file.sha256 for file in files] == [hashlib.sha256(text).hexdigest() for text in (b"b", b"a")]
    assert all(file.path.is_absolute() for file in files)


def test_a_file_is_read_again_only_when_its_size_or_time_changed(photos: Path, tmp_path: Path, monkeypatch):
    read = []

    def digest(path: Path) -> str:
        read.append(path.name)
        return hashlib.sha256(path.read_bytes()).hexdigest()

    monkeypatch.setattr(_project, "sha256", digest)
    project = Project(tmp_path / "project")
    first = project.photo_files(photos)
    assert project.photo_files(photos) == first and sorted(read) == ["a.jpg", "b.JPG"]
    (photos / "b.JPG").write_bytes(b"other")
    second = project.photo_files(photos)
    assert sorted(read) == ["a.jpg", "b.JPG", "b.JPG"] and second[0].sha256 != first[0].sha256
    (tmp_path / "project" / "photos.json").write_text("{damaged")
    assert project.photo_files(photos) == second


def test_a_project_inside_the_photo_folder_is_no_photo(photos: Path):
    project = Project(photos / "project")
    (project.folder / "picture.png").touch()
    assert [file.name for file in project.photo_files(photos)] == ["b.JPG", "second flight/a.jpg"]


def test_every_photo_has_a_folder_of_its_own_whatever_its_name(tmp_path: Path):
    project = Project(tmp_path)
    long = "ü" * 120
    names = ["a.jpg", "a/b.jpg", "a%2Fb.jpg", "a:b.jpg", "flight 1/späte.jpg", f"{long}/a.jpg", f"{long}/b.jpg"]
    folders = [project.stage("features", name) for name in names]
    assert len({folder.name for folder in folders}) == len(names)
    for folder in folders:
        assert folder.parent == tmp_path / "stages" / "features"
        folder.with_name(f".{folder.name}.1234567.partial").mkdir(parents=True)  # as it is written


def test_json_is_written_whole_or_not_at_all(tmp_path: Path):
    project = Project(tmp_path)
    project.write_json("photos.json", {"ä": 1})
    assert project.read_json("photos.json") == {"ä": 1} == json.loads((tmp_path / "photos.json").read_text())
    with pytest.raises(TypeError):
        project.write_json("photos.json", {"ä": object()})
    assert project.read_json("photos.json") == {"ä": 1} and project.read_json("none.json") is None
    assert [path.name for path in tmp_path.iterdir()] == ["photos.json"]


def test_geotags_are_those_given_else_geo_txt_among_the_photos(photos: Path, tmp_path: Path):
    assert read_geotags(photos) is None
    (photos / "geo.txt").write_bytes(b"\xef\xbb\xbfEPSG:4326\n")
    (tmp_path / "other.csv").write_text("EPSG:32615\n")
    assert read_geotags(photos) == ("geo.txt", "EPSG:4326\n")
    assert read_geotags(photos, tmp_path / "other.csv") == ("other.csv", "EPSG:32615\n")
    (tmp_path / "wide.csv").write_bytes("EPSG:32615\n".encode("utf-16"))  # as spreadsheets write "Unicode text"
    assert read_geotags(photos, tmp_path / "wide.csv") == ("wide.csv", "EPSG:32615\n")
    (tmp_path / "latin.csv").write_bytes("Höhe".encode("latin-1"))
    with pytest.raises(JaxbaError, match=r"latin\.csv: cannot be read as text .* in UTF-8"):
        read_geotags(photos, tmp_path / "latin.csv")
    with pytest.raises(JaxbaError, match=r"gone\.csv: there is no such file"):
        read_geotags(photos, tmp_path / "gone.csv")


@pytest.mark.parametrize("name", ["geo.txt", "GEO.TXT", "Geo.txt"])
@pytest.mark.parametrize("control", ["gcp_list.txt", "GCP_LIST.txt"])
def test_lists_among_the_photos_are_found_in_any_case(photos: Path, tmp_path: Path, name: str, control: str):
    (photos / name).write_text("EPSG:4326\n")
    (photos / control).write_text("EPSG:32615\n")
    (photos / "second flight" / "geo.txt").write_text("EPSG:4979\n")
    found = read_lists(Given(photos=photos))
    assert (found["geotags"], found["gcp"], found["check"]) == ((name, "EPSG:4326\n"), (control, "EPSG:32615\n"), None)
    assert found["found_lists"] == ("geotags", "gcp") and found["own_lists"] == (name, control)
    given = read_lists(Given(photos=photos, geotags=photos / "second flight" / "geo.txt", gcp=Path("none")))
    assert given["geotags"] == ("geo.txt", "EPSG:4979\n") and given["gcp"] is None
    assert given["found_lists"] == () and given["own_lists"] == ("second flight/geo.txt",)


def test_two_lists_of_one_name_among_the_photos_are_refused(photos: Path):
    (photos / "geo.txt").touch()
    (photos / "GEO.txt").touch()
    if len(list(photos.glob("[gG][eE][oO].txt"))) < 2:
        pytest.skip("the file system knows no case")
    with pytest.raises(JaxbaError, match=r"photos: holds GEO\.txt and geo\.txt; keep one of them"):
        read_lists(Given(photos=photos))


def test_what_a_run_was_given_and_the_stage_that_it_is_in_are_kept(tmp_path: Path):
    project = Project(tmp_path)
    given = Given(photos=tmp_path / "photos", geotags=None, gcp=Path("none"))
    project.write_given(given, "match")
    assert Project(tmp_path, make=False).read_given() == (given, "match")
    project.write_given(given, None)
    assert project.read_given()[1] is None
    (tmp_path / "run.json").write_text("{")
    with pytest.raises(JaxbaError, match=r"run\.json: is damaged; run again"):
        project.read_given()
    with pytest.raises(JaxbaError, match=r"none: is no project; give the folder that `jaxba run --out` was given"):
        Project(tmp_path / "none", make=False)
    assert not (tmp_path / "none").exists()


def test_what_a_killed_run_left_half_written_is_removed_and_nothing_else(tmp_path: Path):
    project = Project(tmp_path)
    kept = [project.stage("features", "a.partial.jpg"), project.stage("pairs"), project.export]
    left = [folder.with_name(f".{folder.name}.123{end}") for folder in kept for end in (".partial", ".old")]
    for folder in (*kept, *left):
        folder.mkdir(parents=True)
        (folder / "array.npy").touch()
    (tmp_path / ".summary.json.123.partial").touch()
    project.remove_leftovers()
    assert [folder.exists() for folder in kept] == [True] * 3 and not any(folder.exists() for folder in left)
    assert not (tmp_path / ".summary.json.123.partial").exists()
