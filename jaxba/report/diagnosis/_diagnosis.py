"""What looks poor in a project, the likely cause with its figures, and the cure."""

from collections.abc import Mapping
from dataclasses import dataclass, field


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
