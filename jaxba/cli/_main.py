"""Parse the command line, call the command, turn errors into one line and an exit code.

Exit codes: 0 done and converged; 1 not converged (what was reached is written all the same); 2 bad input or options;
130 interrupted by Ctrl-C (likewise written, once the first step was begun).
"""

import os
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Literal

from cyclopts import App, CycloptsError, Parameter

from jaxba import __version__
from jaxba._errors import JaxbaError
from jaxba.cli._options import BAD_INPUT, INTERRUPTED, LossName, SolveOptions, WorkerOptions, fail

_EXIT_CODES = "Exit codes: 0 converged, 1 not converged (written all the same), 2 bad input or options, 130 Ctrl-C."

app = App(
    name="jaxba",
    help="Bundle adjustment on JAX.",
    version=__version__,
    help_format="plaintext",
    result_action="return_value",
    suppress_keyboard_interrupt=False,
)

_File = Annotated[Path, Parameter(help="A tile.npz, or a BAL problem, text or bz2.")]
_Problem = Annotated[Path, Parameter(help="A tile.npz, a BAL problem, text or bz2, or a project: its exported tile.")]
_Config = Annotated[
    Path | None, Parameter(help="Parameters in TOML, a table a stage. [default: jaxba.toml in the working folder]")
]
_Set = Annotated[
    tuple[str, ...],
    Parameter(name="--set", negative="", show_default=False, help="A parameter: match.ratio=0.7; once for each."),
]
_Project = Annotated[Path, Parameter(help="The project folder of a run.")]
_Json = Annotated[bool, Parameter(negative="", show_default=False, help="Print one JSON object on standard output.")]


def main(argv: Sequence[str] | None = None) -> None:
    """Run the command in `argv` (the process's own arguments if None) and exit with its code."""
    arguments = sys.argv[1:] if argv is None else argv
    as_json = "--json" in arguments
    try:
        code = app(arguments, exit_on_error=False, print_error=False)
        sys.stdout.flush()
    except CycloptsError as error:
        code = fail(" ".join(str(error).split()) + " See jaxba --help.", BAD_INPUT, as_json=as_json)
    except JaxbaError as error:
        code = fail(str(error), BAD_INPUT, as_json=as_json)
    except KeyboardInterrupt:
        code = fail("interrupted; nothing was written.", INTERRUPTED, as_json=as_json)
    except BrokenPipeError:  # `jaxba info FILE | head`: whoever read the output has gone
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        code = 1
    sys.exit(code or 0)


@app.command(
    help="Adjust a problem, print a summary, write the adjusted tile. Several files are a batch, each a problem of its "
    "own; what is solved already is not solved again.\n\n" + _EXIT_CODES
)
def solve(
    file: _Problem,
    /,
    *more: Annotated[Path, Parameter(help="More of them: tiles/*.npz.")],
    options: Annotated[SolveOptions | None, Parameter(name="*")] = None,
) -> int:
    if more:
        from jaxba.cli._solve_batch import run as run_batch

        return run_batch((file, *more), options or SolveOptions())
    from jaxba.cli._solve import run

    return run(file, options or SolveOptions())


@app.command(
    help="Cut a block into tiles that overlap: writes tiles/tile_000.npz and so on, and a picture of them.\n\n"
    "Exit codes: 0 written, 2 bad input or options."
)
def partition(
    file: _Problem,
    /,
    *,
    max_observations: Annotated[
        float | None, Parameter(help="Observations of a tile's own images, in place of --max-images: 2e6.")
    ] = None,
    max_images: Annotated[
        int | None, Parameter(help="Images of its own that a tile has at most. [default: tiles.chunk_size, 500]")
    ] = None,
    by: Annotated[
        Literal["space", "flight-line"] | None,
        Parameter(help="Cut where few images see across, or at the ends of flight lines. [default: tiles.by, space]"),
    ] = None,
    overlap: Annotated[
        int | None,
        Parameter(help="Images that a tile takes over from its neighbours. [default: tiles.overlap, 50]"),
    ] = None,
    out: Annotated[
        Path | None, Parameter(help="The folder to write. [default: tiles beside FILE, or in the project]")
    ] = None,
    json: _Json = False,
    quiet: Annotated[bool, Parameter(negative="", show_default=False, help="Print no summary.")] = False,
) -> int:
    from jaxba.cli._partition import run

    return run(
        file,
        max_observations=max_observations,
        max_images=max_images,
        by=by,
        overlap=overlap,
        out=out,
        as_json=json,
        quiet=quiet,
    )


