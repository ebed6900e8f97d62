"""`jaxba solve`: read, adjust, write, tell."""

import contextlib
import dataclasses
import functools
import math
import os
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np

from jaxba._atomic import refuse_same_file, refuse_unwritable
from jaxba._errors import JaxbaError
from jaxba.ba import (
    HistoryStep,
    Problem,
    Rejected,
    Reweighted,
    Statistics,
    solve_and_reject,
    solve_and_reweight,
    solve_tiled,
    statistics,
)
from jaxba.cli import _progress
from jaxba.cli._options import INTERRUPTED, NOT_CONVERGED, SolveOptions
from jaxba.cli._result import Run, facts, name_of_loss, summary
from jaxba.cli._text import to_json
from jaxba.engine._compile_cache import use_compilation_cache
from jaxba.engine._project import EXPORT, is_project
from jaxba.geometry import LOSSES, AbstractLoss, Barron, Linear
from jaxba.io import (
    Contents,
    place_of,
    problem_of_bytes,
    read_bytes,
    what_bal_cannot_hold,
    write_bal,
    write_tile,
)

_ROUNDS, _TILE = 2, "tile.npz"
_FILE_ENDINGS = (".bz2", ".txt", ".npz")
_BAL_ENDINGS = (".txt", ".txt.bz2")
_KINDS = ("intrinsics", "poses", "points")


def run(file: Path, options: SolveOptions) -> int:
    """Adjust the problem in a file, write the result, print it; return the exit code."""
    bounds = parse_bounds(options.bounds)
    check_loss_options(options)
    check_numbers(options)
    file = tile_of(file)
    out = options.out or default_output(file)
    refuse_same_file(file, out)
    held = problem_of_bytes(read_bytes(file), str(file))
    given, loss = held.problem, make_loss(options, held.loss)
    problem = fix(given, options.fix).bound(**bounds)
    _check_output(out, given)
    use_compilation_cache()
    use_device(options.device)
    begin = time.perf_counter()
    standing = _checkpoint(out, options)
    if standing is not None and standing.exists():
        print(f"jaxba: going on from {standing}, where a solve before this one stopped.", file=sys.stderr)
    weights = _weights(problem, loss, options)
    problem = problem if weights is None else weights.problem
    found = _adjust(problem, loss, options, standing)
    seconds = time.perf_counter() - begin
    _write(out, problem, found, loss, held)
    told = _statistics(problem, found, loss, options)
    done = Run(file, out, given, problem, found, loss, options, seconds, told, weights)
    if options.json:
        print(to_json(facts(done)))
    elif not options.quiet:
        print(summary(done))
    if found.solution.result == "interrupted":
        again = "" if standing is None else "; the same command goes on from there"
        print(f"jaxba: interrupted; {out} holds the values reached so far{again}.", file=sys.stderr)
        return INTERRUPTED
    return 0 if found.solution.converged else NOT_CONVERGED


def use_device(name: str | None) -> None:
    """Let jax compute on a kind of device; raise `JaxbaError` where it sees none. None leaves the choice to jax."""
    if name is None:
        return
    try:
        device = jax.devices(name)[0]
    except RuntimeError as error:
        raise JaxbaError(
            f"--device {name}: jax sees no such device here ({error}). For an NVIDIA GPU: pip install 'jax[cuda12]' on "
            "a machine that has one; without --device the solve runs on what there is."
        ) from error
    jax.config.update("jax_default_device", device)


def tile_of(file: Path) -> Path:
    """Return the file itself, or the tile in the export of the project that it is.

    Raises `JaxbaError` for a folder that is no project, and for a project without an export.
    """
    if not file.is_dir():
        return file
    if not is_project(file):
        raise JaxbaError(f"{file}: a folder, and not that of a project; name a tile.npz or a BAL file.")
    tile = file / EXPORT / _TILE
    if not tile.is_file():
        raise JaxbaError(f"{file}: the project has no {EXPORT}/{_TILE} yet; let jaxba run finish first.")
    return tile


def make_loss(options: SolveOptions, own: AbstractLoss | None = None) -> AbstractLoss:
    """Return the loss that was asked for, and where nothing was, that of the file.

    Raises:
        JaxbaError: a scale that is not positive, or a shape for a loss that has none.
    """
    check_loss_options(options)
    loss = own or Linear()
    if options.loss is not None and not isinstance(loss, LOSSES[options.loss]):
        loss = LOSSES[options.loss](f_scale=1.0)
    if options.f_scale is not None:
        loss = dataclasses.replace(loss, f_scale=options.f_scale)
    if options.alpha is None:
        return loss
    if not isinstance(loss, Barron):
        raise _without_shape(options.alpha, name_of_loss(loss))
    return dataclasses.replace(loss, alpha=options.alpha)


