"""What a stage made, as a folder: `record.json` and an `.npy` file an array; whole, or not there at all.

A folder is written beside its place and renamed; `record.json` holds the key under which it was made, so that the same
work is recognised, and a checksum of every file and of itself, so that damage is noticed. Arrays are memory-mapped when
they are read: opening a block of 100 MB costs a millisecond, and the features of 500 photos need no memory until they
are looked at. Checking those of 500 photos (600 MB) takes under a second.
"""

import functools
import hashlib
import json
import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, TypeVar, get_args

import cattrs
import numpy as np
from jaxtyping import AbstractArray

from jaxba._atomic import write_folder_atomically
from jaxba._errors import JaxbaError
from jaxba.engine._fingerprint import fingerprint
from jaxba.engine._key import Key

T = TypeVar("T")
_RECORD = "record.json"
_ARRAY = "__npy__"


@dataclass(frozen=True)
class Record:
    """What is known of a folder without opening its arrays.

    - `key`: what it was made from. `digest`: of its contents. `failed`: why nothing could be made, else None.
    """

    key: Key
    digest: str
    failed: str | None = None


def save(folder: Path, value: Any, key: Key) -> Record:
    """Write a dataclass as a folder, in place of what was there; return its record."""
    record = Record(key, fingerprint(value))
    with write_folder_atomically(folder) as partial:
        tree = _arrays_to_files(_converter().unstructure(value), partial, "")
        _write_record(partial, record, tree)
    return record


def save_failure(folder: Path, reason: str, key: Key) -> Record:
    """Write that nothing could be made and why, so that the next run need not try again."""
    record = Record(key, fingerprint(reason), reason)
    with write_folder_atomically(folder) as partial:
        _write_record(partial, record, None)
    return record


def read_record(folder: Path) -> Record | None:
    """Return the record of a folder; None where there is none or it is damaged."""
    content = _content(folder)
    return None if content is None else Record(Key(**content["key"]), content["digest"], content["failed"])


def damage(folder: Path) -> str | None:
    """Return in words what of a folder is damaged, after reading all of it; None where it is whole."""
    content = _content(folder)
    if content is None:
        return f"{_RECORD} is missing or damaged"
    return damaged_file(folder, content["files"])


def damaged_file(folder: Path, checksums: Mapping[str, str]) -> str | None:
    """Return the first of some files that is missing or has another checksum, in words; None where none has."""
    for name, checksum in checksums.items():
        try:
            found = sha256(folder / name)
        except OSError:
            return f"{name} is missing"
        if found != checksum:
            return f"{name} is damaged"
    return None


def sha256(path: Path) -> str:
    """Return the SHA-256 of a file's contents, hexadecimal."""
    with open(path, "rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def load(folder: Path, cls: type[T]) -> T:
    """Return what was saved, its arrays memory-mapped; what is written into them never reaches the file."""
    content = _content(folder)
    if content is None:
        raise JaxbaError(f"{folder}: the record is missing or damaged; run again to make it anew.")
    try:
        return _converter().structure(_files_to_arrays(content["value"], folder), cls)
    except cattrs.BaseValidationError as error:
        raise JaxbaError(f"{folder}: the record is of another version of jaxba; run again to make it anew.") from error


class Stored(Mapping[int, T]):
    """What a stage made of each photo, by image index, opened when it is looked at."""

    def __init__(self, cls: type, field: str, folders: Mapping[int, Path], digests: Mapping[int, str]) -> None:
        """`field`: of `cls`, the one value that is handed out."""
        self.cls, self.field = cls, field
        self.folders, self.digests = dict(folders), dict(digests)

    def __getitem__(self, index: int) -> T:
        return getattr(load(self.folders[index], self.cls), self.field)

    def __iter__(self) -> Iterator[int]:
        return iter(self.folders)

    def __len__(self) -> int:
        return len(self.folders)

    def only(self, indices: Sequence[int]) -> "Stored[T]":
        """Return some of the photos', counted anew from 0 in the order given."""
        folders = {row: self.folders[i] for row, i in enumerate(indices)}
        return Stored(self.cls, self.field, folders, {row: self.digests[i] for row, i in enumerate(indices)})


def _write_record(folder: Path, record: Record, tree: Any) -> None:
    files = {path.name: sha256(path) for path in sorted(folder.iterdir())}
    content = json.loads(json.dumps({**asdict(record), "value": tree, "files": files}))  # as it will be read
    content["checksum"] = _checksum(content)
    with open(folder / _RECORD, "w", encoding="utf-8") as file:
        json.dump(content, file, indent=1)
        file.flush()
        os.fsync(file.fileno())


def _content(folder: Path) -> dict[str, Any] | None:
    try:
        content = json.loads((folder / _RECORD).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None
    is_whole = isinstance(content, dict) and content.pop("checksum", None) == _checksum(content)
    return content if is_whole else None


def _checksum(content: dict[str, Any]) -> str:
    """Return the checksum of a record's other entries."""
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()


def _arrays_to_files(tree: Any, folder: Path, name: str) -> Any:
    if isinstance(tree, np.ndarray):
        file_name = f"{name}.npy"
        np.save(folder / file_name, tree, allow_pickle=False)
        return {_ARRAY: file_name}
    if isinstance(tree, Mapping):
        return {key: _arrays_to_files(entry, folder, f"{name}.{key}".lstrip(".")) for key, entry in tree.items()}
    if isinstance(tree, list | tuple):
        return [_arrays_to_files(entry, folder, f"{name}.{i}") for i, entry in enumerate(tree)]
    return tree


def _files_to_arrays(tree: Any, folder: Path) -> Any:
    if isinstance(tree, dict):
        if _ARRAY in tree:
            path = folder / tree[_ARRAY]
            try:
                array = np.load(path, mmap_mode="c", allow_pickle=False)
            except ValueError as error:  # an array of no elements cannot be mapped
                if "mmap" not in str(error):
                    raise JaxbaError(f"{path}: damaged ({error}); delete its folder and run again.") from error
                array = np.load(path, allow_pickle=False)
            except OSError as error:
                raise JaxbaError(f"{path}: {error.strerror or error}; delete its folder and run again.") from error
            return array
        return {key: _files_to_arrays(entry, folder) for key, entry in tree.items()}
    if isinstance(tree, list):
        return [_files_to_arrays(entry, folder) for entry in tree]
    return tree


@functools.cache
def _converter() -> cattrs.Converter:
    converter = cattrs.Converter()
    converter.register_unstructure_hook(np.ndarray, lambda array: array)
    converter.register_unstructure_hook_func(_is_array_type, lambda array: array)
    converter.register_structure_hook_func(_is_array_type, lambda array, _: array)
    converter.register_unstructure_hook(Path, str)
    converter.register_structure_hook(Path, lambda text, _: Path(text))
    return converter


def _is_array_type(kind: Any) -> bool:
    """Whether an annotation is an array's, such as `Float[np.ndarray, "n 3"]`."""
    if isinstance(kind, type):
        return issubclass(kind, AbstractArray | np.ndarray)
    return bool(get_args(kind)) and all(_is_array_type(entry) for entry in get_args(kind))
