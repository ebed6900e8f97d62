"""Blocks in tiles beside blocks in one piece: `python -m benchmarks.tiles`.

Synthetic blocks (80% forward, 70% side overlap, one camera) are solved in processes of their own, so that the peak of
memory is that of the solve: tile by tile in all memory, tile by tile under a limit, in one piece by the band. Prints
seconds a step (medians over all steps but the first), the peak of memory, and how seconds grow with images.

`--sizes`: images of the blocks. `--limited`: which of them are solved under `--max-memory` as well. `--whole`: which of
them are solved in one piece as well. `--shapes`: in place of all that, blocks of other shapes beside square ones.
"""

import argparse
import itertools
import json
import math
import resource
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np

import jaxba

_SHAPES: dict[str, dict[str, Any]] = {
    "square": {"num_images": 1000},
    "corridor, two lines": {"num_images": 1000, "num_lines": 2},
    "two crossing directions": {"num_images": 1000, "flight": "crossing"},
    "a second flight": {"num_images": 1000, "flight": "second"},
    "square of 200": {"num_images": 200, "points_per_image": 279.5},
    "orbit": {"num_images": 200, "flight": "orbit", "mean_track_length": 15.8},
    "square, tracks as long": {"num_images": 200, "points_per_image": 95.0, "mean_track_length": 15.8},
}
"""Options of `uav_block`; the ones after a square are compared with it, and have as many observations."""
_ROUNDS = 2  # over all shapes, of which the best counts: other work on the machine only adds


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--sizes", type=int, nargs="*", default=[1000, 4000, 16000])
    parser.add_argument("--limited", type=int, nargs="*", default=[16000])
    parser.add_argument("--whole", type=int, nargs="*", default=[1000, 4000])
    parser.add_argument("--max-memory", default="4GB")
    parser.add_argument("--shapes", action="store_true")
    parser.add_argument("--one", nargs=3, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.one:
        _one(*options.one)
        return
    if options.shapes:
        _shapes()
        return
    print("| images | observations | way | set-up (s) | a step (s) | steps | result | peak of memory (GB) |")
    print("| --- | --- | --- | --- | --- | --- | --- | --- |")
    seconds: dict[str, dict[int, float]] = {}
    with tempfile.TemporaryDirectory() as folder:
        for size in sorted({*options.sizes, *options.limited, *options.whole}):
            file = Path(folder) / f"{size}.npz"
            _run("make", file, {"num_images": size})
            ways = (("tiles", options.sizes), (options.max_memory, options.limited), ("whole", options.whole))
            for way in [name for name, sizes in ways if size in sizes]:
                found = _run(way, file)
                seconds.setdefault(way, {})[size] = found["step"]
                print(
                    f"| {size} | {found['observations']:,} | {way} | {found['setup']:.1f} | {found['step']:.2f} | "
                    f"{found['steps']} | {found['result']} | {found['peak'] / 1e9:.2f} |",
                    flush=True,
                )
            file.unlink()
    for way, by_size in seconds.items():
        for (small, before), (large, after) in itertools.pairwise(sorted(by_size.items())):
            growth = math.log(after / before) / math.log(large / small)
            print(f"{way}: from {small} to {large} images seconds a step grow with images to the {growth:.2f}")


def _shapes() -> None:
    """Print the seconds a step and the memory of every shape, and their ratios to those of the square before it."""
    with tempfile.TemporaryDirectory() as folder:
        files = {name: Path(folder) / f"{number}.npz" for number, name in enumerate(_SHAPES)}
        for name, file in files.items():
            _run("make", file, _SHAPES[name])
        rounds = [{name: _run("tiles", file) for name, file in files.items()} for _ in range(_ROUNDS)]
    print("| shape | images | observations | pairs each | a step (s) | ratio | memory (kB each) | ratio |")
    print("| --- | --- | --- | --- | --- | --- | --- | --- |")
    square = 0.0, 0.0
    for name, options in _SHAPES.items():
        found = rounds[0][name]
        step = min(of[name]["step"] for of in rounds)
        memory = min(of[name]["peak"] - of[name]["loaded"] for of in rounds) / found["observations"]
        if name.startswith("square") and "mean_track_length" not in options:
            square = step / found["observations"], memory
        print(
            f"| {name} | {options['num_images']} | {found['observations']:,} | {found['pairs']:.1f} | {step:.2f} | "
            f"{step / found['observations'] / square[0]:.2f} | {memory / 1e3:.2f} | {memory / square[1]:.2f} |"
        )


def _run(way: str, file: Path, options: dict[str, Any] | None = None) -> dict[str, float]:
    command = [sys.executable, "-m", "benchmarks.tiles", "--one", way, str(file), json.dumps(options)]
    return json.loads(subprocess.run(command, check=True, capture_output=True, text=True).stdout)


def _one(way: str, file: str, options: str) -> None:
    """Make a block, or solve it in one way, and print what was measured as JSON."""
    if way == "make":
        jaxba.write_tile(file, jaxba.synthetic.uav_block(**json.loads(options), side_overlap=0.7).problem)
        print("{}")
        return
    problem = jaxba.read_tile(file)
    views = np.bincount(problem.observations.point_index)
    loaded = _peak()
    begun = time.perf_counter()
    if way == "whole":
        solution = jaxba.solve(problem, max_nfev=10)
    else:
        solution = jaxba.solve_tiled(problem, max_nfev=10, max_memory=None if way == "tiles" else way)
    assert solution.report is not None  # the problem is concrete
    total, report = time.perf_counter() - begun, solution.report
    ends = [step.seconds for step in report.history]
    found = {
        "observations": problem.num_observations,
        "setup": total - ends[-1],
        "step": statistics.median([b - a for a, b in itertools.pairwise(ends)][1:]),
        "steps": len(ends) - 1,
        "result": solution.result,
        "pairs": float(np.sum(views * (views - 1) / 2) / problem.num_observations),
        "loaded": loaded,
        "peak": _peak(),
    }
    print(json.dumps(found))


def _peak() -> float:
    """Return the most bytes that this process has held."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024.0


if __name__ == "__main__":
    main()
