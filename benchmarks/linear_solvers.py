"""The rule that chooses how the reduced system is solved: `python -m benchmarks.linear_solvers`.

Solves synthetic blocks with each way and prints the median seconds of a step; `auto` names the choice of the rule in
`jaxba/ba/_plan.py`.
"""

import itertools
import statistics

import jaxba

_SIZES = (50, 100, 200, 400, 800)
_WAYS = ("dense", "banded", "cg")


def main() -> None:
    print(f"| images | unknowns | {' | '.join(f'{way} (ms)' for way in _WAYS)} | auto |")
    print("| --- | --- | --- | --- | --- | --- |")
    for size in _SIZES:
        problem = jaxba.synthetic.uav_block(size).problem
        cells = [f"{1000 * _seconds(problem, way):.1f}" for way in _WAYS]
        chosen = jaxba.make_plan(problem).shape.linear_solver
        print(f"| {size} | {6 * size + 8} | {' | '.join(cells)} | {chosen} |", flush=True)


def _seconds(problem: jaxba.Problem, way: str) -> float:
    jaxba.solve(problem, linear_solver=way, max_nfev=1)
    report = jaxba.solve(problem, linear_solver=way, max_nfev=4).report
    assert report is not None  # the problem is concrete
    ends = [step.seconds for step in report.history]
    return statistics.median(b - a for a, b in itertools.pairwise(ends))


if __name__ == "__main__":
    main()
