import dataclasses
from importlib.metadata import version
from pathlib import Path

import numpy as np
import pytest

from jaxba.engine import _fingerprint, _versions
from jaxba.engine._fingerprint import _imports, code_version, fingerprint, packages
from jaxba.engine._key import Key, what_changed
from jaxba.pipeline import NAMES, STAGES, match


@dataclasses.dataclass(frozen=True)
class Pair:
    a: object
    b: object


def forget() -> None:
    """Forget what was read of sources."""
    for function in (code_version, _fingerprint._reached, _fingerprint._imports, _fingerprint._without_words):
        function.cache_clear()


@pytest.mark.parametrize(
    ("one", "other"),
    [
        ((1, 2), (12,)),
        (("a", "b"), ("ab",)),
        (1, 1.0),
        (True, 1),
        (None, "None"),
        (np.zeros(4), np.zeros((2, 2))),
        (np.zeros(2, np.float32), np.zeros(1)),
        (np.array([0.0]), np.array([-0.0])),
        ({"a": 1}, {"b": 1}),
        (Pair(1, (2,)), Pair((1,), 2)),
        (Pair(1, 2), (1, 2)),
    ],
)
def test_different_values_have_different_fingerprints(one, other):
    assert fingerprint(one) != fingerprint(other)


def test_equal_values_have_equal_fingerprints_whatever_their_memory(tmp_path):
    array = np.arange(12.0).reshape(3, 4)
    np.save(tmp_path / "a.npy", array)
    mapped = np.load(tmp_path / "a.npy", mmap_mode="r")
    assert fingerprint(array) == fingerprint(mapped) == fingerprint(np.asfortranarray(array))
    assert fingerprint({"a": 1, "b": 2}) == fingerprint({"b": 2, "a": 1})


def test_paths_count_as_nothing():
    assert fingerprint(Pair(Path("/a"), 1)) == fingerprint(Pair(Path("/b"), 1))


def test_an_unknown_kind_is_refused():
    with pytest.raises(TypeError, match="no fingerprint of a object"):
        fingerprint(object())


def test_code_version_follows_imports_to_where_a_name_is_defined():
    source = b"def f():\n    from jaxba.io import write_tile\n    from jaxba.scene import LeftOut\nimport numpy"
    assert set(_imports(source)) == {"jaxba.io._tile", "jaxba.scene._photo", "numpy"}


def test_code_version_differs_by_stage_and_repeats():
    names = ["metadata", "crs", "control", "pairs", "features", "match", "tracks", "start", "adjust", "export"]
    versions = [code_version(f"jaxba.pipeline.{name}") for name in names]
    assert len(set(versions)) == len(names)
    forget()
    assert [code_version(f"jaxba.pipeline.{name}") for name in names] == versions


def test_code_version_changes_with_what_is_imported(monkeypatch, tmp_path):
    changed = tmp_path / "_rotation.py"
    original = _fingerprint._source("jaxba.geometry._rotation")
    assert original is not None
    changed.write_bytes(original.read_bytes() + b"\n# changed\n")
    before = {name: code_version(name) for name in ("jaxba.ba._solve", "jaxba.pipeline.features")}
    real = _fingerprint._source.__wrapped__
    source = {"jaxba.geometry._rotation": changed}
    monkeypatch.setattr(_fingerprint, "_source", lambda name: source.get(name) or real(name))
    forget()
    after = {name: code_version(name) for name in before}
    forget()
    assert after["jaxba.pipeline.features"] == before["jaxba.pipeline.features"]
    assert after["jaxba.ba._solve"] != before["jaxba.ba._solve"]


@pytest.fixture
def with_change(monkeypatch: pytest.MonkeyPatch, tmp_path: Path):
    """Return the version of a stage's code with a text of a module replaced by another."""
    real = _fingerprint._source.__wrapped__

    def version(stage: str, module: str, before: str, after: str) -> str:
        original = real(module)
        assert original is not None and before in original.read_text()
        changed = tmp_path / "changed.py"
        changed.write_text(original.read_text().replace(before, after))
        monkeypatch.setattr(_fingerprint, "_source", lambda name: changed if name == module else real(name))
        forget()
        found = code_version(stage)
        monkeypatch.undo()
        forget()
        return found

    return version


