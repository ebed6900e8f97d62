"""Settings of a run: the parameters of every stage, from their defaults and `stage.name=value` texts."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, fields, replace
from difflib import get_close_matches

from jaxba._errors import JaxbaError
from jaxba.pipeline._parameters import Parameters, parse
from jaxba.pipeline._stages import NAMES, STAGES

Settings = Mapping[str, Parameters]
"""Parameters by stage."""


def default_settings() -> dict[str, Parameters]:
    """Return every stage's defaults."""
    return {stage.name: stage.module.Params() for stage in STAGES}


def changed(settings: Settings, changes: Sequence[str]) -> dict[str, Parameters]:
    """Return the settings with changes such as `match.ratio=0.7`; an unknown name is an error that lists the known.

    >>> changed(default_settings(), ["match.ratio=0.7"])["match"].ratio
    0.7
    """
    result = dict(settings)
    for text in changes:
        key, equals, value = text.partition("=")
        stage, dot, name = key.strip().partition(".")
        if not equals or not dot:
            raise JaxbaError(f"--set {text}: write stage.name=value, such as match.ratio=0.7.")
        if stage not in result:
            raise JaxbaError(f"--set {text}: no stage {stage!r}; the stages are {', '.join(NAMES)}.")
        known = [field.name for field in fields(result[stage])]
        if name not in known:
            close = get_close_matches(name, known, 1)
            hint = f"did you mean {close[0]}? " if close else ""
            names = ", ".join(known) if known else "none"
            raise JaxbaError(f"--set {text}: {hint}The parameters of {stage} are {names}.")
        result[stage] = replace(result[stage], **{name: parse(type(result[stage]), name, value.strip())})
    return result


def as_plain(settings: Settings) -> dict[str, dict[str, object]]:
    """Return the settings as plain values, for JSON."""
    return {stage: asdict(params) for stage, params in settings.items()}
