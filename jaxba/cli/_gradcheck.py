"""`jaxba gradcheck`: derivatives of a solve beside central differences, as a table."""

import dataclasses
import sys
from pathlib import Path

from jaxba.ba import GradientRow, check_gradients
from jaxba.cli._options import SolveOptions
from jaxba.cli._solve import fix, make_loss, parse_bounds
from jaxba.cli._text import to_json
from jaxba.engine._compile_cache import use_compilation_cache
from jaxba.io import problem_of_bytes, read_bytes

OVER = 1


def run(file: Path, options: SolveOptions, *, tolerance: float, seed: int) -> int:
    """Check the gradients of the problem in a file and print them; return the exit code."""
    bounds = parse_bounds(options.bounds)
    held = problem_of_bytes(read_bytes(file), str(file))
    loss, problem = make_loss(options, held.loss), fix(held.problem, options.fix).bound(**bounds)
    use_compilation_cache()
    checked = check_gradients(problem, loss=loss, tolerance=tolerance, seed=seed, progress=_say if _watched() else None)
    if options.json:
        print(to_json({**dataclasses.asdict(checked), "passed": checked.passed}))
    else:
        print(checked.table())
        verdict = "within" if checked.passed else "NOT within"
        print(f"Derivatives of the optimum are {verdict} {tolerance:g} of central differences.")
    return 0 if checked.passed else OVER


def _watched() -> bool:
    return sys.stderr.isatty()


def _say(row: GradientRow) -> None:
    print(f"\r{row.name:40}", end="\r", file=sys.stderr, flush=True)