def check_loss_options(options: SolveOptions) -> None:
    """Raise `JaxbaError` for what no loss has, before a file is read."""
    if options.f_scale is not None and not 0 < options.f_scale < math.inf:
        raise JaxbaError(f"--f-scale {options.f_scale:g}: give a positive number, such as 1.")
    if options.alpha is not None and not options.alpha <= 2:
        raise JaxbaError(f"--alpha {options.alpha:g}: give 2 (least squares) or less.")
    if options.alpha is not None and options.loss not in (None, "barron"):
        raise _without_shape(options.alpha, options.loss)


def _without_shape(alpha: float, loss: str) -> JaxbaError:
    return JaxbaError(f"--alpha {alpha:g}: only --loss barron has a shape; this is --loss {loss}.")


def parse_bounds(texts: Sequence[str]) -> dict[str, tuple[float, float]]:
    """Return the bounds in texts such as `focal=0.9,1.1`.

    Raises:
        JaxbaError: another form, or one name twice.

    >>> parse_bounds(["focal=0.9,1.1", "k1=-0.1,0.1"])
    {'focal': (0.9, 1.1), 'k1': (-0.1, 0.1)}
    """
    bounds: dict[str, tuple[float, float]] = {}
    for text in texts:
        name, _, values = text.partition("=")
        try:
            low, high = (float(value) for value in values.split(","))
        except ValueError as error:
            raise JaxbaError(f"--bounds {text}: give a name, = and two numbers, as in focal=0.9,1.1.") from error
        if name in bounds:
            raise JaxbaError(f"--bounds {text}: {name} has bounds already; give one pair.")
        bounds[name] = (low, high)
    return bounds


def fix(problem: Problem, texts: Sequence[str]) -> Problem:
    """Return the problem with what the texts name held fixed: kinds, or intrinsics by name, separated by commas."""
    names = [name for text in texts for name in text.split(",")]
    parameters = type(problem.cameras).parameter_names()
    for name in names:
        if name not in (*_KINDS, *parameters):
            model = type(problem.cameras).__name__
            raise JaxbaError(
                f"--fix {name}: choose from {', '.join(_KINDS)} and the {model} camera's {', '.join(parameters)}."
            )
    return problem.fix(
        poses="poses" in names,
        points="points" in names,
        intrinsics="intrinsics" in names or [name for name in names if name in parameters],
    )


def default_output(file: Path) -> Path:
    """Return where the result of a file goes if nothing is said: beside it, or beside the export of a project.

    What lies in an export is what a run wrote there, and the next export replaces it.

    >>> default_output(Path("a/tile.npz")).as_posix(), default_output(Path("problem-49-pre.txt.bz2")).as_posix()
    ('a/tile.solved.npz', 'problem-49-pre.solved.npz')
    """
    name = file.name
    for ending in _FILE_ENDINGS:
        name = name.removesuffix(ending)
    folder = file.parent
    if folder.absolute().name == EXPORT and is_project(folder.absolute().parent):
        folder = Path(os.path.normpath(folder / ".."))
    return folder / f"{name or file.name}.solved.npz"


def check_numbers(options: SolveOptions) -> None:
    """Refuse what could only end in nonsense, before anything is computed."""
    if options.max_nfev < 1:
        raise JaxbaError(f"--max-nfev {options.max_nfev}: give 1 or more.")
    for name in ("ftol", "xtol", "gtol"):
        value = getattr(options, name)
        if not 0 <= value < math.inf:
            raise JaxbaError(f"--{name} {value:g}: give 0 (never stop for it) or a small positive number.")
    if not 0 < options.mad_factor < math.inf:
        raise JaxbaError(f"--mad-factor {options.mad_factor:g}: give a positive number, such as 2.5.")
    if options.max_memory is not None and not options.tiled:
        raise JaxbaError(f"--max-memory {options.max_memory}: only a solve in tiles keeps to a limit. Add --tiled.")
    if options.tiled and (options.method != "lm" or options.linear_solver != "auto"):
        given = f"--method {options.method}" if options.method != "lm" else f"--linear-solver {options.linear_solver}"
        raise JaxbaError(f"{given}: --tiled solves by Levenberg-Marquardt on its own tree alone; leave it out.")
    if options.datum != "priors" and not options.statistics:
        raise JaxbaError(f"--datum {options.datum}: is that of the statistics. Add --statistics.")
    if options.rounds is not None and options.reject is None:
        raise JaxbaError(f"--rounds {options.rounds}: rounds of what? Add --reject mad.")
    if options.rounds is not None and options.rounds < 0:
        raise JaxbaError(f"--rounds {options.rounds}: give 0 or more.")


