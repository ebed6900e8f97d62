"""The project folder: where each stage's work lies, and which photos the folder of photos holds.

project/
  jaxba.toml           every parameter of the last run
  run.json             the folders and lists that it was given, and the stage that it is in
  photos.json          size, time and SHA-256 of each file, so that a file is read again only when it changed
  stages/<stage>/      what the stage made; features and match hold a folder a photo
  unfinished/<stage>/  what a stage that does all photos at once has done so far, where it was stopped
  export/              the results
  summary.json         what became of each stage and each photo
  times.json           seconds that each stage took when it last had anything to do
  .lock, .lock.holder  held by the run that works here; who that is
"""

import contextlib
import hashlib
import json
import os
import re
import shutil
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from jaxba._atomic import cannot_write, remove_leftovers, write_atomically
from jaxba._errors import JaxbaError
from jaxba.engine._store import sha256
from jaxba.io import text_of
from jaxba.scene import PhotoFile

SETTINGS, SUMMARY, EXPORT, TIMES = "jaxba.toml", "summary.json", "export", "times.json"
_RUN, _PHOTOS = "run.json", "photos.json"
FOUND_LISTS = {"geotags": "geo.txt", "gcp": "gcp_list.txt"}
"""Names, in any case, of the lists that are used where they lie among the photos and no other is given."""
_LISTS = ("geotags", "gcp", "check", "bars")
_NO_LIST = Path("none")
_LONGEST_NAME = 180  # bytes of a folder's name, which mostly may have 255


@dataclass(frozen=True, kw_only=True)
class Given:
    """What a run was given beside its parameters: the folder of photos, and lists.

    - `geotags`: replaces the photos' tags. `gcp`, `check`: surveyed points and their marks. `bars`: known distances
      between marked points. `none` stands for no list, not even one that lies among the photos.
    """

    photos: Path
    geotags: Path | None = None
    gcp: Path | None = None
    check: Path | None = None
    bars: Path | None = None


