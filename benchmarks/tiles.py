"""Blocks in tiles beside blocks in one piece: `python -m benchmarks.tiles`.

Synthetic blocks (80% forward, 70% side overlap, one camera) are solved in processes of their own, so that the peak of
memory is that of the solve: tile by tile in all memory, tile by tile under a limit, in one piece by the band. Prints
seconds a step (medians over all steps but the first), the peak of memory, and how seconds grow with images.

`--sizes`: images of the blocks. `--limited`: which of them are solved under `--max-memory` as well. `--whole`: which of
them are solved in one piece as well.
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

import jaxba


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--sizes", type=int, nargs="*", default=[1000, 4000, 16000])
    parser.add_argument("--limited", type=int, nargs="*", default=[16000])
    parser.add_argument("--whole", type=int, nargs="*", default=[1000, 4000])
    parser.add_argument("--max-memory", default="4GB")
    parser.add_argument("--one", nargs=3, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.one:
        _one(*options.one)
        return
    print("| images | observations | way | set-up (s) | a step (s) | steps | result | peak of memory (GB) |")
    print("| --- | --- | --- | --- | --- | --- | --- | --- |")
    seconds: dict[str, dict[int, float]] = {}
    with tempfile.TemporaryDirectory() as folder:
        for size in sorted({*options.sizes, *options.limited, *options.whole}):
            file = Path(folder) / f"{size}.npz"
            _run("make", file, str(size))
            ways = (("tiles", options.sizes), (options.max_memory, options.limited), ("whole", options.whole))
            for way in [name for name, sizes in ways if size in sizes]:
                found = _run(way, file, "")
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


def _run(way: str, file: Path, size: str) -> dict[str, float]:
    command = [sys.executable, "-m", "benchmarks.tiles", "--one", way, str(file), size]
    return json.loads(subprocess.run(command, check=True, capture_output=True, text=True).stdout)


def _one(way: str, file: str, size: str) -> None:
    """Make a block, or solve it in one way, and print what was measured as JSON."""
    if way == "make":
        jaxba.write_tile(file, jaxba.synthetic.uav_block(int(size), side_overlap=0.7).problem)
        print("{}")
        return
    problem = jaxba.read_tile(file)
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
        "peak": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024.0,
    }
    print(json.dumps(found))


if __name__ == "__main__":
    main()
