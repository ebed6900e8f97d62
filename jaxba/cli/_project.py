"""Commands on a project that is there: `status`, `verify`, `diagnose`; each prints what `jaxba.report` finds."""

import dataclasses
from collections.abc import Sequence
from pathlib import Path

from jaxba.cli._text import many, to_json, wrapped
from jaxba.engine import changed, from_toml
from jaxba.pipeline import PIPELINE
from jaxba.report import Status, project_settings, status
from jaxba.report.diagnosis import diagnose
from jaxba.report.verification import Params, verify

_SHOWN = 10
_STATUS_LABEL = 10
_CHECK_LABEL = 9
_DIAGNOSIS_LABEL = 8


def tell_status(project: Path, *, config: Path | None, changes: Sequence[str], as_json: bool) -> int:
    """Print how the project stands; return 0 where all is done, else 1."""
    settings = project_settings(project, PIPELINE)
    if config is not None:
        settings = from_toml(config, settings)
    found = status(project, PIPELINE, changed(settings, changes))
    if as_json:
        print(to_json(_status_facts(found)))
    else:
        _print_status(found)
    return 0 if found.is_done else 1


def _status_facts(found: Status) -> dict[str, object]:
    return {
        "done": found.is_done,
        "activity": found.activity,
        "stages": [dataclasses.asdict(standing) for standing in found.stages],
        "left_out": [{"stage": stage, **dataclasses.asdict(left)} for stage, left in found.left_out],
        "rejected_pairs": [dataclasses.asdict(left) for left in found.rejected],
    }


def _print_status(found: Status) -> None:
    for standing in found.stages:
        count = f", {standing.num_done} of {standing.num_all} photos" if standing.num_all > 1 else ""
        reason = standing.reason if standing.state == "waits" else f"{standing.state}{count}"
        if standing.reason and standing.state not in ("waits", "not done"):
            reason += f": {standing.reason}"
        print(wrapped(standing.stage, reason, _STATUS_LABEL))
    rows = [("left out", f"{left.name}: {left.reason}") for _, left in found.left_out[:_SHOWN]]
    if len(found.left_out) > _SHOWN:
        rows.append(("", f"and {len(found.left_out) - _SHOWN} more files; --json has all"))
    if found.rejected:
        names = "; ".join(f"{left.name} ({left.reason.split(',')[0]})" for left in found.rejected[:_SHOWN])
        more = f"; and {len(found.rejected) - _SHOWN} more, see --json" if len(found.rejected) > _SHOWN else ""
        rows.append(("rejected", f"{len(found.rejected)} pairs without an edge: {names}{more}"))
    rows += [("run", found.activity)] if found.activity else []
    if not rows and found.is_done:
        rows = [("all", "every photo is in use, and every pair")]
    print(end="\n" if rows else "")
    for label, text in rows:
        print(wrapped(label, text, _STATUS_LABEL))


def tell_checks(project: Path, *, config: Path | None, changes: Sequence[str], as_json: bool) -> int:
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
        print(wrapped(check.state, f"{check.name}: {check.text}", _CHECK_LABEL))
    print()
    if bad:
        print(f"{len(bad)} of {many(len(checks), 'check')} failed: {', '.join(check.name for check in bad)}")
        return 1
    skipped = sum(check.state == "skipped" for check in checks)
    print(f"passed: {many(len(checks) - skipped, 'check')}" + (f", {skipped} skipped" if skipped else ""))
    return 0


def tell_diagnoses(project: Path, *, as_json: bool) -> int:
    """Print each diagnosis; return 0."""
    found = diagnose(project, PIPELINE)
    if as_json:
        print(to_json({"diagnoses": [dataclasses.asdict(diagnosis) for diagnosis in found]}))
        return 0
    for diagnosis in found:
        print(diagnosis.name)
        print(wrapped("  cause", diagnosis.cause, _DIAGNOSIS_LABEL))
        print(wrapped("  cure", diagnosis.cure, _DIAGNOSIS_LABEL))
    if not found:
        print("nothing looks poor")
    return 0
