"""The runner: goes through the stages, skips what is unchanged, keeps what is done.

Work is unchanged when its key is: a fingerprint of the stage's code, its parameters and the contents of its inputs. A
stage whose input was made anew but came out equal is not run again. Stages of photos do this photo by photo, so a run
that was stopped goes on with the photos that are left, and one that is added costs its own work and that of its pairs.
"""

import contextlib
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

from jaxba._errors import JaxbaError
from jaxba.pipeline import _store
from jaxba.pipeline._events import Event, Run
from jaxba.pipeline._fingerprint import code_version, fingerprint
from jaxba.pipeline._parameters import Parameters
from jaxba.pipeline._project import Project, read_geotags
from jaxba.pipeline._settings import Settings, as_plain
from jaxba.pipeline._stages import NAMES, STAGES, Done, PhotoItem, Stage, run_photo
from jaxba.pipeline._summary import left_out, stage_lines, summary
from jaxba.pipeline._workers import Item, Resources, memory_for, work
from jaxba.scene import Left


def run_pipeline(
    photos: Path,
    out: Path,
    settings: Settings,
    *,
    until: str | None = None,
    geotags: Path | None = None,
    resources: Resources | None = None,
    tell: Callable[[Event], None] = lambda event: None,
) -> Run:
    """Run the pipeline on a folder of photos, up to and with the stage `until`; what is unchanged is not run again.

    - `out`: the project folder. `settings`: parameters by stage. `geotags`: a list that replaces the photos' tags.

    Raises `JaxbaError` where the photos, the parameters or the folder make a result impossible; the stages before it
    are kept.
    """
    if until is not None and until not in NAMES:
        raise JaxbaError(f"stage {until!r}: choose one of {', '.join(NAMES)}.")
    project = Project(out)
    done = Done(files=project.photo_files(photos), geotags=read_geotags(photos, geotags))
    plain = as_plain(settings)
    if project.read_json("settings.json") != plain:
        project.write_json("settings.json", plain)
    stages_run: list[str] = []
    lines: dict[str, list[str]] = {}
    for stage in STAGES:
        begun = time.perf_counter()
        tell(Event("begin", stage.name))
        try:
            outputs, total, unused = _run_stage(project, stage, done, settings, resources or Resources(), tell)
        except (JaxbaError, KeyboardInterrupt) as error:
            reason = str(error) or "interrupted"
            with contextlib.suppress(JaxbaError):  # what stopped the run is the news
                _write_summary(project, Run(done, tuple(stages_run), lines, Left(name=stage.name, reason=reason)))
            raise
        setattr(done, stage.name, outputs)
        if stage.collect is not None:
            setattr(done, f"{stage.name}_left_out", (*unused, *stage.useless(done, outputs)))
        if total:
            stages_run.append(stage.name)
        seconds = time.perf_counter() - begun
        names = tuple(photo.name for photo in done.photos)
        left_here = left_out(done).get(stage.name, ())
        event = Event("end", stage.name, total, total, seconds, outputs, left_here, names)
        lines[stage.name] = stage_lines(event)
        tell(event)
        if stage.name == until:
            break
    run = Run(done, tuple(stages_run), lines)
    _write_summary(project, run)
    return run


def _run_stage(
    project: Project,
    stage: Stage,
    done: Done,
    settings: Settings,
    resources: Resources,
    tell: Callable[[Event], None],
) -> tuple[Any, int, tuple[Left, ...]]:
    """Return what a stage made, how much of it had to be done, and the photos that it could not work on."""
    params = settings[stage.name]
    if stage.collect is None:
        return _run_whole(project, stage, done, params)
    return _run_photos(project, stage, done, params, resources, tell)


def _write_summary(project: Project, run: Run) -> None:
    facts = summary(run)
    if project.read_json("summary.json") != facts:
        project.write_json("summary.json", facts)


def _run_whole(project: Project, stage: Stage, done: Done, params: Parameters) -> tuple[Any, int, tuple[Left, ...]]:
    inputs, folder = stage.inputs(done), project.stage(stage.name)
    paths = [str(file.path) for file in done.files] if stage.name == "metadata" else []  # photos may have moved
    key = fingerprint(code_version(stage.module.__name__), params, inputs, paths)
    record = _store.read_record(folder)
    if record is not None and record.key == key:
        outputs = _store.load(folder, stage.module.Outputs)
        if stage.name != "export" or all((project.export / name).exists() for name in outputs.files):
            return outputs, 0, ()
    if stage.name == "export":
        with _store.written_whole(project.export) as partial:
            outputs = stage.module.run(replace(inputs, folder=partial), params)
    else:
        outputs = stage.module.run(inputs, params)
    _store.save(folder, outputs, key)
    return _store.load(folder, stage.module.Outputs), 1, ()


def _run_photos(
    project: Project,
    stage: Stage,
    done: Done,
    params: Parameters,
    resources: Resources,
    tell: Callable[[Event], None],
) -> tuple[Any, int, tuple[Left, ...]]:
    items: list[PhotoItem] = stage.inputs(done)
    code = code_version(stage.module.__name__)
    index = {photo.name: i for i, photo in enumerate(done.photos)}
    keys = {item.name: fingerprint(code, params, item.identity) for item in items}
    folders = {item.name: project.stage(stage.name, item.name) for item in items}
    waiting = []
    for item in items:
        record = _store.read_record(folders[item.name])
        if record is None or record.key != keys[item.name]:
            arguments = (stage.module.__name__, folders[item.name], item.inputs, params, keys[item.name])
            waiting.append(Item(name=item.name, arguments=arguments, need_bytes=memory_for(item.megapixels)))
    reasons = {}
    if waiting:
        tell(Event("photo", stage.name, 0, len(waiting)))
    for count, (item, failed, died) in enumerate(work(run_photo, waiting, resources), 1):
        reasons[item.name] = failed or died
        tell(Event("photo", stage.name, count, len(waiting)))
    made, digests = {}, {}
    for item in items:
        record = _store.read_record(folders[item.name])
        if record is not None and record.key == keys[item.name]:
            reasons[item.name] = record.failed
            if record.failed is None:
                made[index[item.name]], digests[index[item.name]] = folders[item.name], record.digest
    unused = tuple(Left(name=n, reason=_without_path(n, why)) for n, why in sorted(reasons.items()) if why)
    if items and not made:
        first = "; ".join(f"{left.name}: {left.reason}" for left in unused[:3])
        raise JaxbaError(f"stage {stage.name}: none of {len(items)} photos could be used. First: {first}")
    assert stage.collect is not None
    return stage.collect(done, made, digests), len(waiting), unused


def _without_path(name: str, reason: str) -> str:
    """Return a reason without the photo's path before it, which is said beside it, and may have changed since."""
    before, found, after = reason.partition(name)
    return after.lstrip(": ") if found and (not before or before.endswith(("/", "\\"))) else reason
