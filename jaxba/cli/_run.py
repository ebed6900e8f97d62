"""`jaxba run`: the pipeline with its progress, then what a surveyor wants to know of the result."""

import contextlib
import math
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from jaxba import __version__
from jaxba._errors import JaxbaError
from jaxba.cli._options import BAD_INPUT, INTERRUPTED, UNUSABLE, WorkerOptions, fail, print_error
from jaxba.cli._run_progress import JsonLines, LiveLine, LogLines, Progress, StageLines, steps_told
from jaxba.cli._settings import configured
from jaxba.cli._text import first_of, labelled, many, to_json, wrapped
from jaxba.engine import changed
from jaxba.engine._compile_cache import use_compilation_cache
from jaxba.pipeline import PIPELINE, Event, Run, run_pipeline
from jaxba.report import accuracy_row, bar_rows, control_rows, flight_lines, statistics_rows

_SUMMARY_LABEL = 12


def run(
    photos: Path,
    *,
    out: Path,
    config: Path | None,
    crs: str | None,
    focal: float | None,
    geotags: Path | None,
    gcp: Path | None,
    check: Path | None,
    bars: Path | None,
    stage: str | None,
    changes: Sequence[str],
    require_connected: bool,
    report: bool,
    workers: WorkerOptions,
    as_json: bool,
    quiet: bool,
    log_json: bool,
) -> int:
    """Run the pipeline and say what came out; return the exit code: 1 where the result must not be used."""
    json_lines = JsonLines() if log_json else None
    show: Progress | None = json_lines
    if show is None and not (quiet or as_json):
        show = LiveLine() if sys.stderr.isatty() else LogLines()
    begun, current = time.monotonic(), None
    stage_end = StageLines()

    def tell(event: Event) -> None:
        nonlocal current
        current = event.stage
        if show is not None:
            show(event)
        if not (quiet or as_json):
            stage_end(event)

    try:
        if json_lines is not None:
            json_lines.say("run_begin", version=__version__, photos=str(photos), out=str(out))
        settings = changed(configured(config, quiet=quiet or as_json or log_json), changes)
        for flag, given in (
            (f"crs.target_crs={crs}", crs is not None),
            (f"metadata.focal={focal}", focal is not None),
            ("tracks.require_connected=true", require_connected),
        ):
            if given:
                settings = changed(settings, [flag])
        settings = changed(settings, workers.changes())
        use_compilation_cache()
        with contextlib.nullcontext() if show is None else steps_told(show.step):
            result = run_pipeline(
                photos, out, settings, until=stage, geotags=geotags, gcp=gcp, check=check, bars=bars, tell=tell
            )
    except KeyboardInterrupt:
        said = "interrupted; what is done is kept, and the same command goes on from there."
        if json_lines is None:
            _clear(show)
            return fail(said, INTERRUPTED, as_json=as_json)
        json_lines.say("interrupted", stage=current)
        if as_json:
            print_error(said, INTERRUPTED)
        return INTERRUPTED
    except JaxbaError as error:
        _clear(show)
        if json_lines is None:
            raise
        json_lines.say("stopped", stage=current, reason=str(error))
        if as_json:
            print_error(str(error), BAD_INPUT)
        return BAD_INPUT
    if json_lines is not None:
        json_lines.say("run_end", seconds=round(time.monotonic() - begun, 3), stages_run=list(result.stages_run))
    page = None
    if report:
        from jaxba.report.document import write_report

        page = write_report(out, PIPELINE)[0]
    if as_json:
        print(to_json(result.facts))
    elif not quiet:
        _print_summary(result, out, page)
    return 0 if result.facts.get("adjust", {}).get("usable", True) else UNUSABLE


def _clear(show: Progress | None) -> None:
    if show is not None:
        show.clear()


def _print_summary(result: Run, out: Path, page: Path | None) -> None:
    facts = result.facts
    rows: list[tuple[str, str]] = []
    if "adjust" in facts:
        control = [*control_rows(facts.get("control")), *bar_rows(facts.get("bars"))]
        if "accuracy" in facts:
            control.append(("accuracy", accuracy_row(facts["accuracy"])))
        rows = _result_rows(facts["adjust"], control)
    if facts.get("crs", {}).get("name") and "export" in facts:
        code = facts["crs"]["epsg"]
        rows.append(("CRS", facts["crs"]["name"] + (f" (EPSG:{code})" if code else "")))
    if facts["left_out"]:
        names = [entry["name"] for entry in facts["left_out"]]
        rows.append(("left out", f"{many(len(names), 'file')}: {first_of(names)}; why: {out / 'summary.json'}"))
    if "export" in facts:
        rows.append(
            ("files", f"{many(len(facts['export']['files']), 'file')} in {out / 'export'}, see README.txt there")
        )
    if page is not None:
        rows.append(("report", str(page)))
    if not result.stages_run:
        print("nothing to do: the photos and settings are those of the last run")
    print()
    for label, text in rows:
        print(wrapped(label, text, _SUMMARY_LABEL))


def _result_rows(adjust: dict[str, Any], control: list[tuple[str, str]]) -> list[tuple[str, str]]:
    rows = [
        ("images", f"{adjust['images']} of {adjust['photos']} adjusted"),
        (
            "points",
            f"{adjust['points']:,}, {adjust['points_seen_thrice']:,} of them in three images or more; "
            f"{adjust['observations']:,} observations",
        ),
        ("error", f"median {adjust['median_px']:.2f} px, {adjust['inlier_rate']:.1%} inliers"),
    ]
    if adjust["gnss_rms_m"] is not None:
        axes = zip(("east", "north", "up"), adjust["gnss_rms_m"], strict=True)
        used = {axis: rms for axis, rms in axes if rms is not None and math.isfinite(rms)}  # heights may not be used
        figures = ", ".join(f"{rms:.2f}" for rms in used.values())
        rows.append(("GNSS fit", f"RMS {figures} m {', '.join(used)} over {adjust['num_gnss']} positions"))
    flights = flight_lines(adjust.get("flights", []))
    rows += statistics_rows(adjust.get("statistics"))
    return [*rows, *labelled("flights", flights), *control, *labelled("findings", adjust["findings"])]
