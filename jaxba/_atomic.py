"""Files and folders that appear whole or not at all, and inputs that are never overwritten.

A file is written under a temporary name in the folder of its target, flushed to the disk, and renamed: a rename within
a folder replaces a file in one step, so a reader sees the old file or the new one, never a part. A folder is built
under a temporary name in the same way; the old one is moved aside first, since no folder can be renamed onto another.
Whatever goes wrong before that (a full disk, an interrupt) leaves what was there and removes the temporary one; what a
killed process leaves is for `remove_leftovers`.
"""

import contextlib
import errno
import os
import secrets
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO

from jaxba._errors import JaxbaError

_PARTIAL, _OLD = ".partial", ".old"
_ELSEWHERE = "choose another place (--out)"
_DENIED = f"the folder may not be written to: {_ELSEWHERE}, or change its permissions"
_FULL = "free some space, or choose another disk; what was written before is kept"
_CURES = {
    errno.ENOENT: f"create the folder first, or {_ELSEWHERE}",
    errno.ENOTDIR: f"a part of the path is a file: {_ELSEWHERE}",
    errno.EACCES: _DENIED,
    errno.EPERM: _DENIED,
    errno.EROFS: _DENIED,
    errno.ENOSPC: _FULL,
    errno.EDQUOT: _FULL,
    errno.EFBIG: _FULL,
    errno.ENAMETOOLONG: "choose a shorter name",
}


@contextlib.contextmanager
def write_atomically(path: str | os.PathLike[str]) -> Iterator[BinaryIO]:
    """Yield a binary file whose content becomes the file at `path` when the block ends without an error.

    A link is followed. An `OSError` within the block counts as a failure to write.

    Raises:
        JaxbaError: a missing or read-only folder, a full disk, a path that is no regular file.

    >>> import pathlib, tempfile
    >>> path = pathlib.Path(tempfile.mkdtemp(), "points.txt")
    >>> with write_atomically(path) as file:
    ...     _ = file.write(b"1 2 3")
    >>> path.read_bytes()
    b'1 2 3'
    """
    _refuse_what_is_no_file(path)
    with _beside(path) as temporary:
        with open(temporary, "xb") as file:
            yield file
            file.flush()
            os.fsync(file.fileno())
        os.replace(temporary, os.path.realpath(path))


@contextlib.contextmanager
def write_folder_atomically(path: str | os.PathLike[str]) -> Iterator[Path]:
    """Yield a new folder that becomes the one at `path` when the block ends without an error.

    Folders above it are made. An `OSError` within the block counts as a failure to write.

    Raises:
        JaxbaError: a folder that may not be written to, a full disk.

    >>> import tempfile
    >>> folder = Path(tempfile.mkdtemp(), "export")
    >>> with write_folder_atomically(folder) as partial:
    ...     _ = (partial / "points.txt").write_bytes(b"1 2 3")
    >>> [file.name for file in folder.iterdir()]
    ['points.txt']
    """
    target = Path(os.path.realpath(path))
    with _beside(path) as temporary:
        temporary.mkdir(parents=True)
        yield temporary
        old = temporary.with_suffix(_OLD)
        with contextlib.suppress(FileNotFoundError):
            target.rename(old)
        try:
            temporary.rename(target)
        except OSError:
            if old.exists():
                old.rename(target)
            raise
        _remove(old)


def refuse_unwritable(path: str | os.PathLike[str]) -> None:
    """Raise a `JaxbaError` where no file can be written, before the work that leads to it.

    >>> refuse_unwritable("tile.npz")
    """
    _refuse_what_is_no_file(path)
    folder = os.path.dirname(os.path.realpath(path))
    if not os.path.isdir(folder):
        raise cannot_write(path, OSError(errno.ENOENT, ""))
    if not os.access(folder, os.W_OK | os.X_OK):
        raise cannot_write(path, OSError(errno.EACCES, ""))


def _refuse_what_is_no_file(path: str | os.PathLike[str]) -> None:
    label, target = os.fspath(path), os.path.realpath(path)
    if os.path.isdir(target):
        raise JaxbaError(f"{label}: not written, it is a folder: add a file name.")
    if os.path.exists(target) and not os.path.isfile(target):
        raise JaxbaError(f"{label}: not written, it is a device or a pipe: choose the name of a file.")


@contextlib.contextmanager
def _beside(path: str | os.PathLike[str]) -> Iterator[Path]:
    """Yield a name in the same folder; where the block fails, nothing is left there, and an `OSError` is said."""
    temporary = Path(os.path.realpath(path)).with_name(f".jaxba-{secrets.token_hex(8)}{_PARTIAL}")
    try:
        yield temporary
    except BaseException as error:
        _remove(temporary)
        if isinstance(error, OSError):
            raise cannot_write(path, error) from error
        raise


def remove_leftovers(folder: Path) -> None:
    """Remove what a process that was killed while it wrote left in a folder; no other process may be writing there."""
    for place in folder.glob(".*"):
        if place.name.endswith((_PARTIAL, _OLD)):
            _remove(place)


def _remove(place: Path) -> None:
    with contextlib.suppress(OSError):
        shutil.rmtree(place, ignore_errors=True) if place.is_dir() else place.unlink(missing_ok=True)


def cannot_write(path: str | os.PathLike[str], error: OSError) -> JaxbaError:
    """Return the error that says why a file or folder could not be written, and what to do.

    >>> print(cannot_write("points.txt", OSError(errno.ENAMETOOLONG, "")))
    points.txt: not written, File name too long: choose a shorter name.
    """
    reason = os.strerror(error.errno) if error.errno else str(error)
    return JaxbaError(f"{os.fspath(path)}: not written, {reason}: {_CURES.get(error.errno or 0, _ELSEWHERE)}.")


def refuse_same_file(input_path: str | os.PathLike[str], output_path: str | os.PathLike[str]) -> None:
    """Raise a `JaxbaError` where an output is the input itself, also by another name or through a link.

    >>> refuse_same_file("tile.npz", "tile.solved.npz")
    """
    same = os.path.realpath(input_path) == os.path.realpath(output_path)
    if not same and os.path.exists(input_path) and os.path.exists(output_path):
        same = os.path.samefile(input_path, output_path)
    if same:
        raise JaxbaError(
            f"{os.fspath(output_path)}: the output is the input {os.fspath(input_path)}, which is never overwritten; "
            "choose another name (--out)."
        )
