"""Commands on a project that is there: `status`, `verify`, `diagnose`, `report`; each tells what `jaxba.report` finds.

All three list the findings of the adjustment, as the run itself does.
"""

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from jaxba.cli._text import labelled, many, to_json, wrapped
from jaxba.engine import changed, from_toml
from jaxba.pipeline import PIPELINE
from jaxba.report import Status, is_to_act_on, project_settings, recorded, sentences, status
from jaxba.report.diagnosis import diagnoses
from jaxba.report.verification import Params, exported_findings, verify

_SHOWN = 10
_STATUS_LABEL = 10
_CHECK_LABEL = 9
_DIAGNOSIS_LABEL = 8
_FINDINGS_LABEL = 10
_REPORT_LABEL = 8


def make_report(project: Path, *, show: bool, as_json: bool) -> int:
    """Write the report of a project, say what it comes to and where it lies; return 0."""
    from jaxba.report.document import write_report

    page, facts = write_report(project, PIPELINE)
    if as_json:
        print(to_json(facts))
    else:
        _print_report(page, facts)
    if show:
        import webbrowser

        webbrowser.open(page.absolute().as_uri())
    return 0


def _print_report(page: Path, facts: dict[str, Any]) -> None:
    rows = [("state", facts["project"]["reason"])] if facts["project"]["reason"] else []
    rows.append((facts["verdict"]["state"], facts["verdict"]["text"]))
    rows += [(light["state"], f"{light['name']}: {light['value']}") for light in facts["quality"] if light["value"]]
    for label, text in (*rows, ("report", str(page))):
        print(wrapped(label, text, _REPORT_LABEL))


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
        "pairs": found.num_pairs,
        "rejected_pairs": [dataclasses.asdict(left) for left in found.rejected],
        "findings": sentences(found.findings),
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
        rows.append(
            (
                "pairs",
                f"{found.num_pairs - len(found.rejected)} of {many(found.num_pairs, 'candidate pair')} became edges; "
                "the others are mostly photos that do not overlap (--json names them)",
            )
        )
    rows += [("run", found.activity)] if found.activity else []
    if not found.left_out and not found.activity and found.is_done:
        rows.insert(0, ("all", "every photo is in use"))
    rows += labelled("findings", sentences(found.findings))
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
    findings = sentences(exported_findings(project, PIPELINE))
    if as_json:
        facts = {"passed": not bad, "checks": [dataclasses.asdict(check) for check in checks], "findings": findings}
        print(to_json(facts))
        return 1 if bad else 0
    for check in checks:
        print(wrapped(check.state, f"{check.name}: {check.text}", _CHECK_LABEL))
    print()
    for label, text in labelled("findings", findings):  # of the block: they do not fail its files
        print(wrapped(label, text, _FINDINGS_LABEL))
    print(end="\n" if findings else "")
    if bad:
        print(f"{len(bad)} of {many(len(checks), 'check')} failed: {', '.join(check.name for check in bad)}")
        return 1
    skipped = sum(check.state == "skipped" for check in checks)
    print(f"passed: {many(len(checks) - skipped, 'check')}" + (f", {skipped} skipped" if skipped else ""))
    return 0


def tell_diagnoses(project: Path, *, as_json: bool) -> int:
    """Print the findings of the adjustment and each diagnosis; return 1 where any is to be acted on, else 0."""
    case = recorded(project, PIPELINE)
    found, findings = diagnoses(case), sentences(case.findings)
    code = 1 if found or any(map(is_to_act_on, case.findings)) else 0
    if as_json:
        facts = {"findings": findings, "diagnoses": [dataclasses.asdict(diagnosis) for diagnosis in found]}
        print(to_json(facts))
        return code
    for label, text in labelled("findings", findings):
        print(wrapped(label, text, _FINDINGS_LABEL))
    for diagnosis in found:
        print(diagnosis.name)
        print(wrapped("  cause", diagnosis.cause, _DIAGNOSIS_LABEL))
        print(wrapped("  cure", diagnosis.cure, _DIAGNOSIS_LABEL))
    if not code:
        print("nothing is to be acted on" if findings else "nothing looks poor")
    return code
