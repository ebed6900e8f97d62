"""Settings of a run: the parameters of every stage, and of what supervises and checks them.

They come from their defaults, then from a `jaxba.toml` with a table a section, then from `section.name=value` texts:

    [match]
    ratio = 0.7

A section or a name that does not exist, and a value out of its range, are errors that list what is allowed. TOML has no
word for nothing: a parameter that may be `none` takes the text "none".
"""

import json
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import Field, fields, replace
from difflib import get_close_matches
from pathlib import Path
from typing import Any

from jaxba._errors import JaxbaError
from jaxba.engine._key import plain
from jaxba.engine._parameters import Parameters, allowed, taken
from jaxba.io import text_of

Settings = Mapping[str, Parameters]
"""Parameters by section."""


def changed(settings: Settings, changes: Sequence[str]) -> dict[str, Parameters]:
    """Return the settings with changes such as `match.ratio=0.7`.

    >>> from jaxba.engine import Resources
    >>> changed({"workers": Resources()}, ["workers.workers=2"])["workers"].workers
    2
    """
    result = dict(settings)
    for text in changes:
        key, equals, value = text.partition("=")
        section, dot, name = key.strip().partition(".")
        if not equals or not dot:
            raise JaxbaError(f"--set {text}: write section.name=value, such as match.ratio=0.7.")
        _set(result, section, name, value.strip())
    return result


def from_toml(path: Path, settings: Settings) -> dict[str, Parameters]:
    """Return the settings with those of a TOML file."""
    try:
        tables = tomllib.loads(text_of(path.read_bytes()))
    except FileNotFoundError:
        raise JaxbaError(f"{path}: there is no such file; `jaxba config` prints one to begin with.") from None
    except (OSError, UnicodeDecodeError) as error:
        raise JaxbaError(f"{path}: cannot be read as text ({error}).") from error
    except tomllib.TOMLDecodeError as error:
        raise JaxbaError(
            f"{path}: is not valid TOML ({error}); write tables such as [match] and lines ratio = 0.7."
        ) from None
    try:
        return set_from_tables(settings, tables)
    except JaxbaError as error:
        raise JaxbaError(f"{path}: {error}") from None


def set_from_tables(settings: Settings, tables: Mapping[str, Any]) -> dict[str, Parameters]:
    """Return the settings with those of the tables of a TOML file."""
    result = dict(settings)
    for section, table in tables.items():
        if section not in result or not isinstance(table, dict):
            raise _unknown_section(section, result)
        for name, value in table.items():
            _set(result, section, name, value)
    return result


def to_toml(settings: Settings, *, explain: bool = False) -> str:
    """Return settings as TOML that `from_toml` takes; with `explain` each has its default, range and meaning."""
    lines = []
    for section, params in settings.items():
        lines += ["", f"[{section}]"] if lines else [f"[{section}]"]
        for field in fields(params):
            if explain:
                lines.append(f"# {_explained(field)}")
            lines.append(f"{field.name} = {_toml_value(getattr(params, field.name))}")
    return "\n".join([*lines, ""])


def explained(settings: Settings) -> list[tuple[str, str, str, str]]:
    """Return a row a parameter: `section.name`, its default, what it may be, its meaning."""
    return [
        (f"{section}.{field.name}", plain(field.default), allowed(field), field.metadata["help"])
        for section, params in settings.items()
        for field in fields(params)
    ]


def _explained(field: Field) -> str:
    known = "; ".join(filter(None, (f"default {plain(field.default)}", allowed(field))))
    return f"{field.metadata['help']} ({known})"


def _toml_value(value: Any) -> str:
    if value is None or isinstance(value, str):
        # JSON's escapes are TOML's but for DEL
        return json.dumps("none" if value is None else value, ensure_ascii=False).replace("\x7f", "\\u007f")
    return plain(value) if isinstance(value, bool) else repr(value)


def _set(settings: dict[str, Parameters], section: str, name: str, value: Any) -> None:
    """Set one parameter to a value, or to what a text means."""
    if section not in settings:
        raise _unknown_section(section, settings)
    params = settings[section]
    known = [field.name for field in fields(params)]
    if name not in known:
        names = f"the parameters of {section} are {', '.join(known)}." if known else f"{section} has none."
        raise JaxbaError(f"no parameter {section}.{name}; {_close(name, known)}{names}")
    settings[section] = replace(params, **{name: taken(type(params), name, value)})


def _unknown_section(section: str, settings: Settings) -> JaxbaError:
    close = _close(section, list(settings))
    return JaxbaError(f"no section {section!r}; {close}the sections, each a table in TOML, are {', '.join(settings)}.")


def _close(name: str, known: Sequence[str]) -> str:
    close = get_close_matches(name, known, 1)
    return f"did you mean {close[0]}? " if close else ""
