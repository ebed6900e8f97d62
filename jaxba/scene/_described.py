"""What merely describes a photo, a pair or a block: where measuring it fails, the work goes on without it, and says so.

An exception in such a measurement is a fault of this program. It must not cost a photo or a block, and it must not pass
in silence: it is logged with its traceback, and the caller gets a sentence to record beside the photo, pair or block.
"""

import errno
import logging
import traceback
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

from jaxba._errors import JaxbaError

T = TypeVar("T")
_OPENCV_NO_MEMORY = -4
_HOME = Path(__file__).parents[1]
_log = logging.getLogger(__name__)


def described(what: str, measure: Callable[[], T], default: T) -> tuple[T, tuple[str, ...]]:
    """Return what `measure` returns and no note; where it fails, the default and one note.

    - `what`: is measured, as the subject of a sentence.

    What is no fault of the measurement is raised: a `JaxbaError`, and a lack of memory.

    >>> described("the smallest", lambda: min([3, 2]), None)
    (2, ())
    >>> described("the smallest", lambda: min([]), None)[1][0][:54]
    'the smallest could not be measured, by a fault of jaxb'
    """
    try:
        return measure(), ()
    except JaxbaError:
        raise
    except Exception as error:  # whatever it is, it only describes
        if lacks_memory(error):
            raise
        _log.info("%s could not be measured", what, exc_info=True)
        return default, (f"{what} could not be measured, {fault(error)}; the work goes on without it",)


def lacks_memory(error: BaseException) -> bool:
    """Whether an exception says that there is not memory enough."""
    if type(error).__module__ == "cv2":
        return getattr(error, "code", 0) == _OPENCV_NO_MEMORY or "bad_alloc" in str(error)
    return isinstance(error, MemoryError) or (isinstance(error, OSError) and error.errno == errno.ENOMEM)


def fault(error: BaseException) -> str:
    """Return in words that an exception is a fault of this program, with the place where it came up.

    >>> fault(ValueError("zero-size array"))
    'by a fault of jaxba and not of the input (ValueError: zero-size array); please report it'
    """
    paths = [(Path(frame.filename), frame.lineno) for frame in traceback.extract_tb(error.__traceback__)]
    own = [(path, line) for path, line in paths if _HOME in path.parents and path != Path(__file__)]
    place = f" in {own[-1][0].name} line {own[-1][1]}" if own else ""
    words = " ".join(f"{type(error).__name__}: {error}".split())
    return f"by a fault of jaxba and not of the input ({words}{place}); please report it"
