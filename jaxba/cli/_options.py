"""Options of `solve`, as the command line takes them, with the defaults of `jaxba.solve`; of workers; failing."""

import dataclasses
import json
import sys
from pathlib import Path
from typing import Annotated, Literal

from cyclopts import Parameter

NOT_CONVERGED, UNUSABLE, BAD_INPUT, INTERRUPTED = 1, 1, 2, 130  # exit codes

LossName = Literal["linear", "soft_l1", "huber", "cauchy", "arctan", "tukey", "geman_mcclure", "barron"]


def fail(message: str, code: int, *, as_json: bool) -> int:
    """Say on standard error why a command failed, with `--json` as an object on standard output, too; return the code.

    >>> fail("nowhere: there is no such folder.", BAD_INPUT, as_json=True)
    {"error": "nowhere: there is no such folder.", "exit_code": 2}
    2
    """
    print(f"jaxba: {message}", file=sys.stderr)
    if as_json:
        print_error(message, code)
    return code


def print_error(message: str, code: int) -> None:
    """Print the object that stands for the result of a command that failed."""
    print(json.dumps({"error": message, "exit_code": code}))


@dataclasses.dataclass(frozen=True, kw_only=True)
class SolveOptions:
    """What `solve` takes beside its file; the help texts say what each is."""

    loss: Annotated[
        LossName | None, Parameter(help="Robust loss of the reprojections. [default: the file's own, else linear]")
    ] = None
    f_scale: Annotated[
        float | None,
        Parameter(
            help="Where the loss turns robust, in sigmas of a pixel; linear has none. [default: the file's own, else 1]"
        ),
    ] = None
    alpha: Annotated[float | None, Parameter(help="Shape of the barron loss: 2 least squares, lower is stronger.")] = (
        None
    )
    method: Annotated[Literal["lm", "dogleg"], Parameter(help="lm is Levenberg-Marquardt.")] = "lm"
    linear_solver: Annotated[
        Literal["auto", "dense", "banded", "cg"], Parameter(help="How the reduced system is solved.")
    ] = "auto"
    tiled: Annotated[
        bool,
        Parameter(
            negative="",
            show_default=False,
            help="Tile by tile: the same solution, for blocks of any size. After Ctrl-C the same command goes on.",
        ),
    ] = False
    max_memory: Annotated[
        str | None,
        Parameter(
            help="With --tiled: memory that this may take, such as 4GB, or a share of the machine's; what does not fit "
            "lies in files meanwhile. [default: 80% of what is free]"
        ),
    ] = None
    device: Annotated[
        Literal["cpu", "gpu"] | None,
        Parameter(help="Where the solve computes, in float64. [default: a GPU that jax sees, else the CPU]"),
    ] = None
    max_nfev: Annotated[int, Parameter(help="The most steps tried.")] = 500
    ftol: Annotated[float, Parameter(help="Stop when the cost changes by less than this share.")] = 1e-8
    xtol: Annotated[float, Parameter(help="Stop when the unknowns change by less than this share.")] = 1e-8
    gtol: Annotated[float, Parameter(help="Stop when no entry of the gradient is larger.")] = 1e-10
    bounds: Annotated[
        tuple[str, ...],
        Parameter(
            negative="",
            show_default=False,
            help="Bounds on an intrinsic: focal=0.9,1.1 (times the start value) or k1=-0.1,0.1; once for each.",
        ),
    ] = ()
    fix: Annotated[
        tuple[str, ...],
        Parameter(
            negative="",
            show_default=False,
            help="What to hold fixed: intrinsics, poses, points, or intrinsics by name, separated by commas.",
        ),
    ] = ()
    reject: Annotated[
        Literal["mad"] | None, Parameter(help="Leave out errors over median + factor x MAD, and solve again.")
    ] = None
    rounds: Annotated[int | None, Parameter(help="How often --reject does so at most. [default: 2]")] = None
    mad_factor: Annotated[float, Parameter(help="Factor of the MAD, for the inlier rate and --reject.")] = 2.5
    statistics: Annotated[
        bool,
        Parameter(
            negative="",
            show_default=False,
            help="After the solve: variance components, tests of all measurements, correlations of the intrinsics.",
        ),
    ] = False
    datum: Annotated[
        Literal["priors", "inner"],
        Parameter(
            help="What tells --statistics a block's place: its priors and what is fixed, or inner constraints over the "
            "points, under which sigmas are those of the photos alone."
        ),
    ] = "priors"
    estimate_weights: Annotated[
        bool,
        Parameter(
            negative="",
            show_default=False,
            help="Estimate the sigma of each kind of measurement from its residuals, and solve until it stands.",
        ),
    ] = False
    out: Annotated[
        Path | None,
        Parameter(
            help="Output: a tile, or BAL text where it ends in .txt or .txt.bz2; of several files a folder. [default: "
            "NAME.solved.npz beside FILE, or beside the export that FILE lies in]"
        ),
    ] = None
    json: Annotated[
        bool, Parameter(negative="", show_default=False, help="Print one JSON object on standard output.")
    ] = False
    quiet: Annotated[bool, Parameter(negative="", show_default=False, help="Print no progress and no summary.")] = False
    verbose: Annotated[bool, Parameter(negative="", show_default=False, help="Print a line a step.")] = False


@dataclasses.dataclass(frozen=True, kw_only=True)
class WorkerOptions:
    """What `run` takes for its workers, in place of the table [workers] of its settings."""

    workers: Annotated[int | None, Parameter(help="Processes for features and matches. [default: one a core]")] = None
    max_memory: Annotated[
        str | None,
        Parameter(
            help="Memory for all of them, and to solve in tiles: a share of the machine's, or an amount: 4GB, 800MB. "
            "[default: 0.8]"
        ),
    ] = None
    time_limit: Annotated[
        float | None,
        Parameter(help="Seconds that a photo may take in a stage. [default: 60 and 10 a megapixel or pair]"),
    ] = None
    max_failed: Annotated[
        float | None,
        Parameter(help="Stop when more photos fail in a stage: a share below 1, or a number. [default: 0.5]"),
    ] = None
    max_store: Annotated[
        str | None,
        Parameter(help="What features may take on the disk: a share of what is free, or an amount. [default: 0.9]"),
    ] = None

    scheduler: Annotated[
        str | None,
        Parameter(help="Address of a dask scheduler, tcp://host:8786: its workers do features and matches."),
    ] = None
    scheduler_file: Annotated[
        str | None, Parameter(help="The same, by the file that the scheduler wrote for its workers.")
    ] = None

    def changes(self) -> list[str]:
        """Return what was given as changes of settings."""
        given = {field.name: getattr(self, field.name) for field in dataclasses.fields(self)}
        return [f"workers.{name}={value}" for name, value in given.items() if value is not None]
