"""`jaxba diagnose`: what looks poor in a project, why, and what to do."""

import dataclasses
from pathlib import Path

from jaxba.cli._text import to_json, wrapped
from jaxba.pipeline import PIPELINE
from jaxba.report.diagnosis import diagnose

_LABEL = 8


def run(project: Path, *, as_json: bool) -> int:
    """Print each diagnosis; return 0."""
    found = diagnose(project, PIPELINE)
    if as_json:
        print(to_json({"diagnoses": [dataclasses.asdict(diagnosis) for diagnosis in found]}))
        return 0
    for diagnosis in found:
        print(diagnosis.name)
        print(wrapped("  cause", diagnosis.cause, _LABEL))
        print(wrapped("  cure", diagnosis.cure, _LABEL))
    if not found:
        print("nothing looks poor")
    return 0
