"""`jaxba solve` of several files: a batch, each file a problem of its own, written as soon as it is solved.

A solved tile tells in its extras what it was made from, so that a second call goes on with what is left. Files are read
and solved so many at a time as have `_AT_A_TIME` observations. One that cannot be read or solved is named, and the
others are solved all the same.
"""

import contextlib
import dataclasses
import hashlib
import os
import sys
import threading
import time
from collections.abc import Generator, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from jaxba import __version__
from jaxba._atomic import cannot_write, refuse_same_file, refuse_unwritable
from jaxba._errors import JaxbaError
from jaxba.ba import Problem, Rejected, Solution, prepare, rejecting, solve_batch
from jaxba.cli._options import BAD_INPUT, INTERRUPTED, NOT_CONVERGED, SolveOptions
from jaxba.cli._result import Run, batch_summary, facts, hints
from jaxba.cli._solve import (
    check_loss_options,
    check_numbers,
    default_output,
    fix,
    judged,
    make_loss,
    parse_bounds,
    rounds_of,
    tile_of,
    use_device,
)
from jaxba.cli._text import many, to_json
from jaxba.engine._compile_cache import use_compilation_cache
from jaxba.geometry import AbstractLoss
from jaxba.io import (
    place_of,
    problem_of_bytes,
    read_bytes,
    write_tile,
)

_AT_A_TIME = 1e7
_FROM, _RESULT, _CONVERGED = "solved_from", "solved_result", "solved_converged"  # extras
_OUTPUT_OPTIONS = ("out", "json", "quiet", "verbose", "statistics", "estimate_weights")


@dataclasses.dataclass(eq=False)
class _Work:
    """A file of the batch: its problem as read and as the options change it, and the problem that is solved next.

    - `made_from`: fingerprint of the file and the options.
    """

    file: Path
    out: Path
    made_from: str
    given: Problem
    problem: Problem
    loss: AbstractLoss
    place: Mapping[str, np.ndarray]
    steps: Generator[Problem, Solution, Rejected]
    next: Problem


def run(files: Sequence[Path], options: SolveOptions) -> int:
    """Adjust the problems in these files, write and print each as soon as it is known; return the exit code."""
    check_loss_options(options)
    parse_bounds(options.bounds)
    check_numbers(options)
    _refuse_for_several(options)
    outputs, passed_over = _outputs(files, options.out)
    use_compilation_cache()
    use_device(options.device)
    batch = _Batch(outputs, options)
    begun = time.perf_counter()
    interrupted = False
    try:
        batch.solve()
    except KeyboardInterrupt:
        interrupted = True
    told = {
        "num_files": len(outputs),
        "passed_over": [str(file) for file in passed_over],
        "interrupted": interrupted,
        "seconds_total": time.perf_counter() - begun,
        "files": [batch.told[file] for file in outputs if file in batch.told],
    }
    if options.json:
        print(to_json(told))
    elif not options.quiet:
        print(batch_summary(told))
    if interrupted:
        print("jaxba: interrupted; the same command goes on with the files that are left.", file=sys.stderr)
        return INTERRUPTED
    if any("error" in entry for entry in told["files"]):
        return BAD_INPUT
    return 0 if all(entry["converged"] for entry in told["files"]) else NOT_CONVERGED


