"""`jaxba verify`: each check of a project's exports with its figure."""

import dataclasses
from collections.abc import Sequence
from pathlib import Path

from jaxba.cli._text import many, to_json, wrapped
from jaxba.engine import changed, from_toml
from jaxba.pipeline import PIPELINE
from jaxba.report import project_settings
from jaxba.report.verification import Params, verify

_LABEL = 9


def run(project: Path, *, config: Path | None, changes: Sequence[str], as_json: bool) -> int:
    """Print the checks; return 0 where none fails, else 1."""
    settings = project_settings(project, PIPELINE)
    if config is not None:
        settings = from_toml(config, settings)
    params = changed(settings, changes)["verify"]
    assert isinstance(params, Params)
    checks = verify(project, PIPELINE, params)
    bad = [check for check in checks if check.state == "FAIL"]
    if as_json:
        print(to_json({"passed": not bad, "checks": [dataclasses.asdict(check) for check in checks]}))
        return 1 if bad else 0
    for check in checks:
        print(wrapped(check.state, f"{check.name}: {check.text}", _LABEL))
    print()
    if bad:
        print(f"{len(bad)} of {many(len(checks), 'check')} failed: {', '.join(check.name for check in bad)}")
        return 1
    skipped = sum(check.state == "skipped" for check in checks)
    print(f"passed: {many(len(checks) - skipped, 'check')}" + (f", {skipped} skipped" if skipped else ""))
    return 0
