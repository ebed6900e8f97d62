"""What looks poor in a project, the likely cause with its figures, and the cure."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

_SHOWN = 5


@dataclass(frozen=True, kw_only=True)
class Diagnosis:
    """One finding.

    - `name`: of the rule. `cause`: what looks poor and why, with the figures, in sentences. `cure`: what to do.
    - `figures`: by name, for programs.
    """

    name: str
    cause: str
    cure: str
    figures: Mapping[str, object] = field(default_factory=dict)


def some(names: Sequence[str], most: int = _SHOWN) -> str:
    """Return the first few names, and how many more there are."""
    more = f" and {len(names) - most} more" if len(names) > most else ""
    return ", ".join(names[:most]) + more