@pytest.mark.parametrize(
    ("stage", "module", "before", "after"),
    [
        ("adjust", "jaxba.pipeline.adjust", "median {outputs.median_px:.2f} px", "{outputs.median_px:.2f} px median"),
        ("adjust", "jaxba.pipeline.adjust", "    Told,\n", "    Picture,\n    Told,\n"),
        ("adjust", "jaxba.report._reasons", "more such files", "more of these"),
        ("adjust", "jaxba.report._findings", "look at the edges", "see the edges"),
        # export imports the stage adjust, and match the stage features
        ("export", "jaxba.pipeline.adjust", "median {outputs.median_px:.2f} px", "{outputs.median_px:.2f} px median"),
        ("export", "jaxba.report._findings", "look at the edges", "see the edges"),
        ("match", "jaxba.pipeline.features", "keypoints, median", "features, median"),
        ("match", "jaxba.report._reasons", "more such files", "more of these"),
    ],
)
def test_other_words_rerun_nothing(with_change, stage: str, module: str, before: str, after: str):
    stage = f"jaxba.pipeline.{stage}"
    assert with_change(stage, module, before, after) == code_version(stage)


@pytest.mark.parametrize(
    ("stage", "module", "before", "after"),
    [
        ("adjust", "jaxba.pipeline.adjust", "sigmas = controlled.sigmas", "sigmas = sigmas"),
        ("adjust", "jaxba.pipeline.adjust", "import numpy as np", "import jax.numpy as np"),  # the same name
        ("match", "jaxba.pipeline.features", "def run(inputs", "def run( inputs"),  # detects where SIFT is the fallback
        ("adjust", "jaxba.sfm._findings", "_WEAK_OBSERVATIONS = 20", "_WEAK_OBSERVATIONS = 30"),
        ("export", "jaxba.io._las", "def write_las(", "def write_laz("),  # of a package that is imported whole
        ("export", "jaxba.report._picture", "MOST_POINTS = 200_000", "MOST_POINTS = 100_000"),  # is a file of its own
    ],
)
def test_what_is_made_otherwise_is_made_anew(with_change, stage: str, module: str, before: str, after: str):
    stage = f"jaxba.pipeline.{stage}"
    assert with_change(stage, module, before, after) != code_version(stage)


def test_every_package_that_a_stage_imports_counts_or_computes_nothing():
    found = {package for stage in NAMES for package in packages(f"jaxba.pipeline.{stage}")}
    assert found - set(_versions._COMPUTE) == _versions.COMPUTE_NOTHING & found
    assert {"cv2", "numpy"} <= packages("jaxba.pipeline.features") and "jax" not in packages("jaxba.pipeline.features")
    assert {"poselib", "cv2"} <= packages("jaxba.pipeline.match")
    assert {"jax", "optimistix", "scipy"} <= packages("jaxba.pipeline.adjust")
    assert "cv2" not in packages("jaxba.pipeline.tracks")


def test_another_version_makes_what_it_computed_stale_and_nothing_else(monkeypatch: pytest.MonkeyPatch):
    def keys() -> dict[str, Key]:
        return {stage.name: Key.of(stage.module.__name__, stage.module.Params(), {}) for stage in STAGES}

    before, real = keys(), _versions._version
    monkeypatch.setattr(_versions, "_version", lambda name: "9.9" if name == "poselib" else real(name))
    after = keys()
    changed = {name for name in before if before[name] != after[name]}
    assert "match" in changed and not changed & {"metadata", "crs", "control", "pairs", "features", "tracks"}
    params = match.Params()
    assert what_changed(before["match"], after["match"], params) == f"poselib was {version('poselib')} and is 9.9"
    older = dataclasses.replace(before["match"], versions={})  # as earlier versions of jaxba recorded
    assert f"numpy was not there and is {version('numpy')}" in what_changed(older, before["match"], params)
