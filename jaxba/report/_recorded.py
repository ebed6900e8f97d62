"""What the stages of a project have recorded, also of a run that stopped or was killed; nothing is run or changed."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from jaxba.engine import _store
from jaxba.engine._lock import holder
from jaxba.engine._project import SETTINGS, SUMMARY, Project, read_lists
from jaxba.engine._settings import from_toml
from jaxba.engine._stage import Pipeline
from jaxba.engine._work import collected, works
from jaxba.report._summary import left_out_by_last_run
from jaxba.scene import Finding, LeftOut


@dataclass(frozen=True, kw_only=True)
class Recorded:
    """What is known of a project's last run.

    - `done`: what the stages recorded, those that come before the first one without a record; its `files` are empty.
    - `stopped`: the stage in which the run ended with an error, and the error; None where it did not.
    - `killed`: the stage in which it was killed; None where it was not. `running`: who works on it now, else None.
    - `stale`: the first stage whose record was made from other inputs or parameters, or by other code; else
      None. The export does not count: nothing is judged by it.
    - `failed`: photos of which a stage could make nothing, by stage: also those whose worker died.
    """

    done: Any
    stopped: LeftOut | None
    killed: str | None
    running: str | None
    stale: str | None
    failed: dict[str, tuple[LeftOut, ...]]

    @property
    def findings(self) -> tuple[Finding, ...]:
        """What the adjustment found; none before it."""
        return () if self.done.adjust is None else self.done.adjust.findings


def recorded(folder: Path, pipeline: Pipeline) -> Recorded:
    """Return what the stages of a project have recorded under its last run's settings.

    Records of earlier runs, made from other inputs or parameters, are passed over, and all that would follow them.

    Raises `JaxbaError` where the folder is no project, or a list that the run was given cannot be read any more.
    """
    project = Project(folder, make=False)
    settings = from_toml(project.folder / SETTINGS, pipeline.settings)
    given, stage_now = project.read_given()
    running = holder(project.folder)
    done = pipeline.begin(files=(), settings=settings, **read_lists(given))
    failed: dict[str, tuple[LeftOut, ...]] = {}
    stale = None
    summary = project.read_json(SUMMARY)
    ended = summary if isinstance(summary, dict) and stage_now is None else {}
    stopped = ended.get("stopped")
    last = stopped["stage"] if isinstance(stopped, dict) else stage_now
    for stage in pipeline.stages:
        if stage.reads_given:
            if stage.name == last or _store.read_record(project.stage(stage.name)) is None:
                break
            setattr(done, stage.name, _store.load(project.stage(stage.name), stage.module.Outputs))
            continue
        items = [item for item in works(project, stage, done, settings[stage.name]) if item.record is not None]
        if not items:
            stale = stage.name if not stage.writes_files and project.stage(stage.name).exists() else None
            break
        outputs, failed[stage.name] = collected(stage, done, items)
        setattr(done, stage.name, outputs)
    for name in (stage.name for stage in pipeline.stages if stage.is_by_photo):
        known = {left.name for left in failed.get(name, ())}
        others = [left for left in left_out_by_last_run(ended, name) if left.name not in known]
        if others:
            failed[name] = (*failed.get(name, ()), *others)
    return Recorded(
        done=done,
        stopped=LeftOut(name=stopped["stage"], reason=stopped["reason"]) if isinstance(stopped, dict) else None,
        killed=stage_now if running is None else None,
        running=running,
        stale=stale,
        failed=failed,
    )
