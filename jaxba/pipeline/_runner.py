"""The runner: goes through the stages, skips what is unchanged, keeps what is done.

Work is unchanged when its key is: a fingerprint of the stage's code, its parameters and the contents of its inputs; and
what it made must be whole, by its checksums. A stage whose input was made anew but came out equal is not run again.
Stages of photos do this photo by photo, so a run that was stopped goes on with the photos that are left, and one that
is added costs its own work and that of its pairs.
"""

import contextlib
import functools
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

from jaxba._atomic import write_folder_atomically
from jaxba._errors import JaxbaError
from jaxba.engine import _store
from jaxba.engine._engines import crew, fewer_workers, work as work_on
from jaxba.engine._fingerprint import fingerprint
from jaxba.engine._items import Item
from jaxba.engine._limits import check_failures
from jaxba.engine._lock import holder_file, locked
from jaxba.engine._parameters import Parameters
from jaxba.engine._project import SETTINGS, SUMMARY, TIMES, Given, Project, read_lists, refuse_photo_folder
from jaxba.engine._room import Room
from jaxba.engine._settings import Settings, to_toml
from jaxba.engine._stage import Stage, left_out
from jaxba.engine._work import Work, collected, failures, run_one, why_to_do, without_path, works
from jaxba.engine._workers import Resources, memory_for
from jaxba.pipeline._done import Done
from jaxba.pipeline._events import Event, Run
from jaxba.pipeline._stages import NAMES, STAGES
from jaxba.report import summary, told_of
from jaxba.scene import LeftOut, described

_FIRST_MADE = "pairs"  # the stages before it only read what a run is given


def run_pipeline(
    photos: Path,
    out: Path,
    settings: Settings,
    *,
    until: str | None = None,
    geotags: Path | None = None,
    gcp: Path | None = None,
    check: Path | None = None,
    bars: Path | None = None,
    tell: Callable[[Event], None] = lambda event: None,
) -> Run:
    """Run the pipeline on a folder of photos, up to and with the stage `until`; what is unchanged is not run again.

    - `out`: the project folder. `settings`: parameters by stage. `geotags`: a list that replaces the photos' tags.
    - `gcp`, `check`: lists of control and of check points. `bars`: of scale bars.

    Photos are worked on in new processes, which import the script that calls this: it must do so under
    `if __name__ == "__main__":`.

    Raises `JaxbaError` where the photos, the parameters or the folder make a result impossible, and where another run
    works on the project; the stages before it are kept. Where what was given is refused before anything was made of the
    photos, a new project folder is removed again.
    """
    if until is not None and until not in NAMES:
        raise JaxbaError(f"stage {until!r}: choose one of {', '.join(NAMES)}.")
    refuse_photo_folder(photos, out)
    for params in settings.values():
        params.check_installed()
    project = Project(out)
    with locked(project.folder):
        project.remove_leftovers()
        given = Given(photos=photos, geotags=geotags, gcp=gcp, check=check, bars=bars)
        try:
            done = Done(files=project.photo_files(photos), settings=settings, **read_lists(given))
            project.write_text(SETTINGS, to_toml(settings))
            return _run_stages(project, given, done, until, tell)
        except JaxbaError:
            if not project.stage(_FIRST_MADE).exists():
                project.remove_if_new()
            raise


def _run_stages(project: Project, given: Given, done: Done, until: str | None, tell: Callable[[Event], None]) -> Run:
    settings = done.settings
    resources = settings["workers"]
    assert isinstance(resources, Resources)
    stages_run: list[str] = []
    lines: dict[str, list[str]] = {}

    def end(stopped: LeftOut | None = None) -> Run:
        """Write the summary, and that the run has ended."""
        facts = summary(STAGES, done, stages_run=stages_run, lines=lines, stopped=stopped)
        project.write_json(SUMMARY, facts)
        project.write_given(given, None)
        return Run(done, tuple(stages_run), facts)

    for stage in STAGES:
        begun = time.perf_counter()
        project.write_given(given, stage.name)
        tell(Event("begin", stage.name))
        try:
            outputs, total, unused, notes = _run_stage(project, stage, done, settings[stage.name], resources, tell)
        except (JaxbaError, KeyboardInterrupt) as error:
            reason = str(error) or "interrupted"
            with contextlib.suppress(JaxbaError):  # what stopped the run is the news
                end(LeftOut(name=stage.name, reason=reason))
            raise
        setattr(done, stage.name, outputs)
        if stage.is_by_photo:
            setattr(done, f"{stage.name}_left_out", (*unused, *stage.useless(done, outputs)))
        if total:
            stages_run.append(stage.name)
        seconds = time.perf_counter() - begun
        if total:
            project.write_json(TIMES, {**_times(project), stage.name: round(seconds, 3)})
        left_here = left_out(STAGES, done)[stage.name]
        say = functools.partial(stage.module.lines, outputs, told_of(done, left_here))
        said, odd = described("the sentences on this stage", say, ["done"])
        lines[stage.name] = [said[0], *notes, *said[1:], *odd]
        tell(Event("end", stage.name, total, total, seconds, left_here, lines=tuple(lines[stage.name])))
        if stage.name == until:
            break
    return end()


