"""Every benchmark with one command: `python -m benchmarks.run`, or `--only speed --sizes 100,500 --cases bal21,uav100`.

Speed: each case is solved by all solvers in turn, `--repeats` times over, in one process on `--cores` cores; jaxba once
more before, to compile. The figure is the time until a step first brings a cost within 0.1% of the best final cost that
any solver reached, preprocessing included, building the problem and compiling left out; the median over the repeats.
Final costs are those of `benchmarks.cost`, from the values that each solver returned. Memory and the first call are
measured in a process for each. A solver that cannot do a case is left out of it, and the last lines say why.
"""

import argparse
import json
import os
import platform
import statistics
from collections.abc import Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Any

RESULTS = Path(__file__).parent / "results"
WITHIN = 1.001
_LIBRARIES = ("jax", "jaxlib", "numpy", "scipy", "optimistix", "pyceres", "pycolmap")


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.run", description=__doc__)
    parser.add_argument("--only", choices=["speed"], default="speed", help="which benchmark")
    parser.add_argument("--sizes", default="100,500,2000", help="numbers of images of the synthetic blocks")
    parser.add_argument("--cases", default="", help="names of cases, e.g. bal21,uav500_outliers; all by default")
    parser.add_argument("--solvers", default="jaxba,ceres", help="of jaxba, ceres, gtsam, scipy")
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--max-nfev", type=int, default=100, help="most steps of each solver")
    parser.add_argument("--scipy-seconds", type=float, default=60.0, help="scipy is stopped after this time")
    parser.add_argument("--cores", type=int, default=2)
    parser.add_argument("--no-memory", action="store_true", help="skip memory and first call")
    options = parser.parse_args(arguments)
    if hasattr(os, "sched_setaffinity"):  # before jax and Ceres count the cores
        os.sched_setaffinity(0, sorted(os.sched_getaffinity(0))[: options.cores])

    from benchmarks.cases import BAL_FOLDER, speed_cases

    cases = speed_cases([int(size) for size in options.sizes.split(",")])
    if "bal21" not in cases:
        print(f"BAL's problems are left out: there is no ../shared/data/{BAL_FOLDER.name}.\n")
    names = options.cases.split(",") if options.cases else list(cases)
    unknown = [name for name in names if name not in cases]
    if unknown:
        parser.error(f"cases {', '.join(unknown)}: choose from {', '.join(cases)}, or add a size with --sizes.")
    RESULTS.mkdir(exist_ok=True)
    print(_HEADER)
    left_out: dict[str, list[str]] = {}
    for name in names:
        result = run_case(cases[name], options)
        if result["solvers"]:
            (RESULTS / f"{name}.json").write_text(json.dumps(result, indent=1) + "\n")
        for row in result["solvers"]:
            print(_line(result, row), flush=True)
        for solver, reason in result["left_out"].items():
            left_out.setdefault(f"{solver} is left out: {reason}.", []).append(name)
    for reason, cases_of in left_out.items():
        print(f"\n{', '.join(cases_of)}: {reason}")


def run_case(case: Any, options: argparse.Namespace) -> dict[str, Any]:
    """Return sizes, versions, one entry a solver and why others are left out, ready for JSON."""
    from benchmarks.cost import cost_of
    from benchmarks.memory import measure
    from benchmarks.solvers import solver, why_left_out

    problem = case.make()
    asked = options.solvers.split(",")
    left_out = {name: why for name in asked if (why := why_left_out(name, problem, case.loss))}
    names = [name for name in asked if name not in left_out]
    solvers = {name: solver(name, max_nfev=options.max_nfev, scipy_seconds=options.scipy_seconds) for name in names}
    load_before = os.getloadavg()[0]
    compile_s = solvers["jaxba"](problem, case.loss).seconds_compile if "jaxba" in solvers else 0.0
    records = {name: [] for name in names}
    for _ in range(options.repeats):
        for name, solve in solvers.items():
            if name != "scipy" or not records[name]:  # scipy once: minutes
                records[name].append(solve(problem, case.loss))
    costs = {name: cost_of(problem, case.loss, runs[-1].values) for name, runs in records.items()}
    target = WITHIN * min(costs.values()) if costs else None
    entries = []
    for name, runs in records.items():
        last = runs[-1]
        seconds_to = [run.seconds_to(target) for run in runs]
        entries.append(
            {
                "solver": last.solver,
                "seconds_to_target": _finite(statistics.median(seconds_to)),
                "seconds_to_target_each": [_finite(seconds) for seconds in seconds_to],
                "seconds_total": statistics.median(run.seconds_total for run in runs),
                "seconds_preprocess": statistics.median(run.seconds_preprocess for run in runs),
                "seconds_compile": compile_s if name == "jaxba" else last.seconds_compile,
                "num_iterations": last.num_iterations,
                "termination": last.termination,
                "initial_cost": last.initial_cost,
                "final_cost": costs[name],
                "final_cost_own": last.final_cost,
                "memory": None if options.no_memory or name == "scipy" else measure(name, case.name),
                "history": last.history,
            }
        )
    ceres = next((e["seconds_to_target"] for e in entries if e["solver"].startswith("Ceres")), None)
    for entry in entries:
        own = entry["seconds_to_target"]
        entry["ratio_to_ceres"] = own / ceres if own and ceres else None
    return {
        "case": case.name,
        "loss": type(case.loss).__name__,
        "camera": type(problem.cameras).__name__,
        "num_images": problem.num_images,
        "num_cameras": problem.num_cameras,
        "num_points": problem.num_points,
        "num_observations": problem.num_observations,
        "dtype": "float64",
        "cores": options.cores,
        "repeats": options.repeats,
        "load_before": round(load_before, 2),
        "target_cost": target,
        "versions": {
            "python": platform.python_version(),
            **{name: version(name) for name in (*_LIBRARIES, *(name for name in names if name == "gtsam"))},
        },
        "left_out": left_out,
        "solvers": entries,
    }


_HEADER = """\
| case | images, points, observations | solver | to 0.1% (s) | ratio | all (s) | before step 1 (s) | steps \
| final cost | above best | peak MB (before) | first call (s) |
| --- | --- | --- | --- | --- | --- | --- | --- | --- | --- | --- | --- |"""


def _line(result: dict[str, Any], entry: dict[str, Any]) -> str:
    above = WITHIN * entry["final_cost"] / result["target_cost"] - 1
    memory = entry["memory"]
    differs = abs(entry["final_cost_own"] / entry["final_cost"] - 1) > 1e-6
    own = f" (its own figure: {entry['final_cost_own']:.1f})" if differs else ""
    cells = [
        result["case"],
        f"{result['num_images']}, {result['num_points']}, {result['num_observations']}",
        entry["solver"],
        _number(entry["seconds_to_target"], ".3f", "never"),
        _number(entry["ratio_to_ceres"], ".2f"),
        f"{entry['seconds_total']:.3f}",
        f"{entry['seconds_preprocess']:.3f}",
        str(entry["num_iterations"]),
        f"{entry['final_cost']:.2f}{own}",
        f"{100 * above:.4f}%",
        f"{memory['peak_mb']:.0f} ({memory['before_mb']:.0f})" if memory else "",
        f"{memory['first_call_s']:.1f}" if memory else "",
    ]
    return f"| {' | '.join(cells)} |"


def _number(value: float | None, form: str, otherwise: str = "") -> str:
    return otherwise if value is None else format(value, form)


def _finite(seconds: float) -> float | None:
    """JSON has no infinity: None is never."""
    return seconds if seconds < float("inf") else None


if __name__ == "__main__":
    main()
