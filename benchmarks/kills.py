"""Runs killed at random moments and begun again: are the results the same bytes?

    python -m benchmarks.kills [--kills 30] [--seed 0]

A small simulated survey is run once to its end by 1, by 2 and by 4 workers. Then, for each kill, a run in a new project
is killed by SIGKILL, which no program can catch, at a random moment of a stage, the stages in turn; every second time
its workers are killed with it. A kill that comes after the run's end does not count and is drawn again. The same
command then runs to its end, and every file of its export is compared with the first one's. Exit code 1 where one
differs. The kills are written to `benchmarks/results/kills.json`.
"""

import argparse
import json
import os
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from jaxba.pipeline import NAMES
from jaxba.simulation.photos import Params, write_survey

_POLL_S = 0.001
_RESULT = Path(__file__).parent / "results" / "kills.json"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--kills", type=int, default=30)
    parser.add_argument("--seed", type=int, default=0)
    given = parser.parse_args()
    draw = random.Random(given.seed)
    with tempfile.TemporaryDirectory() as folder:
        sys.exit(_measure(Path(folder), given.kills, draw))


def _measure(folder: Path, kills: int, draw: random.Random) -> int:
    photos = write_survey(folder / "survey", Params(num_images=10, num_oblique=2, width_px=640)).photos
    _finish(_command(photos, folder / "warm", 2))  # compiles
    expected, seconds, differing = {}, {}, 0
    for workers in (2, 1, 4):
        project = folder / f"workers{workers}"
        stages = _stage_seconds(_command(photos, project, workers), project)
        found = _exported(project)
        expected, seconds = expected or found, seconds or stages
        same = found == expected
        differing += not same
        print(f"{workers} workers: {len(found)} files, {_said(same)}", flush=True)
    hits = []
    for number in range(kills):
        stage, reached = NAMES[number % len(NAMES)], None
        while reached is None:
            delay = draw.uniform(0, seconds[stage])
            project = folder / f"kill{number}"
            shutil.rmtree(project, ignore_errors=True)
            command = _command(photos, project, workers=1 + number % 2)
            reached = _killed(command, project, stage, delay, with_workers=number % 4 < 2)
        _finish(command)
        same = _exported(project) == expected
        differing += not same
        hits.append({"stage": reached, "seconds": round(delay, 3), "after_begin_of": stage, "same_bytes": same})
        print(f"kill {number + 1} in stage {reached}, {delay:.2f} s after {stage} began: {_said(same)}", flush=True)
    equal = sum(hit["same_bytes"] for hit in hits)
    print(f"{equal} of {kills} killed runs end in the same bytes")
    _RESULT.write_text(json.dumps({"workers": [2, 1, 4], "files": len(expected), "kills": hits}, indent=1) + "\n")
    return int(differing > 0)


def _said(same: bool) -> str:
    return "the same bytes" if same else "OTHER BYTES"


def _command(photos: Path, project: Path, workers: int) -> list[str]:
    options = ["--out", str(project), "--workers", str(workers), "--set", "features.nfeatures=2000", "--quiet"]
    return [sys.executable, "-m", "jaxba", "run", str(photos), *options]


def _finish(command: list[str]) -> None:
    subprocess.run(command, check=True)


def _stage_now(project: Path) -> str | None:
    try:
        return json.loads((project / "run.json").read_text())["stage"]
    except (OSError, ValueError):
        return None


def _stage_seconds(command: list[str], project: Path) -> dict[str, float]:
    """Run to the end; return how long each stage took."""
    begun: dict[str, float] = {}
    with subprocess.Popen(command) as process:
        while process.poll() is None:
            begun.setdefault(_stage_now(project) or "", time.perf_counter())
            time.sleep(_POLL_S)
    assert process.returncode == 0
    ends = [*list(begun.values())[1:], time.perf_counter()]
    took = {stage: end - start for (stage, start), end in zip(begun.items(), ends, strict=True)}
    return {stage: took.get(stage, _POLL_S) for stage in NAMES}


def _killed(command: list[str], project: Path, stage: str, delay: float, *, with_workers: bool) -> str | None:
    """Kill a run so long after a stage began; return the stage that it had reached, None where it had ended."""
    with subprocess.Popen(command, start_new_session=True) as process:
        wanted = set(NAMES[NAMES.index(stage) :])
        while process.poll() is None and _stage_now(project) not in wanted:
            time.sleep(_POLL_S)
        time.sleep(delay)
        reached = _stage_now(project)
        if with_workers:
            os.killpg(process.pid, signal.SIGKILL)
        else:
            process.kill()
    return reached


def _exported(project: Path) -> dict[str, bytes]:
    files = sorted(path for path in (project / "export").rglob("*") if path.is_file())
    return {path.relative_to(project / "export").as_posix(): path.read_bytes() for path in files}


if __name__ == "__main__":
    main()
