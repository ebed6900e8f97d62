"""Problems from files of any format that jaxba reads."""

import os

from jaxba.ba import Problem
from jaxba.io._bal import bal_of_bytes
from jaxba.io._npz import ZIP_MAGIC
from jaxba.io._read import read_bytes
from jaxba.io._tile import Contents, tile_of_bytes


def read_problem(path: str | os.PathLike[str]) -> Problem:
    """Return the problem in a `tile.npz` or a BAL file, plain or bz2, told apart by content, not by name.

    Raises:
        JaxbaError: the file is missing, damaged or of neither format.

    >>> import pathlib, tempfile
    >>> path = pathlib.Path(tempfile.mkdtemp(), "problem.dat")
    >>> _ = path.write_text("1 1 1  0 0 3 -4  0 0 0  0 0 0  100 0 0  0 0 -10")
    >>> read_problem(path).num_observations
    1
    """
    return problem_of_bytes(read_bytes(path), os.fspath(path)).problem


def problem_of_bytes(data: bytes, label: str) -> Contents:
    """Return what the bytes of a file of any format hold.

    `label` names the file in messages. Raises `JaxbaError` as `read_problem` does.
    """
    if data.startswith(ZIP_MAGIC):
        return tile_of_bytes(data, label)
    return Contents(bal_of_bytes(data, label))
