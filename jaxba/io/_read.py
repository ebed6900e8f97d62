"""The bytes and the text of an input file, or an error that says why there are none."""

import codecs
import os

from jaxba._errors import JaxbaError


def read_bytes(path: str | os.PathLike[str]) -> bytes:
    """Return the content of a file that is not empty.

    Raises:
        JaxbaError: not found, a folder, not readable, or empty.
    """
    label = os.fspath(path)
    if os.path.isdir(path):
        raise JaxbaError(f"{label}: is a folder; give a file in it.")
    try:
        with open(path, "rb") as file:
            data = file.read()
    except FileNotFoundError as error:
        raise JaxbaError(f"{label}: no such file in {os.getcwd()}; check the path.") from error
    except OSError as error:
        raise JaxbaError(f"{label}: cannot be read, {error.strerror}; check the path and its permissions.") from error
    if not data:
        raise JaxbaError(f"{label}: is empty; write or copy it again.")
    return data


def text_of(data: bytes, errors: str = "strict") -> str:
    """Return the text of a file in UTF-8, or in UTF-16 where its byte order mark says so, without that mark.

    Raises:
        UnicodeDecodeError: with `errors` at `strict`, the bytes are no such text.

    >>> text_of("a".encode("utf-8-sig")), text_of("b".encode("utf-16"))
    ('a', 'b')
    """
    if data.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        return data.decode("utf-16", errors)
    return data.decode("utf-8-sig", errors)