class Project:
    """Paths of a project folder, which is made if it is not there; with `make` off one that must be there."""

    def __init__(self, folder: Path, *, make: bool = True) -> None:
        self.folder = folder
        self.export = folder / EXPORT
        self._is_new, self._made = False, list[Path]()  # folders that this object made, the innermost first
        if make:
            self._make(folder)
        elif not is_project(folder):
            raise JaxbaError(f"{folder}: is no project; give the folder that `jaxba run --out` was given.")

    def _make(self, folder: Path) -> None:
        try:
            self._made = [place for place in (folder, *folder.parents) if not place.exists()]
            self._is_new = bool(self._made) or (folder.is_dir() and not any(folder.iterdir()))
            folder.mkdir(parents=True, exist_ok=True)
            probe = folder / f".{os.getpid()}.probe"
            probe.touch()
            probe.unlink()
        except NotADirectoryError:
            raise JaxbaError(f"{folder}: a file is in the way; choose another --out.") from None
        except FileExistsError:
            raise JaxbaError(f"{folder}: is a file; choose a folder for --out.") from None
        except OSError as error:
            raise cannot_write(folder, error) from error

    def stage(self, name: str, photo: str | None = None) -> Path:
        """Return the folder of what a stage made, or made of one photo."""
        folder = self.folder.absolute() / "stages" / name  # which holds wherever it is worked on
        return folder if photo is None else folder / _folder_name(photo)

    def unfinished(self, name: str, key: str) -> Path:
        """Return the folder of what a stage has done so far under a key; what it did under another one is removed."""
        folder = self._unfinished(name) / key
        if not folder.exists():
            self.forget_unfinished(name)
        try:
            folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise cannot_write(folder, error) from error
        return folder

    def forget_unfinished(self, name: str) -> None:
        """Remove what a stage has done so far: it has ended."""
        shutil.rmtree(self._unfinished(name), ignore_errors=True)
        with contextlib.suppress(OSError):  # another stage's lies there, or there is none
            self._unfinished(name).parent.rmdir()

    def _unfinished(self, name: str) -> Path:
        return self.folder / "unfinished" / name

    def remove_if_new(self) -> None:
        """Remove what this object made, where the project's folder was not there or empty."""
        if not self._is_new:
            return
        shutil.rmtree(self.folder, ignore_errors=True)
        if not self._made:
            self.folder.mkdir()
        for place in self._made[1:]:
            with contextlib.suppress(OSError):  # something else was put there meanwhile
                place.rmdir()

    def remove_leftovers(self) -> None:
        """Remove what a run that was killed left half written."""
        stages = self.folder / "stages"
        for folder in (self.folder, stages, *(path for path in stages.glob("*") if path.is_dir())):
            remove_leftovers(folder)

    def write_given(self, given: Given, stage: str | None) -> None:
        """Write what a run was given and the stage that it is in; None: it has ended."""
        paths = {
            name: path if path is None else str(path if path == _NO_LIST else path.absolute())
            for name, path in vars(given).items()
        }
        self.write_json(_RUN, {**paths, "stage": stage})

    def read_given(self) -> tuple[Given, str | None]:
        """Return what the last run was given, and the stage in which it was killed, or is now; None where it ended."""
        content = self.read_json(_RUN)
        if not isinstance(content, dict) or "stage" not in content:
            raise JaxbaError(f"{self.folder / _RUN}: is damaged; run again.")
        paths = {name: None if (text := content.get(name)) is None else Path(text) for name in _LISTS}
        return Given(photos=Path(content["photos"]), **paths), content["stage"]

    def write_json(self, name: str, content: object) -> None:
        """Write a JSON file of the project, whole or not at all, where it changes."""
        self.write_text(name, json.dumps(content, indent=1) + "\n")

    def write_text(self, name: str, text: str) -> None:
        """Write a text file of the project, whole or not at all, where it changes."""
        path = self.folder / name
        with contextlib.suppress(OSError):
            if path.read_bytes() == text.encode():
                return
        with write_atomically(path) as file:
            file.write(text.encode())

    def read_json(self, name: str) -> object:
        """Return the content of a JSON file of the project; None where there is none or it is damaged."""
        try:
            return json.loads((self.folder / name).read_text(encoding="utf-8"))
        except (OSError, ValueError):
            return None

    def photo_files(self, photos: Path, *, remember: bool = True) -> tuple[PhotoFile, ...]:
        """Return the files below the folder of photos, by name, with the SHA-256 of each.

        A file whose size and time are those of the last run is not read again, and with `remember` those of this one
        are kept. Hidden files and the project itself, where it lies inside the folder, are passed over.
        """
        paths = _files_below(photos, self.folder)
        known = self.read_json(_PHOTOS)
        known = known if isinstance(known, dict) else {}
        found, table = [], {}
        for name, path in paths:
            try:
                stat = path.stat()
                stamp = [stat.st_size, stat.st_mtime_ns]
                before = known.get(name)
                digest = before[2] if isinstance(before, list) and before[:2] == stamp else sha256(path)
            except OSError as error:
                raise JaxbaError(
                    f"{path}: cannot be read ({error.strerror}); check its permissions, or delete it."
                ) from error
            table[name] = [*stamp, digest]
            found.append(PhotoFile(name=name, path=path.absolute(), sha256=digest))
        if remember:
            self.write_json(_PHOTOS, table)
        return tuple(found)


def is_project(folder: Path) -> bool:
    """Return whether a run has worked in a folder."""
    return (folder / _RUN).is_file()


def refuse_photo_folder(photos: Path, out: Path) -> None:
    """Raise `JaxbaError` where a project would be made in the folder of the photos; nothing is written there."""
    if photos.resolve() == out.resolve():
        raise JaxbaError(f"{photos}: is the folder of the photos; choose another folder for --out.")


