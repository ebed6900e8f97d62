"""SIFT beside other detectors on the same photos: `python -m benchmarks.detectors brighton seneca40 copr`.

Each runs the whole pipeline on an empty project in processes of its own, everything but `features.detector` at its
default. Seconds are those of features and matches together, on the clock and of all cores: on a machine that others use
the latter tell more. What `auto` takes, and why, is printed below each set. Learned detectors need the extra `learned`.
"""

import argparse
import json
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from benchmarks.photos import IMAGES, RESULTS, ROOT
from jaxba.pipeline import PIPELINE, run_pipeline

_COLUMNS = (
    "set", "detector", "adjusted", "good, weak, rejected pairs", "points seen 3 times or more", "median px",
    "fit to GNSS, RMS (m)", "features + match (s)", "of all cores (s)",
)  # fmt: skip


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.detectors", description=__doc__)
    parser.add_argument("sets", nargs="+", help=f"folders below {IMAGES}, or others")
    parser.add_argument("--detectors", nargs="+", default=["sift", "orb"])
    parser.add_argument("--workers", type=int, default=2)
    options = parser.parse_args(arguments)
    print(f"| {' | '.join(_COLUMNS)} |\n|{' --- |' * len(_COLUMNS)}")
    for name in options.sets:
        photos = Path(name) if Path(name).is_dir() else IMAGES / name
        result = {detector: measure(photos, detector, options.workers) for detector in options.detectors}
        for detector, row in result.items():
            print(line(photos.name, detector, row), flush=True)
        result["auto"] = decision(photos)
        print(f"{photos.name}: {result['auto']}", flush=True)
        kept = RESULTS / f"detectors_{photos.name}.json"
        before = json.loads(kept.read_text()) if kept.exists() else {}
        kept.write_text(json.dumps({**before, **result}, indent=1) + "\n")


def measure(photos: Path, detector: str, workers: int) -> dict[str, Any]:
    """Return the figures of a run with one detector; a run that cannot end has the reason in their place."""
    with tempfile.TemporaryDirectory() as folder:
        command = [sys.executable, "-m", "jaxba", "run", str(photos), "--gcp", "none", "--out", f"{folder}/project"]
        command += ["--workers", str(workers), "--set", f"features.detector={detector}"]
        subprocess.run([*command, "--stage", "pairs"], cwd=ROOT, capture_output=True, check=True)
        begun, cpu_begun = time.perf_counter(), _cpu_s()
        subprocess.run([*command, "--stage", "match"], cwd=ROOT, capture_output=True, check=True)
        seconds, cpu = time.perf_counter() - begun, _cpu_s() - cpu_begun
        subprocess.run(command, cwd=ROOT, capture_output=True, check=False)
        facts = json.loads(Path(folder, "project", "summary.json").read_text())
    kept = {name: facts.get(name) for name in ("stopped", "adjust", "match")}
    return {"seconds": seconds, "cpu_seconds": cpu, **kept}


def decision(photos: Path) -> str:
    """Return what `auto` takes for a set, and why."""
    with tempfile.TemporaryDirectory() as folder:
        run = run_pipeline(photos, Path(folder) / "project", PIPELINE.settings, until="pairs", gcp=Path("none"))
        return " ".join(run.done.routing.reasons)


def line(name: str, detector: str, row: dict[str, Any]) -> str:
    missed = row["match"]["missed"]
    weak, rejected = (sum(missed.get(key, 0) for key in keys) for keys in (_WEAK, _REJECTED))
    pairs = f"{missed.get('nothing', 0)}, {weak}, {rejected}"
    adjust = row["adjust"]
    if adjust is None:
        cells = [row["stopped"]["reason"], pairs, "", "", ""]
    else:
        fit = ", ".join(_number(rms) for rms in adjust["gnss_rms_m"] or [None])
        adjusted = f"{adjust['images']} of {adjust['photos']}"
        cells = [adjusted, pairs, str(adjust["points_seen_thrice"]), _number(adjust["median_px"]), fit]
    cells = [name, detector, *cells, f"{row['seconds']:.0f}", f"{row['cpu_seconds']:.0f}"]
    return f"| {' | '.join(cells)} |"


def _number(value: float | None) -> str:
    return "none" if value is None else f"{value:.2f}"


_WEAK, _REJECTED = ("min_good", "min_inlier_ratio"), ("matches", "verified")


def _cpu_s() -> float:
    """Return the seconds that processes which this one started, and theirs, have spent on all cores."""
    spent = resource.getrusage(resource.RUSAGE_CHILDREN)
    return spent.ru_utime + spent.ru_stime


if __name__ == "__main__":
    main()
