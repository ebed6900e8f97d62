"""`jaxba status`: how a project stands, stage by stage, and what failed."""

import dataclasses
from collections.abc import Sequence
from pathlib import Path

from jaxba.cli._text import to_json, wrapped
from jaxba.engine import changed, from_toml
from jaxba.pipeline import PIPELINE
from jaxba.report import Status, project_settings, status

_SHOWN = 10
_LABEL = 10


def run(project: Path, *, config: Path | None, changes: Sequence[str], as_json: bool) -> int:
    """Print how the project stands; return 0 where all is done, else 1."""
    settings = project_settings(project, PIPELINE)
    if config is not None:
        settings = from_toml(config, settings)
    found = status(project, PIPELINE, changed(settings, changes))
    if as_json:
        print(to_json(_facts(found)))
    else:
        _print(found)
    return 0 if found.is_done else 1


def _facts(found: Status) -> dict[str, object]:
    return {
        "done": found.is_done,
        "activity": found.activity,
        "stages": [dataclasses.asdict(standing) for standing in found.stages],
        "left_out": [{"stage": stage, **dataclasses.asdict(left)} for stage, left in found.left_out],
        "rejected_pairs": [dataclasses.asdict(left) for left in found.rejected],
    }


def _print(found: Status) -> None:
    for standing in found.stages:
        count = f", {standing.num_done} of {standing.num_all} photos" if standing.num_all > 1 else ""
        reason = standing.reason if standing.state == "waits" else f"{standing.state}{count}"
        if standing.reason and standing.state not in ("waits", "not done"):
            reason += f": {standing.reason}"
        print(wrapped(standing.stage, reason, _LABEL))
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
        print(wrapped(label, text, _LABEL))
