"""Blocks in tiles beside blocks in one piece: `python -m benchmarks.tiles`.

Synthetic blocks (80% forward, 70% side overlap, one camera) are solved in processes of their own, so that the peak of
memory is that of the solve: tile by tile in all memory, tile by tile under a limit, in one piece by the band. Prints
seconds a step (medians over all steps but the first), the peak of memory, and how seconds grow with images.

`--sizes`: images of the blocks. `--limited`: which of them are solved under `--max-memory` as well. `--whole`: which of
them are solved in one piece as well. `--shapes`: in place of all that, blocks of other shapes beside square ones.

`--covariance`: in place of all that, `jaxba.covariance` of blocks of these sizes, in all memory and under
`--max-memory`.
Prints the seconds of a first call, which compiles, and the peak of memory.

`--statistics`: in place of all that, everything that `jaxba solve --statistics` tells of blocks of these sizes, in
seconds of a first call and of a second: `jaxba.statistics` with the tables of observations, images and points, and
`jaxba.propagate` of the coordinates of ten points; and the peak of memory.

`--batch`: in place of all that, 64 blocks of 20 to 50 images by `solve_batch`, by `solve` one after another, and every
sixteenth of them by scipy. Prints what compiling takes, and the seconds without it (of a batch the median of three).

`--merge`: in place of all that, what it costs to adjust tiles each on its own and merge them. The same block of 400
images, with GNSS, and with control points as well, is adjusted exactly, and in 4 and 9 tiles that are merged, with and
without the global pass. Prints the cost over the exact one, rms distances of camera centres and points from the exact
ones and of check points from the truth, and the seconds of a second run.
"""

import argparse
import dataclasses
import itertools
import json
import math
import resource
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import numpy as np