def read_lists(given: Given) -> dict[str, Any]:
    """Return name and text of the lists, as `Done` takes them, and which of them lie among the photos.

    Raises `JaxbaError` where a list cannot be read, and where two files among the photos are called like one.
    """
    paths = list_paths(given)
    folder = given.photos.resolve()
    used = [path.resolve() for path in paths.values() if path is not None]
    return {
        "geotags": read_list(paths["geotags"], "a geo.txt or CSV"),
        "gcp": read_list(paths["gcp"], "a gcp_list.txt or CSV"),
        "check": read_list(paths["check"], "a gcp_list.txt or CSV"),
        "bars": read_list(paths["bars"], "a CSV of scale bars"),
        "found_lists": tuple(name for name, path in paths.items() if path and getattr(given, name) is None),
        "own_lists": tuple(path.relative_to(folder).as_posix() for path in used if path.is_relative_to(folder)),
    }


def list_paths(given: Given) -> dict[str, Path | None]:
    """Return the file of each kind of list, given or found among the photos; None where there is none.

    Raises `JaxbaError` where two files among the photos are called like one.
    """
    paths = {name: getattr(given, name) for name in _LISTS}
    for name, usual in FOUND_LISTS.items():
        if paths[name] is None:
            paths[name] = _among(given.photos, usual)
    return {name: None if path == _NO_LIST else path for name, path in paths.items()}


def _among(photos: Path, usual: str) -> Path | None:
    """Return the file in the folder of photos that has the usual name of a list, in any case."""
    if not photos.is_dir():
        return None
    found = sorted(path for path in photos.iterdir() if path.name.lower() == usual and path.is_file())
    if len(found) > 1:
        raise JaxbaError(f"{photos}: holds {' and '.join(path.name for path in found)}; keep one of them.")
    return found[0] if found else None


def read_list(path: Path | None, kind: str) -> tuple[str, str] | None:
    """Return name and text of a list; None where none is given. `kind`: what it is to be, for messages."""
    if path is None:
        return None
    if not path.is_file():
        raise JaxbaError(f"{path}: there is no such file; give {kind}.")
    try:
        return str(path.name), text_of(path.read_bytes())
    except (OSError, UnicodeDecodeError) as error:
        raise JaxbaError(f"{path}: cannot be read as text ({error}); give {kind} in UTF-8.") from error


def _files_below(photos: Path, project: Path) -> list[tuple[str, Path]]:
    """Return name and path of the files below a folder, links followed, by name."""
    if not photos.exists():
        raise JaxbaError(f"{photos}: there is no such folder; give the folder that holds the photos.")
    if not photos.is_dir():
        raise JaxbaError(f"{photos}: is a file; give the folder that holds the photos.")
    been, found = {project.resolve()}, []
    for root, folders, names in os.walk(photos, onerror=_raise_unreadable, followlinks=True):
        place = Path(root).resolve()
        if place in been:  # the project itself, or a link back
            folders.clear()
            continue
        been.add(place)
        folders[:] = sorted(f for f in folders if not f.startswith("."))
        for name in names:
            path = Path(root) / name
            if name.startswith(".") or not (path.is_file() or path.is_symlink()):  # a broken link is said later
                continue
            found.append((path.relative_to(photos).as_posix(), path))
    for name, _ in found:
        if re.search("[\x00-\x1f\x7f\ud800-\udfff]", name):  # the last: bytes that are no UTF-8
            raise JaxbaError(
                f"{photos}: the file {name!a} has characters in its name that not every program can write; rename it."
            )
    return sorted(found)


def _raise_unreadable(error: OSError) -> None:
    raise JaxbaError(f"{error.filename}: cannot be read ({error.strerror}); check its permissions.") from error


def _folder_name(photo: str) -> str:
    """Return a photo's name as that of one folder; a long one is cut, and told apart by a digest."""
    name = re.sub(r'[%/\\:*?"<>|]', lambda match: f"%{ord(match[0]):02X}", photo)
    if len(name.encode()) <= _LONGEST_NAME:
        return name
    return f"{name.encode()[:_LONGEST_NAME].decode(errors='ignore')}-{hashlib.sha256(photo.encode()).hexdigest()[:16]}"
