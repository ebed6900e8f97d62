"""Keys: what a result was made from, in parts, so that what changed since can be told."""

import dataclasses
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from typing import Any

from jaxba.engine._fingerprint import code_version, fingerprint, packages
from jaxba.engine._parameters import Parameters, stage_name
from jaxba.engine._versions import versions_of

_NAMED = 3


@dataclass(frozen=True)
class Key:
    """What a result was made from: equal keys, equal results.

    - `code`: fingerprint of the stage's source and all that it imports of jaxba. `params`: values by name.
    - `inputs`: fingerprint of each input by name. `versions`: of the packages that compute in the stage.
    """

    code: str
    params: Mapping[str, Any]
    inputs: Mapping[str, str]
    versions: Mapping[str, str] = field(default_factory=dict)

    @staticmethod
    def of(module: str, params: Parameters, inputs: Mapping[str, Any]) -> "Key":
        """Return the key of a stage's module for these parameters and inputs."""
        prints = {name: fingerprint(value) for name, value in inputs.items()}
        return Key(code_version(module), asdict(params), prints, versions_of(packages(module)))


def by_field(inputs: Any) -> dict[str, Any]:
    """Return the fields of a dataclass by name."""
    return {field.name: getattr(inputs, field.name) for field in dataclasses.fields(inputs)}


def what_changed(before: Key, now: Key, params: Parameters) -> str:
    """Return in words why a result is stale; `params` are those of now.

    >>> from jaxba.pipeline.tracks import Params
    >>> old, new = Key("a", {"require_connected": False}, {}), Key("a", {"require_connected": True}, {})
    >>> what_changed(old, new, Params(require_connected=True))
    'tracks.require_connected was false and is true'
    """
    stage, reasons = stage_name(type(params)), []
    if before.code != now.code:
        reasons.append("jaxba's code changed")
    for name in sorted({*before.versions, *now.versions}):
        was, version = before.versions.get(name, "not there"), now.versions.get(name, "not there")
        if was != version:
            reasons.append(f"{name} was {was} and is {version}")
    for name, value in now.params.items():
        if name not in before.params:
            reasons.append(f"{stage}.{name} is new")
        elif before.params[name] != value:
            reasons.append(f"{stage}.{name} was {plain(before.params[name])} and is {plain(value)}")
    other = sorted(name for name, value in now.inputs.items() if before.inputs.get(name) != value)
    if other:
        shown = ", ".join(other[:_NAMED]) + (f" and {len(other) - _NAMED} more" if len(other) > _NAMED else "")
        reasons.append(f"changed: {shown}")
    return "; ".join(reasons) or "its parameters are others"


def plain(value: Any) -> str:
    """Return a parameter's value as it is written on the command line."""
    if value is None or isinstance(value, bool):
        return str(value).lower()
    return f"{value:.15g}" if isinstance(value, float) else str(value)
