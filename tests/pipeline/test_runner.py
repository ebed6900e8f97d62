"""What a run does again and what it does not: a changed thing reruns what depends on it, and nothing else."""

import dataclasses
import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from small_survey import FAST, NUM_PHOTOS, Survey, repaint

from jaxba import JaxbaError
from jaxba.engine import changed, from_toml
from jaxba.engine._fingerprint import fingerprint
from jaxba.engine._room import Room
from jaxba.engine._store import load
from jaxba.pipeline import NAMES, PIPELINE, Done, Event, adjust, run_pipeline, start
from jaxba.scene import Finding

FIRST, LAST = "SIM_0001.JPG", f"SIM_{NUM_PHOTOS:04d}.JPG"


@pytest.fixture(scope="module")
def done(made: Survey, tmp_path_factory: pytest.TempPathFactory) -> Done:
    """What the stages of the whole run have made, read by a run that does nothing."""
    return made.copy(tmp_path_factory.mktemp("done")).run().done


@pytest.fixture
def quick(done: Done, undrawn: None, monkeypatch: pytest.MonkeyPatch) -> None:
    """Put the outputs of the whole run in place of the two stages that compile, with a mark of what went in."""
    block = done.start.block

    def start_run(inputs: start.Inputs, params: start.Params) -> start.Outputs:
        return start.Outputs(block=dataclasses.replace(block, notes=(fingerprint(inputs, params),)))

    def adjust_run(inputs: adjust.Inputs, params: adjust.Params, max_memory: float) -> adjust.Outputs:
        mark = Finding.of("note", text=fingerprint(inputs, params))
        return dataclasses.replace(done.adjust, findings=(mark,))

    monkeypatch.setattr(start, "run", start_run)
    monkeypatch.setattr(adjust, "run", adjust_run)


def inodes(folder: Path) -> dict[str, int]:
    """Return each record below a folder with its inode: a folder that was made anew has another."""
    return {p.parent.relative_to(folder).as_posix(): p.stat().st_ino for p in folder.rglob("record.json")}


def made_anew(before: dict[str, int], after: dict[str, int]) -> set[str]:
    return {name for name in after if after[name] != before.get(name)}


def exported(project: Path) -> dict[str, bytes]:
    files = sorted(path for path in (project / "export").rglob("*") if path.is_file())
    return {path.relative_to(project / "export").as_posix(): path.read_bytes() for path in files}


def blacken_a_corner(pixels: np.ndarray) -> np.ndarray:
    pixels[:120, :160] = 0
    return pixels


def test_a_run_adjusts_every_photo_and_says_so(made: Survey):
    facts = json.loads((made.project / "summary.json").read_text())
    assert list(facts["stages"]) == list(NAMES)
    assert facts["adjust"]["images"] == NUM_PHOTOS and facts["left_out"] == [] and "groups" not in facts
    assert facts["adjust"]["median_px"] < 0.3
    assert {"README.txt", "cloud.laz", "cameras.gpkg"} <= set(facts["export"]["files"]) == set(exported(made.project))


QUICK = """
import sys, time
from pathlib import Path
from jaxba.pipeline import PIPELINE, run_pipeline
from jaxba.engine import changed
for _ in range(4):  # the first one imports
    begun = time.perf_counter()
    run_pipeline(Path(sys.argv[1]), Path(sys.argv[2]), changed(PIPELINE.settings, sys.argv[3:]))
    print(time.perf_counter() - begun)
"""


def test_a_second_run_does_nothing_and_is_quick(made: Survey, tmp_path: Path):
    survey = made.copy(tmp_path)
    before = inodes(survey.project)
    assert survey.run().stages_run == () and inodes(survey.project) == before
    # in a process that does not check types as it runs, which takes ten times as long as the run
    command = [sys.executable, "-c", QUICK, str(survey.photos), str(survey.project), *FAST]
    ended = subprocess.run(command, capture_output=True, text=True, check=True)
    assert min(map(float, ended.stdout.split())) < 1.0 and inodes(survey.project) == before


def test_touched_photos_rerun_nothing(made: Survey, tmp_path: Path):
    survey = made.copy(tmp_path, photos=True)
    survey.run(until="metadata")  # they have moved
    for path in survey.photos.iterdir():
        os.utime(path, (1e9, 1e9))
    assert survey.run().stages_run == ()


def test_a_moved_photo_folder_reruns_metadata_alone(made: Survey, tmp_path: Path):
    survey = made.copy(tmp_path, photos=True)
    run = survey.run()
    assert run.stages_run == ("metadata",)
    assert all(photo.path.parent == survey.photos for photo in run.done.photos)


