"""`jaxba config`: every parameter with its default, range and meaning; and where a run's settings come from."""

import sys
from pathlib import Path

from jaxba.cli._text import to_json, wrapped
from jaxba.engine import Settings, explained, from_toml, to_toml
from jaxba.pipeline import PIPELINE

FILE = Path("jaxba.toml")
_NAME_WIDTH = 30


def tell_settings(file: Path | None, *, explain: bool, as_json: bool) -> int:
    """Print the settings of a file, or the defaults, as a jaxba.toml; with `explain` a row a parameter."""
    settings = configured(file, quiet=True)
    if as_json:
        columns = ("name", "default", "allowed", "meaning")
        print(to_json({"parameters": [dict(zip(columns, row, strict=True)) for row in explained(settings)]}))
    elif explain:
        for name, default, range_, meaning in explained(settings):
            print(wrapped(name, f"{default}" + (f" ({range_})" if range_ else "") + f": {meaning}", _NAME_WIDTH))
    else:
        print(to_toml(settings, explain=True), end="")
    return 0


def configured(file: Path | None, *, quiet: bool) -> Settings:
    """Return the settings of a file, of `jaxba.toml` in the working folder where none is given, or the defaults."""
    settings = PIPELINE.settings
    if file is None and not FILE.is_file():
        return settings
    if file is None and not quiet:
        print(f"settings are those of {FILE.absolute()}", file=sys.stderr)
    return from_toml(file or FILE, settings)