@app.command(
    help="Check derivatives of the adjusted values against central differences, for every kind of input.\n\n"
    "Exit codes: 0 within the tolerance, 1 over it, 2 bad input or options."
)
def gradcheck(
    file: _File,
    /,
    *,
    loss: Annotated[LossName, Parameter(help="Robust loss of the reprojections.")] = "linear",
    f_scale: Annotated[float, Parameter(help="Its scale, in sigmas.")] = 1.0,
    alpha: Annotated[float | None, Parameter(help="Shape of barron.")] = None,
    fix: Annotated[tuple[str, ...], Parameter(negative="", show_default=False, help="As in solve.")] = (),
    bounds: Annotated[tuple[str, ...], Parameter(negative="", show_default=False, help="As in solve.")] = (),
    tolerance: Annotated[float, Parameter(help="Relative error that a row may have.")] = 1e-5,
    seed: Annotated[int, Parameter(help="Of the directions.")] = 0,
    json: Annotated[bool, Parameter(negative="", show_default=False, help="Print one JSON object.")] = False,
) -> int:
    from jaxba.cli._gradcheck import run

    options = SolveOptions(loss=loss, f_scale=f_scale, alpha=alpha, fix=fix, bounds=bounds, json=json)
    return run(file, options, tolerance=tolerance, seed=seed)


@app.command(help="Tell sizes, track lengths, connectivity, gauge, priors, and what is free.")
def info(
    file: _File,
    /,
    *,
    json: Annotated[bool, Parameter(negative="", show_default=False, help="Print one JSON object.")] = False,
) -> int:
    from jaxba.cli._info import run

    return run(file, as_json=json)


@app.command(help="From a folder of photos to a georeferenced sparse cloud; what is unchanged is not done again.")
def run(
    photos: Annotated[Path, Parameter(help="The folder of photos.")],
    /,
    *,
    crs: Annotated[str | None, Parameter(help="Projected CRS of the results: EPSG:32615. [default: UTM]")] = None,
    out: Annotated[Path, Parameter(help="The project folder.")] = Path("project"),
    stage: Annotated[str | None, Parameter(help="Stop after this stage: metadata, crs, features, pairs, ...")] = None,
    config: _Config = None,
    set_: _Set = (),
    focal: Annotated[float | None, Parameter(help="Focal length in pixels, in place of the tags'.")] = None,
    geotags: Annotated[
        Path | None,
        Parameter(help="A geo.txt or CSV in place of the tags, or none. [default: geo.txt among the photos]"),
    ] = None,
    gcp: Annotated[
        Path | None,
        Parameter(help="Control points: a gcp_list.txt or CSV, or none. [default: gcp_list.txt among the photos]"),
    ] = None,
    check: Annotated[Path | None, Parameter(help="Check points, in the same form: only compared.")] = None,
    bars: Annotated[
        Path | None,
        Parameter(help="Scale bars, distances of marked points: first, second, length_m, std_m."),
    ] = None,
    require_connected: Annotated[
        bool, Parameter(negative="", show_default=False, help="Stop where the photos fall into several groups.")
    ] = False,
    report: Annotated[
        bool, Parameter(negative="", show_default=False, help="Write the project's report at the end, as jaxba report.")
    ] = False,
    workers: Annotated[WorkerOptions | None, Parameter(name="*")] = None,
    json: Annotated[
        bool, Parameter(negative="", show_default=False, help="Print one JSON object on standard output.")
    ] = False,
    quiet: Annotated[
        bool, Parameter(negative="", show_default=False, help="Print no progress and no summary.")
    ] = False,
    log_json: Annotated[
        bool,
        Parameter(
            negative="",
            show_default=False,
            help="Progress as JSON, one object a line on standard error: run_begin, stage_begin, progress (done, "
            "total, eta_s), step, item_failed, stage_end; run_end, stopped or interrupted. With --quiet only these.",
        ),
    ] = False,
) -> int:
    from jaxba.cli._run import run

    return run(
        photos,
        out=out,
        config=config,
        crs=crs,
        focal=focal,
        geotags=geotags,
        gcp=gcp,
        check=check,
        bars=bars,
        stage=stage,
        changes=set_,
        require_connected=require_connected,
        report=report,
        workers=workers or WorkerOptions(),
        as_json=json,
        quiet=quiet,
        log_json=log_json,
    )