def test_a_changed_parameter_reruns_its_stage_and_what_follows(made: Survey, tmp_path: Path, quick):
    survey = made.copy(tmp_path)
    assert survey.run("match.ratio=0.7").stages_run == ("match", "tracks", "start", "adjust", "export")
    assert survey.run("match.ratio=0.7").stages_run == ()
    assert survey.run("match.ratio=0.7", "adjust.f_scale=2").stages_run == ("adjust", "export")
    # another parameter that changes no output stops there
    assert survey.run("match.ratio=0.7", "adjust.f_scale=2", "tracks.require_connected=true").stages_run == ("tracks",)


def test_tiles_concern_the_adjustment_of_blocks_with_more_photos_alone(
    made: Survey, done: Done, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    # breaks where a small block is solved anew for tiles that it has not, or a large one without those asked for
    survey = made.copy(tmp_path)
    assert survey.run("tiles.chunk_size=200", "tiles.overlap=40", "workers.max_memory=3GB").stages_run == ()
    assert PIPELINE["adjust"].inputs(done).chunk_size is None
    monkeypatch.setitem(vars(done.settings["tiles"]), "chunk_size", NUM_PHOTOS - 1)
    assert PIPELINE["adjust"].inputs(done).chunk_size == NUM_PHOTOS - 1


def test_another_target_crs_reruns_crs_and_export_alone(made: Survey, tmp_path: Path, undrawn: None):
    survey = made.copy(tmp_path)
    before = exported(survey.project)
    run = survey.run("crs.target_crs=EPSG:6344")  # NAD83(2011) / UTM zone 15N
    assert run.stages_run == ("crs", "control", "export")
    assert run.facts["crs"]["epsg"] == 6344
    assert exported(survey.project)["cloud.laz"] != before["cloud.laz"]


def test_a_changed_photo_redoes_its_features_and_its_pairs_alone(made: Survey, tmp_path: Path, quick):
    survey = made.copy(tmp_path, photos=True)
    repaint(survey.photos / FIRST, blacken_a_corner)
    before = inodes(survey.project / "stages")
    run = survey.run()
    anew = made_anew(before, inodes(survey.project / "stages"))
    assert {name for name in anew if "/" in name} == {f"features/{FIRST}", f"match/{FIRST}"}
    assert set(run.stages_run) >= {"metadata", "features", "match", "tracks", "start", "adjust", "export"}


def test_a_removed_photo_costs_the_pairs_of_others_only_where_it_was_one_of_them(made: Survey, tmp_path: Path, quick):
    survey = made.copy(tmp_path, photos=True)
    (survey.photos / FIRST).unlink()
    before = inodes(survey.project / "stages")
    run = survey.run(until="tracks")
    assert {name for name in made_anew(before, inodes(survey.project / "stages")) if "/" in name} == set()
    assert run.done.photos[0].name == "SIM_0002.JPG" and len(run.done.photos) == NUM_PHOTOS - 1
    kept = shutil.ignore_patterns(FIRST)
    shutil.copytree(made.project / "stages" / "features", tmp_path / "fresh" / "stages" / "features", ignore=kept)
    fresh = Survey(survey.photos, tmp_path / "fresh").run(until="tracks")
    assert "match" in fresh.stages_run and "features" not in fresh.stages_run
    assert fingerprint(run.done.tracks) == fingerprint(fresh.done.tracks)
    assert fingerprint(run.done.match) == fingerprint(fresh.done.match)


def test_a_missing_export_is_written_again(made: Survey, tmp_path: Path):
    survey = made.copy(tmp_path)
    before = exported(survey.project)
    (survey.project / "export" / "cloud.csv").unlink()
    assert survey.run().stages_run == ("export",)
    assert exported(survey.project) == before


def test_damaged_records_are_made_anew(made: Survey, tmp_path: Path):
    survey = made.copy(tmp_path)
    before = inodes(survey.project / "stages")
    damaged = {"pairs": "", f"features/{FIRST}": "{", f"match/{FIRST}": '{"key": "one"}', "metadata": "[]"}
    for name, content in damaged.items():
        (survey.project / "stages" / name / "record.json").write_text(content)
    run = survey.run()
    assert run.stages_run == ("metadata", "pairs", "features", "match")
    assert made_anew(before, inodes(survey.project / "stages")) == set(damaged)


def test_a_stopped_run_goes_on_with_the_photos_that_are_left(photos: Path, tmp_path: Path):
    survey, totals = Survey(photos, tmp_path / "project"), []

    def stop(event: Event) -> None:
        if event.stage == "features" and event.kind == "photo" and event.done == 2:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        survey.run(until="features", workers=1, tell=stop)
    facts = json.loads((survey.project / "summary.json").read_text())
    assert facts["stopped"] == {"stage": "features", "reason": "interrupted"}
    before = inodes(survey.project / "stages")
    assert 2 <= sum(name.startswith("features/") for name in before) < NUM_PHOTOS
    run = survey.run(until="features", workers=1, tell=lambda event: totals.append((event.stage, event.total)))
    after = inodes(survey.project / "stages")
    assert run.stages_run == ("features",)
    assert max(total for stage, total in totals if stage == "features") == len(after) - len(before)
    assert made_anew(before, after) == set(after) - set(before) and len(run.done.features) == NUM_PHOTOS
    assert "stopped" not in json.loads((survey.project / "summary.json").read_text())


def test_what_the_adjustment_has_done_when_it_is_stopped_is_kept_for_the_same_settings(
    made: Survey, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    # breaks where a stop loses it, other settings get it, or it is left behind
    survey, seen = made.copy(tmp_path), []
    outputs = load(survey.project / "stages" / "adjust", adjust.Outputs)

    def run(inputs: object, params: object, room: Room) -> object:
        seen.append(sorted(path.name for path in room.folder.iterdir()))
        (room.folder / f"solve-{len(seen)}").touch()
        if len(seen) < 4:
            raise KeyboardInterrupt
        return outputs

    monkeypatch.setattr(adjust, "run", run)
    for changes in (["adjust.f_scale=1.1"], ["adjust.f_scale=1.1"], ["adjust.f_scale=1.2"]):
        with pytest.raises(KeyboardInterrupt):
            survey.run(*changes)
    assert (survey.project / "unfinished").is_dir()
    survey.run("adjust.f_scale=1.2", until="adjust")
    assert seen == [[], ["solve-1"], [], ["solve-3"]]
    assert not (survey.project / "unfinished").exists()


def test_a_run_stops_after_the_stage_that_it_is_told_and_the_project_keeps_the_rest(made: Survey, tmp_path: Path):
    survey = made.copy(tmp_path)
    run = survey.run(until="pairs")
    assert run.stages_run == () and run.done.pairs is not None and run.done.match is None
    assert survey.run().stages_run == ()
    with pytest.raises(JaxbaError, match="stage 'paris': choose one of metadata, crs, control, pairs, features"):
        survey.run(until="paris")


def test_geotags_replace_the_tags_and_another_list_reruns_what_depends_on_it(made: Survey, tmp_path: Path):
    survey = made.copy(tmp_path)
    photos = survey.run(until="crs").done.photos

    def listed(name: str, step_m: float) -> Path:
        rows = [
            f"{photo.name} {photo.position.x:.8f} {photo.position.y:.8f} {photo.position.z_m + step_m:.3f}"
            for photo in photos
            if photo.position is not None
        ]
        (tmp_path / name).write_text("\n".join(["EPSG:4326", *rows, ""]))
        return tmp_path / name

    one, two = listed("geo.txt", 0.0), listed("other.txt", 50.0)
    found = [survey.run(until="crs", geotags=path) for path in (one, two, two)]
    assert [run.stages_run for run in found] == [("metadata", "crs"), ("metadata", "crs"), ()]
    heights = [np.median([photo.position.z_m for photo in run.done.photos]) for run in found]
    assert heights[1] - heights[0] == pytest.approx(50, abs=0.01)
    with pytest.raises(JaxbaError, match=r"none\.txt: there is no such file"):
        survey.run(until="crs", geotags=tmp_path / "none.txt")


@pytest.mark.slow
def test_results_are_the_same_bytes_whatever_the_number_of_workers(made: Survey, tmp_path: Path):
    other = Survey(made.photos, tmp_path / "project")
    other.run(workers=2)
    one, two = exported(made.project), exported(other.project)
    assert list(one) == list(two) and [name for name in one if one[name] != two[name]] == []


@pytest.mark.slow
def test_a_script_that_its_workers_cannot_import_is_told_how_to_be(photos: Path, tmp_path: Path):
    script = tmp_path / "script.py"
    script.write_text(
        "from pathlib import Path\nfrom jaxba.engine import changed\n"
        "from jaxba.pipeline import PIPELINE, run_pipeline\n"
        "settings = changed(PIPELINE.settings, ['workers.workers=1'])\n"
        f"run_pipeline(Path({str(photos)!r}), Path({str(tmp_path / 'out')!r}), settings, until='features')\n"
    )
    ended = subprocess.run([sys.executable, script], capture_output=True, text=True, timeout=300)
    assert ended.returncode == 1 and "In a script, call the pipeline under 'if __name__ ==" in ended.stderr


def test_an_export_folder_that_was_removed_is_written_again(made: Survey, tmp_path: Path, undrawn: None):
    survey = made.copy(tmp_path)
    shutil.rmtree(survey.project / "export")
    assert survey.run().stages_run == ("export",)


def test_parameters_of_the_last_run_lie_in_the_project(made: Survey):
    assert from_toml(made.project / "jaxba.toml", PIPELINE.settings) == changed(
        PIPELINE.settings, [*FAST, "workers.workers=1"]
    )


def test_a_project_folder_is_not_the_photo_folder(tmp_path: Path):
    with pytest.raises(JaxbaError, match="is the folder of the photos; choose another folder for --out"):
        run_pipeline(tmp_path, tmp_path, PIPELINE.settings)
    assert not list(tmp_path.iterdir())  # nothing among the user's photos
