"""Many frames of which five are bad, each in its own way: the rest is adjusted, and the five are named.

Two of them make the decoder crash and hang. That is planted in the workers from outside: Python reads
`sitecustomize.py` from its path as it starts.
"""

import json
import os
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image
from small_survey import repaint

from jaxba.engine import Resources
from jaxba.engine._workers import memory_for
from jaxba.pipeline import PIPELINE
from jaxba.report import project_settings, status
from jaxba.report.diagnosis import diagnose
from jaxba.simulation.photos import Params, write_survey

TRUNCATED, BLACK, CRASHES, HANGS, LARGE = (f"SIM_{i:04d}.JPG" for i in (6, 11, 16, 3, 21))
NUM_FRAMES, NUM_BAD = 24, 5
CRASH_MARK, HANG_MARK = b"planted crash", b"planted hang"
PLANT = f"""
import multiprocessing, os, signal, time
import PIL.Image

opened = PIL.Image.open

def planted(file, *arguments, **named):
    if multiprocessing.parent_process() is not None:
        content = open(file, "rb").read()
        if content.endswith({CRASH_MARK!r}):
            os.kill(os.getpid(), signal.SIGSEGV)
        if content.endswith({HANG_MARK!r}):
            time.sleep(3600)
    return opened(file, *arguments, **named)

PIL.Image.open = planted
"""
TIME_LIMIT_S, MEMORY = 6, "1.5GB"  # the others take a tenth of it
QUICK = ("features.nfeatures=2000", "features.contrast_threshold=0.04", "adjust.max_rounds=2")


@dataclass(frozen=True)
class Ended:
    """How a command ended: its exit code, its events, and its lines on standard error that are none."""

    code: int
    events: list[dict[str, Any]]
    other: list[str]

    def of_kind(self, kind: str, **facts: object) -> list[dict[str, Any]]:
        return [event for event in self.events if event["event"] == kind and facts.items() <= event.items()]


def run(folder: Path, *arguments: str, planted: bool) -> Ended:
    command = [sys.executable, "-m", "jaxba", "run", "photos", "--workers", "2"]
    command += [part for change in QUICK for part in ("--set", change)]
    command += ["--max-memory", MEMORY, "--time-limit", str(TIME_LIMIT_S), "--quiet", "--log-json", *arguments]
    path = [str(folder / "plant")] if planted else []
    path += [str(Path(__file__).parents[2]), *filter(None, [os.environ.get("PYTHONPATH")])]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(path)}
    done = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, timeout=540)
    lines = done.stderr.splitlines()
    assert done.stdout == ""
    return Ended(done.returncode, [json.loads(a) for a in lines if a[:1] == "{"], [a for a in lines if a[:1] != "{"])


@pytest.fixture(scope="module")
def survey(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("frames")
    write_survey(folder, Params(num_images=NUM_FRAMES, num_oblique=0, width_px=480))
    photos = folder / "photos"
    content = (photos / TRUNCATED).read_bytes()
    (photos / TRUNCATED).write_bytes(content[: len(content) // 2])
    repaint(photos / BLACK, np.zeros_like)
    repaint(photos / LARGE, lambda pixels: np.array(Image.fromarray(pixels).resize((2880, 2160))))
    for name, mark in ((CRASHES, CRASH_MARK), (HANGS, HANG_MARK)):
        with open(photos / name, "ab") as file:
            file.write(mark)
    (folder / "plant").mkdir()
    (folder / "plant" / "sitecustomize.py").write_text(PLANT)
    return folder


@pytest.fixture(scope="module")
def first(survey: Path) -> Ended:
    return run(survey, planted=True)


@pytest.mark.slow
def test_the_good_frames_are_adjusted(survey: Path, first: Ended):
    facts = json.loads((survey / "project" / "summary.json").read_text())
    assert first.code == 0 and facts["adjust"]["images"] == NUM_FRAMES - NUM_BAD and facts["adjust"]["median_px"] < 0.5
    assert first.of_kind("run_end")[0]["stages_run"] == facts["stages_run"]


@pytest.mark.slow
def test_the_five_others_are_named_with_the_reason(survey: Path, first: Ended):
    facts = json.loads((survey / "project" / "summary.json").read_text())
    reasons = {entry["name"]: entry["reason"] for entry in facts["left_out"]}
    expected = {
        TRUNCATED: "cannot be decoded (image file is truncated",
        BLACK: "no texture",
        CRASHES: "its worker process was killed by SIGSEGV twice",
        HANGS: f"took longer than {TIME_LIMIT_S} s; raise --time-limit, or look at the file",
        LARGE: "needs about 1.9 GB of memory, 1.5 GB are allowed; raise --max-memory",
    }
    assert memory_for(2880 * 2160 / 1e6) > Resources(max_memory=MEMORY).memory_bytes
    assert set(reasons) == set(expected)
    assert all(words in reasons[name] for name, words in expected.items()), reasons
    failed = {event["name"]: event["reason"] for event in first.of_kind("item_failed")}
    assert failed == {name: reasons[name] for name in expected if name != BLACK}  # it was decoded, and is empty


@pytest.mark.slow
def test_status_and_diagnosis_name_them_too(survey: Path, first: Ended):
    found = status(survey / "project", PIPELINE, project_settings(survey / "project", PIPELINE))
    assert found.is_done and {left.name for _, left in found.left_out} == {TRUNCATED, BLACK, CRASHES, HANGS, LARGE}
    stage = next(stage for stage in found.stages if stage.stage == "features")
    assert (stage.num_done, stage.num_all) == (NUM_FRAMES - 3, NUM_FRAMES)  # three without a record
    causes = {diagnosis.name: diagnosis for diagnosis in diagnose(survey / "project", PIPELINE)}
    assert causes["out of memory"].figures["photos"] == [LARGE] and causes["crash"].figures["photos"] == [CRASHES]
    assert "SIGSEGV" in causes["crash"].cause and "--max-memory" in causes["out of memory"].cure


@pytest.mark.slow
def test_each_line_of_the_log_is_one_event_and_they_tell_the_whole_run(first: Ended):
    assert first.other == []
    stages = [event["stage"] for event in first.of_kind("stage_begin")]
    assert stages == [event["stage"] for event in first.of_kind("stage_end")] and stages[0] == "metadata"
    assert [event["event"] for event in (first.events[0], first.events[-1])] == ["run_begin", "run_end"]
    done = first.of_kind("progress", stage="features")
    assert [event["done"] for event in done] == list(range(NUM_FRAMES + 1)) and {event["total"] for event in done} == {
        NUM_FRAMES
    }
    shares = [event["share"] for event in done]
    assert shares == sorted(shares) and shares[0] == 0 and shares[-1] == pytest.approx(1)
    assert any(event["text"].startswith("round 1, median") for event in first.of_kind("step", stage="adjust"))
    times = [event["time"] for event in first.events]
    assert times == sorted(times) and all(time.endswith("Z") for time in times)


@pytest.mark.slow
def test_a_further_run_tries_again_what_was_the_machines_fault(survey: Path, first: Ended):
    again = run(survey, "--stage", "features", planted=False)
    assert again.code == 0
    assert again.of_kind("stage_end", stage="features")[0]["total"] == 3
    assert [event["name"] for event in again.of_kind("item_failed")] == [LARGE]
    left = {entry["name"] for entry in again.of_kind("stage_end", stage="features")[0]["left_out"]}
    assert left == {TRUNCATED, BLACK, LARGE}