@app.command(
    help="Tell how a project stands: stage by stage what is done, what is stale and why; failed frames; findings.\n\n"
    "Exit codes: 0 everything is done, 1 something is to be done, 2 no project."
)
def status(
    project: _Project,
    /,
    *,
    config: Annotated[Path | None, Parameter(help="Parameters to hold it against. [default: its last run's]")] = None,
    set_: _Set = (),
    json: _Json = False,
) -> int:
    from jaxba.cli._project import tell_status

    return tell_status(project, config=config, changes=set_, as_json=json)


@app.command(
    help="Check the exports of a project: files, form, numbers, errors, CRS and place, each with its figure; list the "
    "findings of the adjustment beside them.\n\n"
    "Exit codes: 0 all is well, 1 a check failed, 2 no project, or nothing exported yet."
)
def verify(
    project: _Project,
    /,
    *,
    config: Annotated[Path | None, Parameter(help="Limits to hold it against. [default: its last run's]")] = None,
    set_: _Set = (),
    json: _Json = False,
) -> int:
    from jaxba.cli._project import tell_checks

    return tell_checks(project, config=config, changes=set_, as_json=json)


@app.command(
    help="Tell what looks poor in a project, the likely cause with its figures, and the cure; also of a run that "
    "stopped or was killed.\n\nExit codes: 0 nothing is to be acted on, 1 something is, 2 no project."
)
def diagnose(
    project: _Project,
    /,
    *,
    json: _Json = False,
) -> int:
    from jaxba.cli._project import tell_diagnoses

    return tell_diagnoses(project, as_json=json)


@app.command(
    help="Write the report of a project: report.html, one page that needs no network; report.json with every number of "
    "it; and report/ with tables as CSV and figures as PNG. Also of a run that stopped or was killed.\n\n"
    "Exit codes: 0 written, 2 no project."
)
def report(
    project: _Project,
    /,
    *,
    open_: Annotated[
        bool, Parameter(name="--open", negative="", show_default=False, help="Show the page in the browser.")
    ] = False,
    json: _Json = False,
) -> int:
    from jaxba.cli._project import make_report

    return make_report(project, show=open_, as_json=json)


@app.command(
    help="Audit another program's result: what its files state beside what their own numbers give, and what a new "
    "adjustment of its measurements says. Writes report.html, report.json and report/ with tables and figures.\n\n"
    "Exit codes: 0 no fault was found, 1 a fault was found, 2 bad input or options."
)
def audit(
    model: Annotated[
        Path,
        Parameter(
            help="A folder with a COLMAP model or an OpenSfM reconstruction with its tracks, a BAL problem, a tile.npz."
        ),
    ],
    /,
    *,
    gcp: Annotated[
        Path | None, Parameter(help="Control points: a gcp_list.txt or CSV, its marks by the model's image names.")
    ] = None,
    crs: Annotated[
        str | None, Parameter(help="CRS of the results, and of a list that names none. [default: the list's]")
    ] = None,
    out: Annotated[Path, Parameter(help="The folder of the report.")] = Path("audit"),
    json: _Json = False,
) -> int:
    from jaxba.cli._audit import run

    return run(model, out=out, gcp=gcp, crs=crs, as_json=json)


@app.command(
    help="Tell what a flight would give before it is flown: sigmas over the area, how the block may be bent, what "
    "oblique photos, a second height, RTK or control would gain. Of a project the same, from its own adjustment.\n\n"
    "Exit codes: 0 told, 2 bad input or options."
)
def plan(
    plan_: Annotated[
        Path | None, Parameter(name="PLAN", help="A flight's plan, flight.toml, or the project folder of a run.")
    ] = None,
    /,
    *,
    example: Annotated[
        bool, Parameter(negative="", show_default=False, help="Print a plan with every parameter, to begin with.")
    ] = False,
    improve: Annotated[
        Literal["control"] | None, Parameter(help="Find the places where control points help most.")
    ] = None,
    points: Annotated[int, Parameter(help="How many control points to place.")] = 4,
    json: _Json = False,
    quiet: Annotated[bool, Parameter(negative="", show_default=False, help="Print nothing.")] = False,
) -> int:
    if example:
        from jaxba.design import example as example_of_plan

        print(example_of_plan(), end="")
        return 0
    if plan_ is None:
        raise JaxbaError("plan: give a flight's plan or a project; jaxba plan --example prints a plan to begin with.")
    from jaxba.cli._plan import run

    return run(plan_, improve=improve, points=points, as_json=json, quiet=quiet)