def _check_output(out: Path, given: Problem) -> None:
    """Refuse, before a solve that may take minutes, an output that cannot be written after it."""
    refuse_unwritable(out)
    if out.name.endswith(_BAL_ENDINGS):
        lost = what_bal_cannot_hold(given)
        if lost:
            raise JaxbaError(f"{out}: BAL cannot hold {'; '.join(lost)}. Name a tile (--out NAME.npz) instead.")


def _checkpoint(out: Path, options: SolveOptions) -> Path | None:
    """Return the file in which a solve in tiles keeps where it stands; rounds of rejection are many solves, without."""
    return out.with_name(f"{out.name}.checkpoint") if options.tiled and not rounds_of(options) else None


def _adjust(problem: Problem, loss: AbstractLoss, options: SolveOptions, checkpoint: Path | None) -> Rejected:
    """Solve, with rounds of rejection if asked for; a plain solve comes back as a result of no rounds."""
    with contextlib.ExitStack() as stack:
        callback: Callable[[HistoryStep], None] | None = None
        if options.verbose:
            callback = functools.partial(_progress.print_step, to_stderr=options.json)
        elif sys.stderr.isatty() and not options.quiet:
            callback = stack.enter_context(_progress.line())
        settings = {
            "loss": loss,
            "max_nfev": options.max_nfev,
            "ftol": options.ftol,
            "xtol": options.xtol,
            "gtol": options.gtol,
            "callback": callback,
        }
        if options.tiled:
            settings |= {"solver": solve_tiled, "max_memory": options.max_memory, "checkpoint": checkpoint}
        else:
            settings |= {"method": options.method, "linear_solver": options.linear_solver}
        return solve_and_reject(problem, rounds=rounds_of(options), mad_factor=options.mad_factor, **settings)


def _weights(problem: Problem, loss: AbstractLoss, options: SolveOptions) -> Reweighted | None:
    """Return the problem with its sigmas as they were estimated; None where that is not asked for.

    Raises `JaxbaError` together with rejection, and where there are no statistics.
    """
    if not options.estimate_weights:
        return None
    if options.reject:
        raise JaxbaError("--estimate-weights does not go with --reject: give a robust --loss, which lets go by itself.")
    stops = {"max_nfev": options.max_nfev, "ftol": options.ftol, "xtol": options.xtol, "gtol": options.gtol}
    by: dict[str, Any] = {"method": options.method, "linear_solver": options.linear_solver}
    if options.tiled:
        by = {"solver": functools.partial(solve_tiled, max_memory=options.max_memory)}
    return solve_and_reweight(problem, loss=loss, max_memory=options.max_memory, **by, **stops)


def rounds_of(options: SolveOptions) -> int:
    """Return how many rounds of rejection were asked for at most."""
    asked = _ROUNDS if options.rounds is None else options.rounds
    return asked if options.reject else 0


def _statistics(
    problem: Problem, found: Rejected, loss: AbstractLoss, options: SolveOptions
) -> Statistics | str | None:
    """Return the statistics of what the last round used, or why there are none; None where they are not asked for."""
    if not options.statistics:
        return None
    used = np.asarray(found.used)
    adjusted = found.solution.apply(problem)
    if not used.all():
        seen = jax.tree.map(lambda values: np.asarray(values)[used], adjusted.observations)
        adjusted = dataclasses.replace(adjusted, observations=seen)
    try:
        return statistics(adjusted, loss=loss, datum=options.datum, max_memory=options.max_memory)
    except JaxbaError as error:  # the solution is there and written
        return str(error)


def _write(out: Path, problem: Problem, found: Rejected, loss: AbstractLoss, held: Contents) -> None:
    """Write the solution: a tile, with what the options fixed and bounded, or BAL text, which has no room for that."""
    if out.name.endswith(_BAL_ENDINGS):
        write_bal(out, found.solution.apply(held.problem))
        return
    write_tile(out, found.solution.apply(problem), loss=loss, extras=place_of(held.extras) | judged(found))


def judged(found: Rejected) -> dict[str, np.ndarray]:
    """Return how the observations came out, as extras of a solved tile."""
    return {
        "error_px": found.quality.error_px,
        "is_inlier": np.asarray(found.quality.is_inlier),
        "is_used": np.asarray(found.used),
    }
