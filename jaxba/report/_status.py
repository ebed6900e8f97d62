"""Where a project stands: stage by stage what is done, what is stale and why, and what failed; nothing is changed."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np

from jaxba._errors import JaxbaError
from jaxba.engine._lock import holder
from jaxba.engine._parameters import Parameters
from jaxba.engine._project import SETTINGS, SUMMARY, Given, Project, read_lists
from jaxba.engine._settings import Settings, from_toml
from jaxba.engine._stage import Pipeline, Stage, left_out
from jaxba.engine._work import collected, why_to_do, works
from jaxba.report._summary import left_out_by_last_run
from jaxba.scene import EdgeStatus, Finding, LeftOut

State = Literal["done", "stale", "partly done", "not done", "waits"]
_REASONS = 3
_NOT_DONE = "not done yet"


@dataclass(frozen=True, kw_only=True)
class Standing:
    """How a stage stands.

    - `num_done`, `num_all`: works done and current, and all of them: one, or one a photo; 0 where it waits. Photos
      whose worker died in the last run are not done, and do not hold the stage up: the next run tries them again.
    - `reason`: why it is not done, in words; empty where it is.
    """

    stage: str
    state: State
    num_done: int = 0
    num_all: int = 0
    reason: str = ""


@dataclass(frozen=True, kw_only=True)
class Status:
    """How a project stands.

    - `stages`: in their order. `left_out`: files that could not be used, by stage, in those that are done.
    - `rejected`: of the `num_pairs` candidate pairs those without an edge, `a.jpg, b.jpg` each, with the number of
      their matches: mostly photos that do not overlap.
    - `findings`: of the adjustment, where it is done.
    - `activity`: who works on it, or where the last run was stopped, in words; empty where it ended.
    """

    stages: tuple[Standing, ...]
    left_out: tuple[tuple[str, LeftOut], ...]
    rejected: tuple[LeftOut, ...]
    num_pairs: int
    findings: tuple[Finding, ...]
    activity: str

    @property
    def is_done(self) -> bool:
        return all(standing.state == "done" for standing in self.stages)


def project_settings(folder: Path, pipeline: Pipeline) -> dict[str, Parameters]:
    """Return the settings of a project's last run."""
    return from_toml(Project(folder, make=False).folder / SETTINGS, pipeline.settings)


def status(folder: Path, pipeline: Pipeline, settings: Settings) -> Status:
    """Return how a project stands against settings, those of its last run or others.

    Raises `JaxbaError` where the folder is no project.
    """
    project = Project(folder, make=False)
    given, stage_now = project.read_given()
    done: Any = None
    stages: list[Standing] = []
    summary = project.read_json(SUMMARY) if stage_now is None else None  # else of the run before
    try:
        files = project.photo_files(given.photos, remember=False)
        done = pipeline.begin(files=files, settings=settings, **read_lists(given))
    except JaxbaError as error:
        stages.append(Standing(stage=pipeline.stages[0].name, state="stale", num_all=1, reason=str(error)))
    for stage in pipeline.stages[len(stages) :]:
        if stages and stages[-1].state != "done":
            stages.append(_waiting(project, stage, stages))
            continue
        died = left_out_by_last_run(summary, stage.name) if stage.is_by_photo else ()
        stages.append(_standing(project, stage, done, settings, died))
    return Status(
        stages=tuple(stages),
        left_out=()
        if done is None
        else tuple((s, left) for s, found in left_out(pipeline.stages, done).items() for left in found),
        rejected=() if done is None else _rejected(done),
        num_pairs=0 if done is None or done.match is None else len(done.match.view_graph.pairs),
        findings=() if done is None or done.adjust is None else done.adjust.findings,
        activity=_activity(project, given, stage_now),
    )


def _standing(project: Project, stage: Stage, done: Any, settings: Settings, died: Sequence[LeftOut]) -> Standing:
    """Return how a stage stands, and note in `done` what it made where it is done.

    - `died`: photos that the last run could not use in it; of those without a record the worker died.
    """
    params = settings[stage.name]
    items = works(project, stage, done, params)
    why = {item.photo: reason for item in items if (reason := why_to_do(project, stage, item, params))}
    lost = tuple(left for left in died if why.get(left.name) == _NOT_DONE)
    reasons = [reason for name, reason in why.items() if name not in {left.name for left in lost}]
    count = len(items) - len(why)
    if not reasons:
        outputs, unused = collected(stage, done, items)
        setattr(done, stage.name, outputs)
        if stage.is_by_photo:
            setattr(done, f"{stage.name}_left_out", (*unused, *lost, *stage.useless(done, outputs)))
        return Standing(stage=stage.name, state="done", num_done=count, num_all=len(items))
    fresh = all(reason == _NOT_DONE for reason in reasons)
    state: State = "stale" if not fresh else "partly done" if count else "not done"
    return Standing(stage=stage.name, state=state, num_done=count, num_all=len(items), reason=_grouped(reasons))


def _grouped(reasons: Sequence[str]) -> str:
    counts = Counter(reasons).most_common()
    texts = [f"{reason} ({count} photos)" if count > 1 else reason for reason, count in counts[:_REASONS]]
    return "; ".join(texts) + (f"; and {len(counts) - _REASONS} more reasons" if len(counts) > _REASONS else "")


def _waiting(project: Project, stage: Stage, before: Sequence[Standing]) -> Standing:
    blocking = next(standing.stage for standing in before if standing.state != "done")
    was = "has a result that may have to be made anew" if project.stage(stage.name).exists() else "not done yet"
    return Standing(stage=stage.name, state="waits", reason=f"waits for {blocking}; {was}")


def _rejected(done: Any) -> tuple[LeftOut, ...]:
    if done.match is None:
        return ()
    graph = done.match.view_graph
    rows = np.flatnonzero(graph.status == EdgeStatus.REJECTED)
    names = [photo.name for photo in done.photos]
    return tuple(
        LeftOut(name=f"{names[i]}, {names[j]}", reason=f"{graph.num_putative[row]} matches, too few of them verified")
        for row, (i, j) in zip(rows, graph.pairs[rows].tolist(), strict=True)
    )


def _activity(project: Project, given: Given, stage: str | None) -> str:
    if who := holder(project.folder):
        return f"a run works on it ({who}), in stage {stage}"
    if stage is not None:
        return f"the last run was killed in stage {stage}; the same command goes on from there"
    summary = project.read_json(SUMMARY)
    stopped = summary.get("stopped") if isinstance(summary, dict) else None
    if not isinstance(stopped, dict):
        return ""
    return f"the last run stopped in stage {stopped['stage']}: {stopped['reason']}"
