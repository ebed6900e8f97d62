"""A measurement that only describes costs nothing where it fails, and what it costs otherwise is said."""

import logging

import pytest

from jaxba import JaxbaError
from jaxba.scene import described


def raising(error: BaseException) -> None:
    raise error


@pytest.mark.parametrize(
    "error", [ValueError("zero-size array\nto reduction"), IndexError("7"), ZeroDivisionError(), AssertionError("odd")]
)
def test_a_failure_is_noted_and_logged_and_the_default_stands(error: Exception, caplog: pytest.LogCaptureFixture):
    with caplog.at_level(logging.INFO, "jaxba"):
        value, (note,) = described("texture", lambda: raising(error), "default")
    assert value == "default"
    words = " ".join(f"{type(error).__name__}: {error}".split())
    assert note.startswith(f"texture could not be measured, by a fault of jaxba and not of the input ({words})")
    assert note.endswith("please report it; the work goes on without it")
    (record,) = caplog.records
    assert record.exc_info is not None and record.exc_info[1] is error


@pytest.mark.parametrize(
    "error", [JaxbaError("wrong list"), MemoryError(), OSError(12, "no memory"), KeyboardInterrupt()]
)
def test_what_is_no_fault_of_the_measurement_is_raised(error: BaseException):
    with pytest.raises(type(error)):
        described("texture", lambda: raising(error), None)
