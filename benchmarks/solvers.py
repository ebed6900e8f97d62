"""Every solver by its name on the command line: `solve(problem, loss) -> Record`.

Imports happen in the functions, so that each process loads one side's libraries only and memory is each side's own.
"""

import dataclasses
import functools
import time
from collections.abc import Callable

from benchmarks.record import Record, Values
from jaxba.ba import Problem
from jaxba.geometry import AbstractLoss

Solver = Callable[[Problem, AbstractLoss], Record]


def solver(name: str, *, max_nfev: int = 100, scipy_seconds: float = 60.0) -> Solver:
    """Return `jaxba`, `ceres`, `gtsam` or `scipy`, each told to stop after `max_nfev` steps."""
    if name == "jaxba":
        return functools.partial(solve_with_jaxba, max_nfev=max_nfev)
    if name == "ceres":
        from benchmarks.peers.ceres import solve_with_ceres

        return functools.partial(solve_with_ceres, max_num_iterations=max_nfev)
    if name == "gtsam":
        from benchmarks.peers.gtsam_lm import solve_with_gtsam

        return functools.partial(solve_with_gtsam, max_num_iterations=max_nfev)
    if name == "scipy":
        from benchmarks.peers.scipy_trf import solve_with_scipy

        return functools.partial(solve_with_scipy, max_nfev=max_nfev, time_limit_s=scipy_seconds)
    raise ValueError(f"solver {name!r}: choose from jaxba, ceres, gtsam, scipy.")


def why_left_out(name: str, problem: Problem, loss: AbstractLoss) -> str | None:
    """Return why a side does not solve a problem here, in words, or None."""
    if name != "gtsam":
        return None
    try:
        from benchmarks.peers import gtsam_lm
    except ImportError as error:
        return f"gtsam cannot be imported ({error}); install the extra benchmarks, its wheels are for Linux and macOS"
    return gtsam_lm.why_left_out(problem, loss)


def solve_with_jaxba(problem: Problem, loss: AbstractLoss, *, max_nfev: int = 100) -> Record:
    """Solve with jaxba at its defaults.

    All time of the call that is neither compiling nor in its history counts as preprocessing, also what comes after the
    last step.
    """
    import jaxba

    start = time.perf_counter()
    solution = jaxba.ba.solve(problem, loss=loss, max_nfev=max_nfev)
    report = solution.report
    assert report is not None  # the problem is concrete
    seconds_total = time.perf_counter() - start - report.seconds_compile
    last = report.history[-1]
    return Record(
        solver=f"jaxba {jaxba.__version__}",
        initial_cost=float(solution.initial_cost),
        final_cost=float(solution.final_cost),
        history=[dataclasses.asdict(step) for step in report.history],
        seconds_preprocess=max(0.0, seconds_total - last.seconds),
        seconds_compile=report.seconds_compile,
        seconds_total=seconds_total,
        termination=solution.result,
        num_iterations=last.step,
        values=Values.of(solution.apply(problem)),
    )
