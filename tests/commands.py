"""Commands called in this process, as tests of the command line do it."""

from collections.abc import Callable

import pytest

from jaxba.cli import main

Answer = tuple[int, str, str]
Cli = Callable[..., Answer]


def caller(capsys: pytest.CaptureFixture[str]) -> Cli:
    """Return a function that runs a command and returns its exit code, standard output and standard error."""

    def call(*arguments: object) -> Answer:
        with pytest.raises(SystemExit) as stop:
            main([str(argument) for argument in arguments])
        out, err = capsys.readouterr()
        return stop.value.code if isinstance(stop.value.code, int) else int(stop.value.code is not None), out, err

    return call
