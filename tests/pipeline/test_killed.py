"""Runs that are killed by SIGKILL, which no program can catch, and then begun again."""

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from small_survey import FAST, Survey

from jaxba.pipeline import NAMES


def command(survey: Survey) -> list[str]:
    sets = [part for change in FAST for part in ("--set", change)]
    options = ["--out", str(survey.project), "--workers", "2", "--quiet", *sets]
    return [sys.executable, "-m", "jaxba", "run", str(survey.photos), *options]


def exported(project: Path) -> dict[str, bytes]:
    files = sorted(path for path in (project / "export").rglob("*") if path.is_file())
    return {path.relative_to(project / "export").as_posix(): path.read_bytes() for path in files}


def kill_when_in(survey: Survey, stage: str, delay: float) -> None:
    """Run until a stage has begun, and kill the run alone, not its workers."""
    with subprocess.Popen(command(survey), start_new_session=True) as process:
        deadline = time.monotonic() + 120
        while json.loads((survey.project / "run.json").read_text())["stage"] != stage:
            assert process.poll() is None and time.monotonic() < deadline
            time.sleep(0.001)
        time.sleep(delay)
        os.kill(process.pid, signal.SIGKILL)
    assert json.loads((survey.project / "run.json").read_text())["stage"] is not None


@pytest.mark.slow
def test_a_run_killed_over_and_over_makes_the_same_bytes_in_the_end(made: Survey, tmp_path: Path):
    """Killed while photos are matched, while tracks are joined and while files are written; `start` and `adjust` are
    kept, since each compiles for seconds."""
    survey = made.copy(tmp_path)
    for stage in ("match", "tracks", "export"):
        shutil.rmtree(survey.project / "stages" / stage)
    shutil.rmtree(survey.project / "export")
    for stage, delay in (("match", 1.2), ("match", 0.1), ("tracks", 0.0), ("export", 0.3)):
        kill_when_in(survey, stage, delay)
    subprocess.run(command(survey), check=True)
    assert exported(survey.project) == exported(made.project)
    leftovers = [path.name for path in survey.project.rglob(".*") if path.name.endswith((".partial", ".old", ".tmp"))]
    assert leftovers == [] and {path.name for path in (survey.project / "stages").iterdir()} == set(NAMES)