@app.command(help="Print a jaxba.toml with every parameter: its default, range and one line of meaning.")
def config(
    file: Annotated[Path | None, Parameter(help="Print the settings of this file. [default: jaxba.toml here]")] = None,
    /,
    *,
    explain: Annotated[bool, Parameter(negative="", show_default=False, help="A row a parameter instead.")] = False,
    json: _Json = False,
) -> int:
    from jaxba.cli._settings import tell_settings

    return tell_settings(file, explain=explain, as_json=json)


@app.command(help="Write a small simulated survey: photos with tags, control points, the truth beside them.")
def simulate(
    out: Annotated[Path, Parameter(help="The folder to write.")],
    /,
    *,
    images: Annotated[int, Parameter(help="Photos in all.")] = 24,
    oblique: Annotated[int, Parameter(help="Of them tilted, looking at the middle of the block.")] = 4,
    width: Annotated[int, Parameter(help="Of the photos, px; they are 4:3.")] = 1200,
    height: Annotated[float, Parameter(help="Of the flight above the ground, m.")] = 70.0,
    forward_overlap: Annotated[float, Parameter(help="Share of a photo seen again along the line.")] = 0.75,
    side_overlap: Annotated[float, Parameter(help="Share of a photo seen again on the next line.")] = 0.6,
    gnss_std: Annotated[
        tuple[float, float], Parameter(help="Noise of positions, m: an axis across, and up; to 0.1 they count as RTK.")
    ] = (0.03, 0.05),
    attitude_std: Annotated[float, Parameter(help="Noise of the attitude tags, degrees.")] = 1.5,
    control: Annotated[int, Parameter(help="Control points, in gcp_list.txt.")] = 5,
    check: Annotated[int, Parameter(help="Check points, in check_list.txt.")] = 5,
    mark_std: Annotated[float, Parameter(help="Noise of the marks in the lists, px.")] = 0.3,
    seed: Annotated[int, Parameter(help="The same seed gives the same survey.")] = 0,
) -> int:
    from jaxba.cli._surveys import simulate as write

    return write(
        out,
        images=images,
        oblique=oblique,
        width=width,
        height=height,
        forward_overlap=forward_overlap,
        side_overlap=side_overlap,
        gnss_std=gnss_std,
        attitude_std=attitude_std,
        control=control,
        check=check,
        mark_std=mark_std,
        seed=seed,
    )


@app.command(help="Write a synthetic UAV survey as a tile, with the truth as extra_truth_... arrays.")
def synthetic(
    out: Annotated[Path, Parameter(help="The tile to write.")],
    /,
    *,
    images: Annotated[int, Parameter(help="How many images.")] = 100,
    seed: Annotated[int, Parameter(help="The same seed gives the same survey.")] = 0,
    outliers: Annotated[float, Parameter(help="Share of gross errors among the measured pixels.")] = 0.0,
    cameras: Annotated[int, Parameter(help="Cameras, each for a stretch of images.")] = 1,
    points_per_image: Annotated[float, Parameter(help="Tie points over images.")] = 66.0,
    pixel_std: Annotated[float, Parameter(help="Noise of the measured pixels, px an axis.")] = 0.5,
    control: Annotated[int, Parameter(help="Control points.")] = 0,
    gnss: Annotated[
        bool, Parameter(negative="--no-gnss", help="Measured positions; without, the gauge is free.")
    ] = True,
) -> int:
    from jaxba.cli._surveys import synthetic as write

    return write(
        out,
        num_images=images,
        seed=seed,
        outlier_fraction=outliers,
        num_cameras=cameras,
        points_per_image=points_per_image,
        pixel_std_px=pixel_std,
        num_control=control,
        gnss=gnss,
    )