def _times(project: Project) -> dict[str, float]:
    found = project.read_json(TIMES)
    return found if isinstance(found, dict) else {}


def _run_stage(
    project: Project,
    stage: Stage,
    done: Done,
    params: Parameters,
    resources: Resources,
    tell: Callable[[Event], None],
) -> tuple[Any, int, tuple[LeftOut, ...], tuple[str, ...]]:
    """Return what a stage made, how much of it had to be done, the photos that it could not work on, and notes."""
    items = works(project, stage, done, params)
    waiting = [item for item in items if why_to_do(project, stage, item, params)]
    if waiting:
        tell(Event("todo", stage.name, 0, len(waiting), by_photos=stage.is_by_photo))
    reads = holder_file(project.folder), *{file.path.parent: file.path for file in done.files}.values()
    if not stage.is_by_photo:
        for item in waiting:
            _run_whole(project, stage, item, params, resources, reads)
        return collected(stage, done, items)[0], len(waiting), (), ()
    if waiting:
        stage.refuse(project.stage(stage.name), items, params, resources)
    failed, notes = _run_photos(stage, items, waiting, params, resources, reads, tell)
    by_name = {left.name: left for left in (*failed, *failures(items))}
    unused = tuple(by_name[name] for name in sorted(by_name))
    check_failures(stage.name, unused, len(items), resources)
    if items and len(unused) == len(items):
        first = "; ".join(f"{left.name}: {left.reason}" for left in unused[:3])
        raise JaxbaError(f"stage {stage.name}: none of {len(items)} photos could be used. First: {first}")
    return collected(stage, done, items)[0], len(waiting), unused, notes


def _run_whole(
    project: Project, stage: Stage, item: Work, params: Parameters, resources: Resources, reads: tuple[Path, ...]
) -> None:
    if stage.writes_files:
        with write_folder_atomically(project.export) as partial:
            outputs = stage.module.run(replace(item.inputs, folder=partial), params)
    elif stage.takes_room:
        folder = project.unfinished(stage.name, fingerprint(item.key))
        room = Room(resources.memory_bytes, folder, functools.partial(crew, resources, reads))
        outputs = stage.module.run(item.inputs, params, room)
    else:
        outputs = stage.module.run(item.inputs, params)
    _store.save(item.folder, outputs, item.key)
    project.forget_unfinished(stage.name)


def _run_photos(
    stage: Stage,
    items: list[Work],
    waiting: list[Work],
    params: Parameters,
    resources: Resources,
    reads: tuple[Path, ...],
    tell: Callable[[Event], None],
) -> tuple[list[LeftOut], tuple[str, ...]]:
    """Run a stage for its photos that wait, in workers; return those that failed, with the reason, and notes.

    - `reads`: files that tell whether a worker sees the project and the photos.
    """
    if not waiting:
        return [], ()
    module, todo = stage.module.__name__, {id(work) for work in waiting}
    before = failures([work for work in items if id(work) not in todo])
    failed: list[LeftOut] = []
    queue = [
        Item(
            name=str(work.photo),
            arguments=(module, work.folder, work.inputs, params, work.key),
            need_bytes=memory_for(work.megapixels),
            effort=work.megapixels * (1 + work.partners),
            reads=reads,
        )
        for work in waiting
    ]
    effort_done, effort = 0.0, sum(item.effort for item in queue)
    with contextlib.closing(work_on(run_one, queue, resources)) as ending:
        for count, (item, recorded, reason) in enumerate(ending, 1):
            left = tuple(
                LeftOut(name=item.name, reason=without_path(item.name, why)) for why in (recorded or reason,) if why
            )
            failed += left
            effort_done += item.effort
            tell(Event("photo", stage.name, count, len(queue), left_out=left, share=effort_done / effort))
            check_failures(stage.name, [*before, *failed], len(items), resources)
    note = fewer_workers(queue, resources)
    return failed, () if note is None else (note,)
