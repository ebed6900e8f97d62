"""A finding: what should be known of a result, as a kind and its figures; `jaxba.report` has the words for it."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True, kw_only=True)
class Finding:
    """What a surveyor should know of an adjusted block.

    - `kind`: which finding it is. `figures`: plain values by name, which its words are made of; no arrays.
    """

    kind: str
    figures: Mapping[str, Any]

    @staticmethod
    def of(kind: str, **figures: Any) -> "Finding":
        """Return a finding from its figures as arguments."""
        return Finding(kind=kind, figures=figures)
