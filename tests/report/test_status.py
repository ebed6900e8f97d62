"""How a project stands, held against what the next run really does."""

import json
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from small_survey import NUM_PHOTOS, Survey, repaint

from jaxba import JaxbaError
from jaxba.engine import changed
from jaxba.engine._lock import locked
from jaxba.pipeline import NAMES, PIPELINE, Event
from jaxba.report import project_settings, status

FIRST = "SIM_0001.JPG"


def standing(survey: Survey, *changes: str) -> dict[str, tuple[str, str]]:
    found = status(survey.project, PIPELINE, changed(project_settings(survey.project, PIPELINE), changes))
    return {stage.stage: (stage.state, stage.reason) for stage in found.stages}


def files(folder: Path) -> dict[str, int]:
    return {str(path): path.stat().st_mtime_ns for path in folder.rglob("*")}


def test_a_project_that_is_done_says_so_and_is_not_touched(made: Survey):
    before = files(made.project)
    found = status(made.project, PIPELINE, project_settings(made.project, PIPELINE))
    assert found.is_done and [stage.stage for stage in found.stages] == list(NAMES) and found.activity == ""
    counts = {stage.stage: stage.num_all for stage in found.stages}
    assert counts["features"] == NUM_PHOTOS and counts["crs"] == 1
    assert all(stage.num_done == stage.num_all for stage in found.stages)
    assert files(made.project) == before


def test_a_changed_parameter_is_named_with_both_values_and_what_follows_waits(made: Survey):
    found = standing(made, "match.ratio=0.7")
    assert found["features"] == ("done", "")
    assert found["match"][0] == "stale" and "match.ratio was 0.75 and is 0.7" in found["match"][1]
    assert found["export"] == ("waits", "waits for match; has a result that may have to be made anew")


def test_a_changed_photo_makes_its_features_stale_alone(made: Survey, tmp_path: Path):
    survey = made.copy(tmp_path, photos=True)
    survey.run(until="metadata")
    with open(survey.photos / FIRST, "ab") as file:
        file.write(b"\0")  # behind the end of the JPEG
    assert standing(survey)["metadata"] == ("stale", "changed: files")
    survey.run(until="pairs")
    found = status(survey.project, PIPELINE, project_settings(survey.project, PIPELINE))
    features = next(stage for stage in found.stages if stage.stage == "features")
    assert (features.state, features.num_done, features.reason) == ("stale", NUM_PHOTOS - 1, "changed: photo")


def test_damage_is_named_and_made_anew(made: Survey, tmp_path: Path, undrawn: None):
    survey = made.copy(tmp_path)
    array = survey.project / "stages" / "features" / FIRST / "features.xy_px.npy"
    array.write_bytes(array.read_bytes()[:-8] + bytes(8))
    assert standing(survey)["features"] == ("stale", "features.xy_px.npy is damaged")
    assert survey.run(until="features").stages_run == ("features",)
    with open(survey.project / "export" / "cloud.ply", "ab") as file:
        file.write(b"\0")
    assert standing(survey)["export"] == ("stale", "cloud.ply is damaged")
    shutil.rmtree(survey.project / "stages" / "export")
    assert standing(survey)["export"] == ("not done", "not done yet")
    assert survey.run().stages_run == ("export",) and standing(survey)["export"] == ("done", "")


def test_a_stopped_run_tells_where_and_why(photos: Path, tmp_path: Path):
    survey = Survey(photos, tmp_path / "project")

    def stop(event: Event) -> None:
        if event.stage == "features" and event.kind == "photo" and event.done == 2:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        survey.run(workers=1, tell=stop)
    found = status(survey.project, PIPELINE, project_settings(survey.project, PIPELINE))
    features = next(stage for stage in found.stages if stage.stage == "features")
    assert features.state == "partly done" and 2 <= features.num_done < NUM_PHOTOS
    assert found.activity == "the last run stopped in stage features: interrupted"
    with locked(survey.project):
        assert (
            "a run works on it (process"
            in status(survey.project, PIPELINE, project_settings(survey.project, PIPELINE)).activity
        )


def test_a_run_that_was_killed_is_told_from_one_that_ended(made: Survey, tmp_path: Path):
    survey = made.copy(tmp_path)
    run = json.loads((survey.project / "run.json").read_text())
    (survey.project / "run.json").write_text(json.dumps({**run, "stage": "match"}))
    found = status(survey.project, PIPELINE, project_settings(survey.project, PIPELINE))
    assert found.activity == "the last run was killed in stage match; the same command goes on from there"


def test_photos_that_are_gone_are_said(made: Survey, tmp_path: Path):
    survey = made.copy(tmp_path, photos=True)
    survey.run(until="metadata")
    survey.photos.rename(tmp_path / "elsewhere")
    state, reason = standing(survey)["metadata"]
    assert state == "stale" and "photos: there is no such folder" in reason


def test_failed_photos_and_rejected_pairs_are_listed(made: Survey, tmp_path: Path):
    survey = made.copy(tmp_path, photos=True)
    (survey.photos / FIRST).write_bytes((survey.photos / FIRST).read_bytes()[:20_000])
    repaint(
        survey.photos / "SIM_0002.JPG",
        lambda pixels: np.random.default_rng(0).integers(255, size=pixels.shape, dtype=np.uint8),
    )
    survey.run("pairs.method=exhaustive", until="match")
    found = status(survey.project, PIPELINE, project_settings(survey.project, PIPELINE))
    assert [(stage, left.name) for stage, left in found.left_out] == [("features", FIRST)]
    others = [f"SIM_0002.JPG, SIM_{number:04d}.JPG" for number in range(3, NUM_PHOTOS + 1)]
    assert [left.name for left in found.rejected] == others
    assert all(left.reason.endswith("matches, too few of them verified") for left in found.rejected)
    assert found.num_pairs == (NUM_PHOTOS - 1) * (NUM_PHOTOS - 2) // 2
    shown = subprocess.run(
        [sys.executable, "-m", "jaxba", "status", str(survey.project)], capture_output=True, text=True
    )
    edges = found.num_pairs - len(found.rejected)
    said = f"pairs {edges} of {found.num_pairs} candidate pairs became edges; the others are mostly photos that do not"
    assert said in " ".join(shown.stdout.split()) and "rejected" not in shown.stdout


def test_a_folder_that_is_no_project_is_refused(tmp_path: Path):
    with pytest.raises(JaxbaError, match="is no project; give the folder that `jaxba run --out` was given"):
        project_settings(tmp_path, PIPELINE)


def test_the_command_tells_the_same_and_its_exit_code_whether_all_is_done(made: Survey):
    command = [sys.executable, "-m", "jaxba", "status", str(made.project)]
    ended = subprocess.run(command, capture_output=True, text=True)
    assert ended.returncode == 0 and ended.stdout.splitlines()[0].split() == ["metadata", "done"]
    changed_ = subprocess.run([*command, "--set", "match.ratio=0.7", "--json"], capture_output=True, text=True)
    assert changed_.returncode == 1
    facts = json.loads(changed_.stdout)
    assert not facts["done"] and {stage["stage"]: stage["state"] for stage in facts["stages"]}["match"] == "stale"
    none = subprocess.run([*command[:-1], "/"], capture_output=True, text=True)
    assert (
        none.returncode == 2
        and none.stderr == "jaxba: /: is no project; give the folder that `jaxba run --out` was given.\n"
    )
