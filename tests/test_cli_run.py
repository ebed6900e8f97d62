"""`jaxba run` and `jaxba simulate`: what they print, and their exit codes."""

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from commands import Cli
from small_survey import FAST, NUM_PHOTOS, Survey

from jaxba.cli._run import _result_rows
from jaxba.cli._run_progress import LiveLine
from jaxba.pipeline import NAMES, Event

FLAGS = [part for change in FAST for part in ("--set", change)]


@pytest.fixture
def cli(cli: Cli, monkeypatch: pytest.MonkeyPatch) -> Cli:
    """Run a command as the others do, which leaves the tests' own compile cache as it is."""
    monkeypatch.setattr("jaxba.cli._run.use_compilation_cache", lambda: None)
    return cli


def test_a_second_run_says_that_there_is_nothing_to_do(cli: Cli, made: Survey, tmp_path: Path):
    survey = made.copy(tmp_path)
    code, out, err = cli("run", survey.photos, "--out", survey.project, *FLAGS)
    assert (code, err) == (0, "")
    first, *_ = lines = out.splitlines()
    assert first == "nothing to do: the photos and settings are those of the last run"
    assert f"images      {NUM_PHOTOS} of {NUM_PHOTOS} adjusted" in lines
    assert "CRS         WGS 84 / UTM zone 15N (EPSG:32615)" in lines
    assert any(line.startswith("files       17 files in") for line in lines)
    assert cli("run", survey.photos, "--out", survey.project, *FLAGS, "--quiet") == (0, "", "")


def test_each_stage_that_ran_has_its_lines_none_twice_and_none_too_wide(
    cli: Cli, made: Survey, tmp_path: Path, undrawn: None
):
    survey = made.copy(tmp_path)
    code, out, _ = cli("run", survey.photos, "--out", survey.project, *FLAGS, "--crs", "EPSG:6344")
    lines = out.splitlines()
    assert code == 0 and [line.split()[0] for line in lines if line[:1].strip()][:3] == ["crs", "control", "export"]
    assert max(map(len, lines)) <= 120
    sentences = " ".join(out.split()).split(". ")
    assert sum(sentence.startswith("Heights are metres above") for sentence in sentences) == 1
    assert len([line for line in lines if line.strip()]) == len({line for line in lines if line.strip()})


def test_json_is_one_object_with_what_the_summary_holds(cli: Cli, made: Survey, tmp_path: Path):
    survey = made.copy(tmp_path)
    code, out, err = cli("run", survey.photos, "--out", survey.project, *FLAGS, "--stage", "tracks", "--json")
    assert (code, err) == (0, "") and out.count("\n") == 1
    facts = json.loads(out)
    assert facts == json.loads((survey.project / "summary.json").read_text())
    assert (
        facts["stages_run"] == []
        and list(facts["stages"]) == list(NAMES[: NAMES.index("tracks") + 1])
        and facts["left_out"] == []
    )


def test_a_result_that_all_check_points_contradict_must_not_be_used(
    cli: Cli, made: Survey, tmp_path: Path, undrawn: None
):
    """A base 0.8 m beside its mark (sigma of the shift: 0.16 m): the verdict, exit code 1, and every file is there."""
    survey = made.copy(tmp_path)
    header, *rows = (survey.photos.parent / "gcp_list.txt").read_text().splitlines()
    moved = [" ".join([str(float(east) + 0.8), *rest]) for east, *rest in map(str.split, rows)]
    check = tmp_path / "moved.txt"
    check.write_text("\n".join([header, *moved, ""]))
    code, out, _ = cli("run", survey.photos, "--out", survey.project, *FLAGS, "--gcp", "none", "--check", check)
    assert code == 1 and "DO NOT USE this result: the block stands east -0.9" in " ".join(out.split())
    assert (survey.project / "export" / "control.csv").stat().st_size
    assert json.loads((survey.project / "summary.json").read_text())["adjust"]["usable"] is False


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        (["--stage", "tracking"], "jaxba: stage 'tracking': choose one of metadata, crs"),
        (["--set", "match.rato=0.7"], "jaxba: no parameter match.rato; did you mean ratio?"),
        (["--set", "ratio=0.7"], "jaxba: --set ratio=0.7: write section.name=value"),
        (["--crs", "EPSG:4326"], "jaxba: crs.target_crs=EPSG:4326, EPSG:4326 (WGS 84), is geographic"),
        (["--focal", "12"], "jaxba: metadata.focal=12.0 is out of range; allowed: 100 to 100000"),
        (["--workers", "0"], "jaxba: workers.workers=0 is out of range; allowed: 1 to 1024"),
        (["--max-memory", "2"], "jaxba: workers.max_memory=2.0: give a share"),
        (["--geotags", "gone.txt"], "jaxba: gone.txt: there is no such file"),
        (["--fokal", "12"], "jaxba: Unknown option: --fokal. Did you mean --focal?"),
    ],
)
def test_bad_options_are_one_line_and_exit_code_2(cli: Cli, made: Survey, tmp_path: Path, flags, message: str):
    survey = made.copy(tmp_path)
    code, out, err = cli("run", survey.photos, "--out", survey.project, "--quiet", *FLAGS, *flags)
    assert (code, out) == (2, "") and err.startswith(message) and err.count("\n") == 1