import jaxba
from benchmarks.peers.scipy_trf import solve_with_scipy
from jaxba import Problem
from jaxba.geometry import Linear
from jaxba.simulation.synthetic import Truth

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
    parser.add_argument("--batch", action="store_true")
    parser.add_argument("--merge", action="store_true")
    parser.add_argument("--covariance", type=int, nargs="*")
    parser.add_argument("--statistics", type=int, nargs="*")
    parser.add_argument("--one", nargs=3, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.one:
        _one(*options.one)
        return
    if options.shapes:
        _shapes()
        return
    if options.statistics is not None:
        _statistics(options.statistics or [500, 2000])
        return
    if options.covariance is not None:
        _covariance(options.covariance or [1000, 4000, 16000], options.max_memory)
        return
    if options.batch:
        _batch()
        return
    if options.merge:
        _merge()
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


def _covariance(sizes: list[int], max_memory: str) -> None:
    """Print the table of covariances."""
    print("| images | observations | memory allowed | seconds | peak of memory (GB) |\n| --- | --- | --- | --- | --- |")
    with tempfile.TemporaryDirectory() as folder:
        for size in sizes:
            file = Path(folder) / f"{size}.npz"
            _run("make", file, {"num_images": size})
            for limit in (None, max_memory):
                found = _run("covariance", file, {"max_memory": limit})
                print(
                    f"| {size} | {found['observations']:,} | {limit or 'all'} | {found['seconds']:.1f} | "
                    f"{found['peak'] / 1e9:.2f} |",
                    flush=True,
                )
            file.unlink()


def _statistics(sizes: list[int]) -> None:
    """Print the table of statistics."""
    print("| images | observations | statistics (s) | again | ten points (s) | again | peak of memory (GB) |")
    print("| --- | --- | --- | --- | --- | --- | --- |")
    with tempfile.TemporaryDirectory() as folder:
        for size in sizes:
            file = Path(folder) / f"{size}.npz"
            _run("make", file, {"num_images": size})
            found = _run("statistics", file, {})
            seconds = " | ".join(f"{found[name]:.1f}" for name in ("first", "again", "points", "points_again"))
            print(f"| {size} | {found['observations']:,} | {seconds} | {found['peak'] / 1e9:.2f} |", flush=True)
            file.unlink()


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
    if way == "covariance":
        begun = time.perf_counter()
        jaxba.covariance(problem, **json.loads(options))
        seconds = time.perf_counter() - begun
        print(json.dumps({"observations": problem.num_observations, "seconds": seconds, "peak": _peak()}))
        return
    if way == "statistics":
        chosen = np.linspace(0, problem.num_points - 1, 10).astype(int)
        told: dict[str, float] = {"observations": problem.num_observations}
        for first, points in (("first", "points"), ("again", "points_again")):
            begun = time.perf_counter()
            of_block = jaxba.statistics(problem)
            for table in (of_block.observations_frame, of_block.images_frame, of_block.points_frame):
                table()
            told[first] = time.perf_counter() - begun
            begun = time.perf_counter()
            jaxba.propagate(lambda p: p.points[chosen], problem)
            told[points] = time.perf_counter() - begun
        print(json.dumps({**told, "peak": _peak()}))
        return
    views = np.bincount(problem.observations.point_index)
    loaded = _peak()
    begun = time.perf_counter()
    if way == "whole":
        solution = jaxba.solve(problem, max_nfev=10, linear_solver="banded")
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


def _batch() -> None:
    sizes = np.random.default_rng(0).integers(20, 51, 64)
    problems = [
        jaxba.synthetic.uav_block(int(size), seed=seed, side_overlap=0.7).problem for seed, size in enumerate(sizes)
    ]
    print(f"64 blocks of 20 to 50 images, {sum(problem.num_observations for problem in problems):,} observations")
    print("| way | compiling (s) | without it (s) | largest cost over the one of solve |")
    print("| --- | --- | --- | --- |")
    one_by_one = [jaxba.solve(problem) for problem in problems]
    exact = np.array([float(solution.final_cost) for solution in one_by_one])
    reports = [solution.report for solution in one_by_one if solution.report is not None]
    compiling = sum(report.seconds_compile for report in reports)
    seconds = sum(report.seconds_setup + report.seconds_solve for report in reports)
    print(f"| solve, one after another | {compiling:.1f} | {seconds:.2f} | |", flush=True)
    for workers in (None, 1):
        rounds = []
        for _ in range(4):
            begun = time.perf_counter()
            found = jaxba.solve_batch(problems, workers=workers)
            rounds.append(time.perf_counter() - begun)
        median = float(np.median(rounds[1:]))
        over = max(float(solution.final_cost) / cost for solution, cost in zip(found, exact, strict=True)) - 1
        way = "solve_batch" if workers is None else f"solve_batch, workers={workers}"
        print(f"| {way} | {max(rounds[0] - median, 0.0):.1f} | {median:.2f} | {over:.0e} |", flush=True)
    some = range(0, 64, 16)
    by_scipy = [solve_with_scipy(problems[number], Linear()) for number in some]
    seconds = sum(record.seconds_total for record in by_scipy) * 64 / len(some)
    over = max(record.final_cost / exact[number] for number, record in zip(some, by_scipy, strict=True)) - 1
    print(f"| scipy, from every sixteenth | | {seconds:.0f} | {over:.0e} |")


def _merge() -> None:
    """Print the table of merged tiles beside the exact adjustment; their seconds hold the solves and the merge."""
    jax.config.update("jax_enable_x64", True)
    print("| priors | tiles | overlap | way | images in pass | cost over exact | centres (m) | points (m) |", end="")
    print(" check points (m) | seconds | compiling (s) |\n|" + 11 * " --- |")
    for priors, num_control in (("GNSS", 0), ("GNSS, control", 8)):
        survey = jaxba.synthetic.uav_block(400, side_overlap=0.7, num_control=num_control, num_check=50)
        problem, truth = survey.problem, survey.truth
        exact, *seconds = _timed(lambda problem=problem: jaxba.solve_tiled(problem).apply(problem))
        _print_merged(f"{priors} | | | `solve_tiled` | ", exact, exact, truth, seconds)
        whole, *seconds = _timed(lambda problem=problem: jaxba.solve(problem).apply(problem))
        _print_merged(f"{priors} | | | `solve` | ", whole, exact, truth, seconds)
        for num_tiles, overlap in ((4, 10), (4, 50), (9, 10), (9, 40)):
            tiles = jaxba.partition(problem, max_images=math.ceil(400 / num_tiles), overlap=overlap).tiles
            assert len(tiles) == num_tiles
            solutions, *of_tiles = _timed(lambda tiles=tiles: jaxba.solve_batch([tile.problem for tile in tiles]))
            done = [
                dataclasses.replace(tile, problem=solution.apply(tile.problem))
                for tile, solution in zip(tiles, solutions, strict=True)
            ]
            for way, global_pass in (("similarity", False), ("and global pass", True)):
                merged, *seconds = _timed(lambda: jaxba.merge_tiles(problem, done, global_pass=global_pass))  # noqa: B023
                total = [a + b for a, b in zip(of_tiles, seconds, strict=True)]
                label = f"{priors} | {num_tiles} | {overlap} | {way} | {merged.shared.sum() if global_pass else ''}"
                _print_merged(label, merged.problem, exact, truth, total)


def _timed(call: Callable[[], Any]) -> tuple[Any, float, float]:
    """Return what a call returns, the seconds of a second call, and by how much the first one took longer."""
    begun = time.perf_counter()
    call()
    middle = time.perf_counter()
    found = call()
    end = time.perf_counter()
    return found, end - middle, max(0.0, (middle - begun) - (end - middle))


def _print_merged(label: str, found: Problem, exact: Problem, truth: Truth, seconds: list[float]) -> None:
    def rms(difference: Any) -> float:
        return float(np.sqrt(np.mean(np.sum(np.asarray(difference) ** 2, axis=1))))

    seen_twice = np.bincount(np.asarray(exact.observations.point_index), minlength=exact.num_points) > 1
    check = truth.check_index
    apart = found.poses.center - exact.poses.center, (found.points - exact.points)[seen_twice]
    figures = [_cost(found) / _cost(exact), *map(rms, apart), rms(found.points[check] - truth.points[check])]
    print(f"| {label} |", *(f"{figure:.4f} |" for figure in figures), *(f"{one:.1f} |" for one in seconds), flush=True)


def _cost(problem: Problem) -> float:
    seen = problem.observations
    errors = jaxba.reprojection_errors(problem) / np.asarray(seen.std_px)
    unknowns = jaxba.ba.Unknowns(problem.poses, problem.cameras.parameters, problem.antenna, problem.points)
    return 0.5 * float(np.sum(errors**2) + sum(np.sum(prior.residual(unknowns) ** 2) for prior in problem.priors))


if __name__ == "__main__":
    main()