class _Batch:
    """The files and what became of each, by file: its facts, or its error."""

    def __init__(self, outputs: Mapping[Path, Path], options: SolveOptions) -> None:
        self.outputs, self.options = outputs, options
        self.told: dict[Path, dict[str, Any]] = {}
        self._lock = threading.Lock()  # solutions come from several threads

    def solve(self) -> None:
        """Solve all files, as many at a time as fit."""
        waiting: list[_Work] = []
        for work in self._read():
            waiting.append(work)
            if sum(work.problem.num_observations for work in waiting) >= _AT_A_TIME:
                self._solve_all(waiting)
                waiting = []
        self._solve_all(waiting)

    def _read(self) -> Iterator[_Work]:
        """Yield what is to be solved; say of the others that they are done already, or why they cannot be solved."""
        for file, out in self.outputs.items():
            with self._named(file):
                data = read_bytes(file)
                made_from = _hashed(data, self.options)
                before = _made_from(out)
                if before.get(_FROM) == made_from:
                    self._tell(file, _facts_before(file, out, before), "done already")
                    continue
                held = problem_of_bytes(data, str(file))
                loss = make_loss(self.options, held.loss)
                problem = fix(held.problem, self.options.fix).bound(**parse_bounds(self.options.bounds))
                steps = rejecting(problem, rounds=rounds_of(self.options), mad_factor=self.options.mad_factor)
                yield _Work(
                    file, out, made_from, held.problem, problem, loss, place_of(held.extras), steps, next(steps)
                )

    def _solve_all(self, works: Sequence[_Work]) -> None:
        """Solve these, those under the same loss together."""
        of_loss: dict[str, list[_Work]] = {}
        for work in works:
            of_loss.setdefault(repr(work.loss), []).append(work)
        for alike in of_loss.values():
            self._solve(alike, alike[0].loss)

    def _solve(self, works: Sequence[_Work], loss: AbstractLoss) -> None:
        """Solve these under one loss, in rounds where observations are rejected."""
        options = self.options
        while works:
            able = []
            for work in works:
                with self._named(work.file):
                    prepare(work.next)  # a problem that cannot be solved must not stop the others
                    able.append(work)
            again: list[_Work] = []

            def take(number: int, solution: Solution, able: list[_Work] = able, again: list[_Work] = again) -> None:
                work = able[number]
                try:
                    work.next = work.steps.send(solution)
                    again.append(work)
                except StopIteration as end:
                    self._finish(work, end.value)

            solve_batch(
                [work.next for work in able],
                loss=loss,
                method=options.method,
                max_nfev=options.max_nfev,
                ftol=options.ftol,
                xtol=options.xtol,
                gtol=options.gtol,
                callback=take,
            )
            works = [work for work in able if work in again]  # in the order of the files, whichever came first

    def _finish(self, work: _Work, found: Rejected) -> None:
        """Write a solution and say so."""
        solution = found.solution
        of_work = {
            _FROM: np.array(work.made_from),
            _RESULT: np.array(solution.result),
            _CONVERGED: np.array(solution.converged),
        }
        extras = {**work.place, **judged(found), **of_work}
        write_tile(work.out, solution.apply(work.problem), loss=work.loss, extras=extras)
        reports = [round_.report for round_ in found.solutions if round_.report is not None]
        seconds = sum(report.seconds_setup + report.seconds_compile + report.seconds_solve for report in reports)
        done = Run(work.file, work.out, work.given, work.problem, found, work.loss, self.options, seconds)
        if self.options.json:
            told = facts(done)
        else:
            told = {
                "input": str(work.file),
                "output": str(work.out),
                "result": solution.result,
                "converged": solution.converged,
                "advice": solution.advice,
                "hints": hints(done),
                "dropped": done.report.dropped.summary(),
                "median_error_px": found.quality.median_px,
            }
        self._tell(
            work.file,
            {"state": "solved", **told},
            f"{solution.result}, cost {solution.initial_cost:.6g} -> {solution.final_cost:.6g} in "
            f"{many(int(solution.num_steps), 'step')}, median error {found.quality.median_px:.3f} px, {seconds:.1f} s",
        )

    @contextlib.contextmanager
    def _named(self, file: Path) -> Iterator[None]:
        """Keep an error of one file from ending the batch, and say it."""
        try:
            yield
        except JaxbaError as error:
            text = str(error) if str(error).startswith(str(file)) else f"{file}: {error}"
            with self._lock:
                self.told[file] = {"input": str(file), "state": "failed", "error": text}
                print(f"jaxba: {text}", file=sys.stderr)

    def _tell(self, file: Path, told: dict[str, Any], text: str) -> None:
        """Keep the facts of a file, and print a line."""
        with self._lock:
            self.told[file] = told
            if not self.options.quiet:
                count = f"{len(self.told):>{len(str(len(self.outputs)))}} of {len(self.outputs)}"
                stream = sys.stderr if self.options.json else sys.stdout
                print(f"{count}  {file}: {text}", file=stream, flush=True)


def _outputs(files: Sequence[Path], folder: Path | None) -> tuple[dict[Path, Path], list[Path]]:
    """Return the output of each file, and the files that are results of others, as `tiles/*.npz` finds them.

    Raises `JaxbaError` where two files have one output, and where an output cannot be written.
    """
    tiles = {}
    for file in files:
        tile = tile_of(file)
        if os.path.realpath(tile) in (os.path.realpath(other) for other in tiles):
            raise JaxbaError(f"{file}: is named twice; name it once.")
        tiles[tile] = default_output(tile) if folder is None else folder / default_output(tile).name
    results = {os.path.realpath(out) for tile, out in tiles.items() for out in (out, default_output(tile))}
    passed_over = [tile for tile in tiles if os.path.realpath(tile) in results]
    outputs = {tile: out for tile, out in tiles.items() if tile not in passed_over}
    if folder is not None:
        if folder.suffix in (".npz", ".txt", ".bz2") and not folder.is_dir():
            raise JaxbaError(f"--out {folder}: several files are solved; name a folder for their results.")
        try:
            folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise cannot_write(folder, error) from error
    of_output: dict[str, Path] = {}
    for tile, out in outputs.items():
        refuse_same_file(tile, out)
        other = of_output.setdefault(os.path.realpath(out), tile)
        if other != tile:
            raise JaxbaError(f"{tile}: its result {out} would be that of {other}, too; solve them into two folders.")
        refuse_unwritable(out)
    return outputs, passed_over


def _refuse_for_several(options: SolveOptions) -> None:
    for is_given, name in (
        (options.tiled, "--tiled"),
        (options.linear_solver != "auto", f"--linear-solver {options.linear_solver}"),
        (options.verbose, "--verbose"),
        (options.statistics, "--statistics"),
        (options.estimate_weights, "--estimate-weights"),
    ):
        if is_given:
            raise JaxbaError(f"{name}: is for one file, and several are solved at a time here; leave it out.")


def _hashed(data: bytes, options: SolveOptions) -> str:
    """Return a fingerprint of a file's bytes, the options that its result depends on, and jaxba's version."""
    by_name = {name: value for name, value in dataclasses.asdict(options).items() if name not in _OUTPUT_OPTIONS}
    state = hashlib.sha256(data)
    state.update(repr((__version__, sorted(by_name.items()))).encode())
    return state.hexdigest()[:32]


def _made_from(out: Path) -> dict[str, Any]:
    """Return how an earlier batch says that its result came about; nothing where there is no whole one."""
    with contextlib.suppress(JaxbaError, KeyError):
        extras = problem_of_bytes(read_bytes(out), str(out)).extras
        return {name: extras[name].item() for name in (_FROM, _RESULT, _CONVERGED)}
    return {}


def _facts_before(file: Path, out: Path, before: Mapping[str, Any]) -> dict[str, Any]:
    return {
        "state": "done already",
        "input": str(file),
        "output": str(out),
        "result": before[_RESULT],
        "converged": bool(before[_CONVERGED]),
    }
