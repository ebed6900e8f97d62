"""What a check of the exports found."""

from dataclasses import dataclass
from typing import Literal


@dataclass(frozen=True, kw_only=True)
class Check:
    """One check.

    - `state`: `skipped` where there is nothing that could be checked.
    - `text`: the figure; where it failed, the file, the field, the value and the cure; where skipped, why.
    """

    name: str
    state: Literal["ok", "FAIL", "skipped"]
    text: str


def ok(name: str, text: str) -> Check:
    return Check(name=name, state="ok", text=text)


def failed(name: str, text: str) -> Check:
    return Check(name=name, state="FAIL", text=text)


def skipped(name: str, text: str) -> Check:
    return Check(name=name, state="skipped", text=text)


def judged(name: str, is_good: bool, good: str, bad: str) -> Check:
    """Return the check that found this or that."""
    return ok(name, good) if is_good else failed(name, bad)
