"""The project folder: where each stage's work lies, and which photos the folder of photos holds.

project/
  settings.json        the parameters of the last run
  photos.json          size, time and SHA-256 of each file, so that a file is read again only when it changed
  stages/<stage>/      what the stage made; features and match hold a folder a photo
  export/              the results
  summary.json         what became of each stage and each photo
"""

import hashlib
import json
import os
from pathlib import Path
from urllib.parse import quote

from jaxba._errors import JaxbaError
from jaxba.pipeline._store import cannot_write
from jaxba.scene import PhotoFile

_GEOTAGS = "geo.txt"


class Project:
    """Paths of a project folder, which is made if it is not there."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.export = folder / "export"
        try:
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
        folder = self.folder / "stages" / name
        return folder if photo is None else folder / quote(photo, safe=" ()+,;=@")

    def write_json(self, name: str, content: object) -> None:
        """Write a JSON file of the project, whole or not at all."""
        path = self.folder / name
        partial = path.with_name(f".{path.name}.{os.getpid()}.partial")
        try:
            partial.write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")
            partial.replace(path)
        except OSError as error:
            partial.unlink(missing_ok=True)
            raise cannot_write(path, error) from error

    def read_json(self, name: str) -> object:
        """Return the content of a JSON file of the project; None where there is none or it is damaged."""
        try:
            return json.loads((self.folder / name).read_text(encoding="utf-8"))
        except (OSError, ValueError):
            return None

    def photo_files(self, photos: Path) -> tuple[PhotoFile, ...]:
        """Return the files below the folder of photos, by name, with the SHA-256 of each.

        A file whose size and time are those of the last run is not read again. Hidden files and the project itself,
        where it lies inside the folder, are passed over.
        """
        paths = _files_below(photos, self.folder)
        known = self.read_json("photos.json")
        known = known if isinstance(known, dict) else {}
        found, table = [], {}
        for name, path in paths:
            try:
                stat = path.stat()
                stamp = [stat.st_size, stat.st_mtime_ns]
                before = known.get(name)
                digest = before[2] if isinstance(before, list) and before[:2] == stamp else _sha256(path)
            except OSError as error:
                raise JaxbaError(f"{path}: cannot be read ({error.strerror}); check its permissions.") from error
            table[name] = [*stamp, digest]
            found.append(PhotoFile(name=name, path=path.absolute(), sha256=digest))
        if table != known:
            self.write_json("photos.json", table)
        return tuple(found)


def read_geotags(photos: Path, given: Path | None) -> tuple[str, str] | None:
    """Return name and text of the list that replaces the tags: the given one, or `geo.txt` among the photos."""
    path = given or photos / _GEOTAGS
    if given is None and not path.is_file():
        return None
    try:
        return str(path.name), path.read_text(encoding="utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        raise JaxbaError(f"{path}: cannot be read as text ({error}); give a geo.txt or CSV in UTF-8.") from error


def _files_below(photos: Path, project: Path) -> list[tuple[str, Path]]:
    if not photos.exists():
        raise JaxbaError(f"{photos}: there is no such folder; give the folder that holds the photos.")
    if not photos.is_dir():
        raise JaxbaError(f"{photos}: is a file; give the folder that holds the photos.")
    inside = project.resolve()
    found = []
    for root, folders, names in os.walk(photos):
        folders[:] = sorted(f for f in folders if not f.startswith(".") and (Path(root) / f).resolve() != inside)
        for name in names:
            path = Path(root) / name
            if not name.startswith(".") and path.is_file():
                found.append((path.relative_to(photos).as_posix(), path))
    return sorted(found)


def _sha256(path: Path) -> str:
    with open(path, "rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
