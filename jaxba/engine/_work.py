"""What there is to do: the works of a stage, one in all or one a photo, and which of them are done and current.

A work is current when its record has the key that it would be made under now, and its files are as they were written.
"""

import errno
import importlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from jaxba._errors import JaxbaError
from jaxba.engine import _store
from jaxba.engine._key import Key, by_field, what_changed
from jaxba.engine._parameters import Parameters
from jaxba.engine._project import Project
from jaxba.engine._stage import Stage
from jaxba.scene import LeftOut


@dataclass(frozen=True)
class Work:
    """The work of a stage, or of one photo of it.

    - `photo`: its name; None for a stage that does all photos at once. `folder`: where what it makes lies.
    - `megapixels`: of the photo. `partners`: how many others it is worked on with.
    """

    photo: str | None
    folder: Path
    key: Key
    inputs: Any
    megapixels: float = 0.0
    partners: int = 0

    @property
    def record(self) -> _store.Record | None:
        """The record under the present key; None where there is none. Its files may be damaged."""
        record = _store.read_record(self.folder)
        return record if record is not None and record.key == self.key else None


def works(project: Project, stage: Stage, done: Any, params: Parameters) -> list[Work]:
    """Return the works of a stage, from what the stages before it have made."""
    module = stage.module.__name__
    if not stage.is_by_photo:
        inputs = stage.inputs(done)
        values = by_field(inputs)
        if stage.reads_places:
            values["places"] = [str(file.path) for file in done.files]
        return [Work(None, project.stage(stage.name), Key.of(module, params, values), inputs)]
    return [
        Work(
            item.name,
            project.stage(stage.name, item.name),
            Key.of(module, params, item.identity),
            item.inputs,
            item.megapixels,
            item.partners,
        )
        for item in stage.inputs(done)
    ]


def why_to_do(project: Project, stage: Stage, work: Work, params: Parameters) -> str | None:
    """Return in words why a work has to be done; None where it is done and current."""
    record = _store.read_record(work.folder)
    if record is None:
        return "its record is damaged" if work.folder.exists() else "not done yet"
    if record.key != work.key:
        return what_changed(record.key, work.key, params)
    if damage := _store.damage(work.folder):
        return damage
    if stage.writes_files:
        outputs = _store.load(work.folder, stage.module.Outputs)
        return _store.damaged_file(project.export, dict(zip(outputs.files, outputs.sha256, strict=True)))
    return None


def collected(stage: Stage, done: Any, items: Sequence[Work]) -> tuple[Any, tuple[LeftOut, ...]]:
    """Return what a stage made, all of whose works have been done, and the photos that it could make nothing of."""
    if stage.collect is None:
        return _store.load(items[0].folder, stage.module.Outputs), ()
    index = {photo.name: i for i, photo in enumerate(done.photos)}
    folders, digests = {}, {}
    for item in items:
        record, name = item.record, item.photo
        if record is not None and name is not None and record.failed is None:
            folders[index[name]], digests[index[name]] = item.folder, record.digest
    return stage.collect(done, folders, digests), failures(items)


def failures(items: Sequence[Work]) -> tuple[LeftOut, ...]:
    """Return the photos of which it is recorded that nothing can be made, and why."""
    reasons = {item.photo: record.failed for item in items if (record := item.record) is not None}
    return tuple(LeftOut(name=name, reason=without_path(name, why)) for name, why in reasons.items() if name and why)


def without_path(name: str, reason: str) -> str:
    """Return a reason without the photo's path before it, which is said beside it, and may have changed since."""
    before, found, after = reason.partition(name)
    return after.lstrip(": ") if found and (not before or before.endswith(("/", "\\"))) else reason


def run_one(module: str, folder: Path, inputs: Any, params: Parameters, key: Key) -> str | None:
    """Run a stage for one photo in a worker and save what it makes; return why it could not, or None."""
    stage = importlib.import_module(module)
    try:
        outputs = stage.run(inputs, params)
    except JaxbaError as error:
        system = error.__cause__ or error.__context__
        number = system.errno if isinstance(system, OSError) else None
        if number == errno.ENOMEM:
            raise MemoryError from error
        if number is None:  # else it is not the photo's fault but the machine's, and may go well another time
            _store.save_failure(folder, str(error), key)
        return str(error)
    _store.save(folder, outputs, key)
    return None
