"""Files that appear whole or not at all, and inputs that are never overwritten.

A file is written under a temporary name in the folder of its target, flushed to the disk, and renamed: a rename within
a folder replaces a file in one step, so a reader sees the old file or the new one, never a part. Whatever goes wrong
before that (a full disk, an interrupt) leaves the old file as it was and removes the temporary one.
"""

import contextlib
import errno
import os
import secrets
from collections.abc import Iterator
from typing import BinaryIO

from jaxba._errors import JaxbaError

_DENIED = "the folder may not be written to: choose another place, or change its permissions"
_FULL = "free some space, or choose another disk"
_CURES = {
    errno.ENOENT: "create the folder first, or choose another place",
    errno.ENOTDIR: "a part of the path is a file: choose another place",
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
    label, target = os.fspath(path), os.path.realpath(path)
    if os.path.isdir(target):
        raise JaxbaError(f"{label}: not written, it is a folder: add a file name.")
    if os.path.exists(target) and not os.path.isfile(target):
        raise JaxbaError(f"{label}: not written, it is a device or a pipe: choose the name of a file.")
    temporary = os.path.join(os.path.dirname(target), f".jaxba-{secrets.token_hex(8)}.tmp")
    try:
        with open(temporary, "xb") as file:
            yield file
            file.flush()
            os.fsync(file.fileno())
        os.replace(temporary, target)
    except BaseException as error:
        with contextlib.suppress(OSError):
            os.unlink(temporary)
        if isinstance(error, OSError):
            reason = os.strerror(error.errno) if error.errno else str(error)
            cure = _CURES.get(error.errno or 0, "choose another place")
            raise JaxbaError(f"{label}: not written, {reason}: {cure}.") from error
        raise


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