@pytest.mark.parametrize(("name", "message"), [("gone", "no such folder"), ("file", "is a file")])
def test_a_bad_folder_is_one_line_and_exit_code_2(cli: Cli, tmp_path: Path, name: str, message: str):
    (tmp_path / "file").touch()
    code, out, err = cli("run", tmp_path / name, "--out", tmp_path / "project")
    assert (code, out) == (2, "") and message in err and err.count("\n") == 1


@pytest.mark.slow
def test_ctrl_c_ends_with_130_and_the_next_run_goes_on(cli: Cli, photos: Path, tmp_path: Path):
    arguments = ["run", photos, "--out", tmp_path / "project", *FLAGS, "--stage", "features", "--workers", "1"]
    # as `python -m jaxba` does it from a terminal; a shell's background job ignores Ctrl-C, and what it starts
    code = "import signal; signal.signal(signal.SIGINT, signal.default_int_handler); from jaxba.cli import main; main()"
    command = [sys.executable, "-c", code, *map(str, arguments)]
    process = subprocess.Popen(command, stderr=subprocess.PIPE, text=True, start_new_session=True)
    until = time.monotonic() + 120
    features = tmp_path / "project" / "stages" / "features"
    while time.monotonic() < until and not list(features.glob("*/record.json")):
        time.sleep(0.02)
    os.killpg(process.pid, signal.SIGINT)  # as a terminal sends it, to the workers too
    _, err = process.communicate(timeout=60)
    assert process.returncode == 130
    *begun, last = err.splitlines()
    assert begun[0] == "metadata  begins" and f"features  begins, {NUM_PHOTOS} photos" in begun
    assert last == "jaxba: interrupted; what is done is kept, and the same command goes on from there."
    kept = {path: path.stat().st_ino for path in features.glob("*/record.json")}
    assert 1 <= len(kept) < NUM_PHOTOS and not list(features.glob(".*"))
    code, out, _ = cli(*arguments)
    assert code == 0 and out.startswith("features  ")
    assert all(path.stat().st_ino == inode for path, inode in kept.items())


def test_a_terminal_shows_what_runs(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True)
    show = LiveLine()
    for event in (Event("begin", "features"), Event("photo", "features", 3, 8), Event("begin", "adjust")):
        show(event)
    shown = capsys.readouterr().err
    assert [text.strip() for text in shown.split("\r\x1b[K")] == [
        "", "features  ...", "features  3 of 8 photos", "adjust    ...",
    ]  # fmt: skip


def test_simulate_writes_a_survey_and_says_what(cli: Cli, tmp_path: Path):
    code, out, err = cli("simulate", tmp_path / "survey", "--images", 6, "--oblique", 0, "--width", 320)
    assert (code, err) == (0, "")
    assert out.startswith(f"{tmp_path / 'survey' / 'photos'}: 6 photos of 320 x 240 pixels; 5 control points")
    assert (tmp_path / "survey" / "truth.npz").exists()
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "letter.txt").touch()
    code, out, err = cli("simulate", tmp_path / "other")
    assert code == 2 and "is not empty and holds no simulated survey" in err


def test_the_fit_to_positions_without_heights_is_told_of_the_other_axes():
    facts = {
        "images": 4, "photos": 4, "points": 9, "points_seen_thrice": 5, "observations": 30, "median_px": 0.2,
        "inlier_rate": 0.99, "gnss_rms_m": [1.25, 2.5, None], "num_gnss": 4, "findings": [],
    }  # fmt: skip
    assert ("GNSS fit", "RMS 1.25, 2.50 m east, north over 4 positions") in _result_rows(facts, [])
