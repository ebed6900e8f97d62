"""Named arrays in an npz file: plain numpy arrays, no pickles, and the same bytes for the same arrays.

An npz is a zip of `.npy` files. Here each member is stored (not deflated), dated 1980 and in C order, so the bytes
depend on nothing but names, order and values; `numpy.savez` writes the host's system into the zip and keeps an array's
memory order. Stored, because deflate saves little on measured coordinates: 500 images, 33k points, 124k observations
take 6 ms to write, 3 ms to read and 4.8 MB; deflated 120 ms, 14 ms and 3.0 MB, in bytes that vary with the zlib in use.
"""

import io
import zipfile
import zlib
from collections.abc import Mapping
from typing import BinaryIO

import numpy as np

from jaxba._errors import JaxbaError

ZIP_MAGIC = b"PK"
_UNIX = 3  # written as the zip's host system everywhere
_END_SIZE, _END_COUNT = 22, 10  # of a zip's last record: its bytes, and where in it the count of members stands
_COUNT_IS_ELSEWHERE = 0xFFFF  # in the record of a zip of more than 4 GB
_DAMAGE = (zipfile.BadZipFile, zlib.error, OSError, EOFError, RuntimeError, MemoryError, SyntaxError)


def write_npz(file: BinaryIO, arrays: Mapping[str, np.ndarray]) -> None:
    """Write arrays, in the mapping's order, to an open file.

    Raises:
        ValueError: an array of Python objects.
    """
    with zipfile.ZipFile(file, "w", zipfile.ZIP_STORED) as archive:
        for name, array in arrays.items():
            member = zipfile.ZipInfo(f"{name}.npy")
            member.create_system = _UNIX
            with archive.open(member, "w", force_zip64=True) as stream:
                np.lib.format.write_array(stream, np.asarray(array, order="C"), allow_pickle=False)


def read_npz(data: bytes, label: str) -> dict[str, np.ndarray]:
    """Return the arrays in the bytes of an npz file; `label` names it in messages.

    Raises:
        JaxbaError: not a zip, truncated, damaged, a member that is no array, an array of Python objects.
    """
    if not data.startswith(ZIP_MAGIC):
        raise JaxbaError(f"{label}: is not an npz file, it begins with {data[:8]!r}; write it with numpy.savez.")
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            members = archive.infolist()
            end = len(data) - len(archive.comment) - _END_SIZE
            count = int.from_bytes(data[end + _END_COUNT : end + _END_COUNT + 2], "little")
            if count not in (len(members), _COUNT_IS_ELSEWHERE):  # zipfile would return fewer members in silence
                raise zipfile.BadZipFile(f"{len(members)} of {count} arrays found")
            return {info.filename.removesuffix(".npy"): _array(archive, info, label) for info in members}
    except (*_DAMAGE, ValueError) as error:
        if isinstance(error, JaxbaError):
            raise
        raise JaxbaError(f"{label}: is truncated or damaged ({error}); write or copy it again.") from error


def _array(archive: zipfile.ZipFile, info: zipfile.ZipInfo, label: str) -> np.ndarray:
    content = archive.read(info)  # checks the member's CRC
    if not content.startswith(np.lib.format.MAGIC_PREFIX):
        raise JaxbaError(f"{label}: {info.filename!r} is not a numpy array; write the file with numpy.savez.")
    try:
        return np.lib.format.read_array(io.BytesIO(content), allow_pickle=False)
    except (ValueError, *_DAMAGE) as error:
        raise JaxbaError(
            f"{label}: array {info.filename.removesuffix('.npy')!r} cannot be read ({error}); "
            "write numbers, booleans or unicode strings, not Python objects."
        ) from error
