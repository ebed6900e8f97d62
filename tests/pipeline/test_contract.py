"""What every stage keeps: its types, pure runs, records that read back as they were written, light imports."""

import dataclasses
import importlib
import json
import logging
import os
import subprocess
import sys
import warnings
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest
from small_survey import Survey

from jaxba.engine import _store
from jaxba.engine._fingerprint import fingerprint
from jaxba.engine._key import Key
from jaxba.engine._parameters import Parameters
from jaxba.pipeline import STAGES, Run
from jaxba.pipeline._stages import Stage
from jaxba.report import told_of
from jaxba.scene import LeftOut

EVERY = pytest.mark.parametrize("stage", STAGES, ids=lambda stage: stage.name)


@pytest.fixture(scope="module")
def survey(made: Survey, tmp_path_factory: pytest.TempPathFactory) -> Survey:
    return made.copy(tmp_path_factory.mktemp("contract"))


@pytest.fixture(scope="module")
def done(survey: Survey) -> Run:
    run = survey.run()
    assert run.stages_run == ()
    return run


def one_work(stage: Stage, run: Run, folder: Path) -> tuple[Any, str]:
    """Return the inputs of a stage, of its first photo if it goes by photos, and the digest of what the run made."""
    project = folder / "project" / "stages" / stage.name
    if stage.collect is None:
        inputs = stage.inputs(run.done)
    else:
        item = stage.inputs(run.done)[0]
        inputs, project = item.inputs, project / item.name
    record = _store.read_record(project)
    assert record is not None
    return inputs, record.digest


def global_state() -> dict[str, Any]:
    """Return what a stage might change; beartype draws from `random`, so that it is not among it."""
    return {
        "cwd": os.getcwd(),
        "environ": dict(os.environ),
        "numpy": repr(np.random.get_state()),
        "warnings": list(warnings.filters),
        "numpy errors": np.geterr(),
        "handlers": list(logging.getLogger().handlers),
        "float64": jax.config.read("jax_enable_x64"),
    }


def tree(folder: Path) -> dict[str, int]:
    return {str(path.relative_to(folder)): path.stat().st_mtime_ns for path in folder.rglob("*")}


@EVERY
def test_a_stage_has_frozen_inputs_params_and_outputs(stage: Stage):
    for name in ("Inputs", "Params", "Outputs"):
        kind = getattr(stage.module, name)
        assert dataclasses.is_dataclass(kind) and kind.__doc__, name
        assert vars(kind)["__dataclass_params__"].frozen, name
    assert issubclass(stage.module.Params, Parameters) and callable(stage.module.run) and stage.module.run.__doc__
    for field in dataclasses.fields(stage.module.Params):
        assert field.metadata["help"] and field.default is not dataclasses.MISSING
    assert stage.module.Params() == stage.module.Params()


@EVERY
def test_a_stage_says_what_it_made_in_words_and_in_plain_values(stage: Stage, done: Run):
    outputs = getattr(done.done, stage.name)
    told = told_of(done.done)
    before = fingerprint(outputs) if stage.collect is None else ""
    lines, facts = stage.module.lines(outputs, told), stage.module.facts(outputs, told)
    assert lines and all(isinstance(line, str) and line for line in lines)
    assert lines == done.facts["stages"][stage.name]
    told_by_the_run = {name: done.facts[name] for name in facts}
    assert json.loads(json.dumps(facts)) == json.loads(json.dumps(told_by_the_run))
    assert lines == stage.module.lines(outputs, told) and (stage.collect or fingerprint(outputs) == before)


@EVERY
def test_a_stage_says_what_it_left_out_once(stage: Stage, done: Run):
    left = LeftOut(name="IMG_1.JPG", reason="it is broken.")
    lines = stage.module.lines(getattr(done.done, stage.name), told_of(done.done, (left,)))
    others = stage.module.lines(getattr(done.done, stage.name), told_of(done.done))
    said = [line for line in lines if "IMG_1.JPG" in line]
    may = stage.name in ("metadata", "features", "match", "start", "adjust")  # the others work on no single photo
    assert said == (["IMG_1.JPG: it is broken."] if may else []) and len(lines) == len(others) + len(said)


@EVERY
def test_a_stage_is_pure(stage: Stage, done: Run, survey: Survey, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """Run once more, it makes what the run made, changes neither its inputs nor the process, and writes no file."""
    for library in ("cv2", "pyogrio"):  # set variables of their own when they are first imported
        importlib.import_module(library)
    inputs, digest = one_work(stage, done, survey.project.parent)
    if stage.name == "export":
        (tmp_path / "export").mkdir()
        inputs = dataclasses.replace(inputs, folder=tmp_path / "export")
    (tmp_path / "cwd").mkdir()
    monkeypatch.chdir(tmp_path / "cwd")
    params = stage.module.Params(nfeatures=2000) if stage.name == "features" else stage.module.Params()
    before, state = (fingerprint(inputs), tree(survey.project), tree(survey.photos)), global_state()
    outputs = stage.module.run(inputs, params)
    after = global_state()
    # jax and others add variables of their own when they are first used; none that was set may change
    after["environ"] = {name: value for name, value in after["environ"].items() if name in state["environ"]}
    assert {name: value for name, value in after.items() if value != state[name]} == {}
    assert before == (fingerprint(inputs), tree(survey.project), tree(survey.photos))
    assert isinstance(outputs, stage.module.Outputs) and fingerprint(outputs) == digest
    assert list((tmp_path / "cwd").iterdir()) == []
    _store.save(tmp_path / "saved", outputs, Key("code", {}, {}))
    assert fingerprint(_store.load(tmp_path / "saved", stage.module.Outputs)) == digest


def test_the_table_of_stages_loads_nothing_heavy():
    code = (
        "import sys, jaxba.pipeline._stages\n"
        "print(sorted({'jax', 'cv2', 'pandas', 'matplotlib', 'optimistix', 'pyproj', 'poselib'} & set(sys.modules)))"
    )
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout == "[]\n"


def test_workers_never_load_jax(photos: Path):
    """The stages before the start values, each run on real photos in a process of its own."""
    code = f"""
import json, sys
from pathlib import Path
import numpy as np
from jaxba.pipeline import crs, features, match, metadata, pairs, tracks
from jaxba.scene import PhotoFile
paths = sorted(Path({str(photos)!r}).iterdir())[:3]
files = tuple(PhotoFile(name=path.name, path=path, sha256=path.name) for path in paths)
photos = metadata.run(metadata.Inputs(files=files), metadata.Params()).photos
reference = crs.run(crs.Inputs(photos=photos), crs.Params()).reference
found = [features.run(features.Inputs(photo=photo), features.Params(nfeatures=2000)).features for photo in photos]
candidates = pairs.run(pairs.Inputs(photos=photos, reference=reference), pairs.Params())
graph = match.run(match.Inputs(image=0, partners=np.array([1, 2]), overlap=np.array([0.7, 0.5]), photos=photos,
    reference=reference, features=dict(enumerate(found))), match.Params()).view_graph
tracks.run(tracks.Inputs(photos=photos, features=dict(enumerate(found)), view_graph=graph), tracks.Params())
print(json.dumps(sorted({{'jax', 'equinox', 'optimistix', 'pandas', 'matplotlib'}} & set(sys.modules))))
"""
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert run.returncode == 0, run.stderr
    assert json.loads(run.stdout) == []
