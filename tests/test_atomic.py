"""Files appear whole or not at all, and inputs are never overwritten."""

import errno
import os
import resource
import stat
import subprocess
import sys
from pathlib import Path

import pytest

from jaxba._atomic import refuse_same_file, remove_leftovers, write_atomically, write_folder_atomically
from jaxba._errors import JaxbaError


def test_file_appears_at_the_end_and_nothing_else_stays(tmp_path: Path):
    path = tmp_path / "out.bin"
    with write_atomically(path) as file:
        file.write(b"new")
        assert not path.exists()
    assert path.read_bytes() == b"new"
    assert os.listdir(tmp_path) == ["out.bin"]


def test_file_has_the_permissions_of_any_new_file(tmp_path: Path):
    (tmp_path / "plain").touch()
    with write_atomically(tmp_path / "out") as file:
        file.write(b"x")
    assert stat.S_IMODE((tmp_path / "out").stat().st_mode) == stat.S_IMODE((tmp_path / "plain").stat().st_mode)


@pytest.mark.parametrize("error", [RuntimeError, KeyboardInterrupt])
def test_interrupted_write_leaves_the_old_file_and_no_rest(tmp_path: Path, error: type[BaseException]):
    path = tmp_path / "out.bin"
    path.write_bytes(b"old")
    with pytest.raises(error), write_atomically(path) as file:
        file.write(b"half")
        raise error
    assert path.read_bytes() == b"old"
    assert os.listdir(tmp_path) == ["out.bin"]


def test_write_beyond_the_space_there_is_leaves_the_old_file_and_says_so(tmp_path: Path):
    path = tmp_path / "out.bin"
    path.write_bytes(b"old")
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (100_000, limits[1]))
    try:
        with (
            pytest.raises(JaxbaError, match=r"out\.bin: not written, File too large: free some space"),
            write_atomically(path) as file,
        ):
            file.write(bytes(1_000_000))
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert path.read_bytes() == b"old"
    assert os.listdir(tmp_path) == ["out.bin"]


@pytest.mark.parametrize(
    ("number", "cure"),
    [(errno.ENOSPC, "free some space"), (errno.EROFS, "may not be written to"), (errno.EIO, "choose another place")],
)
def test_failure_of_the_disk_names_the_cure(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, number: int, cure: str):
    def fail(_: int) -> None:
        raise OSError(number, os.strerror(number))

    monkeypatch.setattr(os, "fsync", fail)
    with pytest.raises(JaxbaError, match=cure), write_atomically(tmp_path / "out") as file:
        file.write(b"x")
    assert os.listdir(tmp_path) == []


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write everywhere")
def test_read_only_folder_is_named(tmp_path: Path):
    tmp_path.chmod(0o500)
    with pytest.raises(JaxbaError, match="may not be written to"), write_atomically(tmp_path / "out") as file:
        file.write(b"x")


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("missing/out", "No such file or directory: create the folder first"),
        ("file/out", "a part of the path is a file"),
        ("folder", "it is a folder: add a file name"),
        ("/dev/null", "it is a device"),
        ("x" * 300, "choose a shorter name"),
    ],
)
def test_place_where_no_file_can_be_is_refused(tmp_path: Path, name: str, message: str):
    (tmp_path / "file").touch()
    (tmp_path / "folder").mkdir()
    with pytest.raises(JaxbaError, match=message), write_atomically(tmp_path / name) as file:
        file.write(b"x")
    assert sorted(os.listdir(tmp_path)) == ["file", "folder"]


def test_folder_takes_its_place_at_the_end_with_the_folders_above_it(tmp_path: Path):
    folder = tmp_path / "above" / "made"
    for content in ("old", "new"):
        with write_folder_atomically(folder) as partial:
            (partial / content).touch()
            assert (os.listdir(folder) if folder.exists() else []) == (["old"] if content == "new" else [])
        assert os.listdir(folder) == [content] and os.listdir(folder.parent) == ["made"]


@pytest.mark.parametrize("error", [RuntimeError, KeyboardInterrupt])
def test_interrupted_folder_leaves_the_old_one_and_no_rest(tmp_path: Path, error: type[BaseException]):
    (tmp_path / "made").mkdir()
    (tmp_path / "made" / "old").touch()
    with pytest.raises(error), write_folder_atomically(tmp_path / "made") as partial:
        (partial / "half").touch()
        raise error
    assert os.listdir(tmp_path) == ["made"] and os.listdir(tmp_path / "made") == ["old"]


def test_folder_that_cannot_take_its_place_leaves_the_old_one(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    (tmp_path / "made").mkdir()
    (tmp_path / "made" / "old").touch()
    rename = Path.rename

    def fail(self: Path, target: Path) -> Path:
        if self.suffix == ".partial":
            raise OSError(errno.EIO, os.strerror(errno.EIO))
        return rename(self, target)

    monkeypatch.setattr(Path, "rename", fail)
    with (
        pytest.raises(JaxbaError, match=r"made: not written, Input/output error: choose another place"),
        write_folder_atomically(tmp_path / "made"),
    ):
        pass
    assert os.listdir(tmp_path) == ["made"] and os.listdir(tmp_path / "made") == ["old"]


def test_what_a_killed_process_leaves_is_removed(tmp_path: Path):
    code = (
        "import os, sys\nfrom jaxba._atomic import write_atomically, write_folder_atomically\nplace = sys.argv[1]\n"
        "with write_folder_atomically(place + '/made'), write_atomically(place + '/out'):\n    os._exit(1)"
    )
    subprocess.run([sys.executable, "-c", code, str(tmp_path)], check=False)
    assert len(os.listdir(tmp_path)) == 2
    (tmp_path / "kept.partial").touch()
    remove_leftovers(tmp_path)
    assert os.listdir(tmp_path) == ["kept.partial"]


def test_link_is_followed(tmp_path: Path):
    (tmp_path / "real").write_bytes(b"old")
    (tmp_path / "link").symlink_to(tmp_path / "real")
    with write_atomically(tmp_path / "link") as file:
        file.write(b"new")
    assert (tmp_path / "real").read_bytes() == b"new"
    assert (tmp_path / "link").is_symlink()


def test_output_that_is_the_input_under_any_name_is_refused(tmp_path: Path):
    path = tmp_path / "tile.npz"
    path.touch()
    (tmp_path / "soft").symlink_to(path)
    (tmp_path / "hard").hardlink_to(path)
    (tmp_path / "folder").mkdir()
    for output in (path, tmp_path / "soft", tmp_path / "hard", tmp_path / "folder" / ".." / "tile.npz"):
        with pytest.raises(JaxbaError, match=r"the output is the input .*tile\.npz, which is never overwritten"):
            refuse_same_file(path, output)
    refuse_same_file(path, tmp_path / "tile.solved.npz")


def test_import_loads_no_jax():
    code = "import sys, jaxba.io; print(*sorted({'jax', 'equinox'} & set(sys.modules)))"
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert run.stdout.split() == []
