"""Peak memory and first call of one solver, in a process of its own: `python -m benchmarks.memory jaxba uav500`.

Prints one JSON object: the peak of the whole process, what was in use when the solve began (interpreter, libraries, the
problem), and the seconds of the first call, compile included.
"""

import json
import subprocess
import sys
import time
from pathlib import Path
from typing import TypedDict

from benchmarks.cases import speed_cases
from benchmarks.solvers import solver


class Footprint(TypedDict):
    """Memory in MB (2^20 bytes), time in seconds."""

    peak_mb: float
    before_mb: float
    first_call_s: float


def measure(solver_name: str, case_name: str) -> Footprint:
    """Return the footprint of one solve, measured in a new process."""
    command = [sys.executable, "-m", "benchmarks.memory", solver_name, case_name]
    done = subprocess.run(command, cwd=Path(__file__).parents[1], capture_output=True, text=True, check=True)
    return json.loads(done.stdout)


def _measure_here(solver_name: str, case_name: str) -> Footprint:
    size = "".join(c for c in case_name if c.isdigit())
    case = speed_cases([int(size)])[case_name]
    problem = case.make()
    solve = solver(solver_name)
    before_mb = _mb("VmRSS")
    start = time.perf_counter()
    solve(problem, case.loss)
    return {
        "peak_mb": _mb("VmHWM"),
        "before_mb": before_mb,
        "first_call_s": time.perf_counter() - start,
    }


def _mb(field: str) -> float:
    """Return VmRSS (in use now) or VmHWM (its peak) of this process; Linux only.

    Not `getrusage`: the peak that it gives is inherited from the process that started this one.
    """
    lines = Path("/proc/self/status").read_text().splitlines()
    return next(int(line.split()[1]) for line in lines if line.startswith(field)) / 1024


if __name__ == "__main__":
    print(json.dumps(_measure_here(*sys.argv[1:])))
