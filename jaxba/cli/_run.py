"""`jaxba run`: the pipeline with its progress, then what a surveyor wants to know of the result."""

import sys
from collections.abc import Sequence
from pathlib import Path

from jaxba.cli._cache import use_compilation_cache
from jaxba.cli._text import first_of, many, table, to_json
from jaxba.pipeline import Event, Resources, Run, changed, default_settings, run_pipeline, stage_lines, summary

_CLEAR = "\r\x1b[K"


def run(
    photos: Path,
    *,
    out: Path,
    crs: str | None,
    focal: float | None,
    geotags: Path | None,
    stage: str | None,
    changes: Sequence[str],
    require_connected: bool,
    workers: int | None,
    max_memory: float,
    as_json: bool,
    quiet: bool,
) -> int:
    """Run the pipeline and say what came out; return the exit code."""
    settings = changed(default_settings(), changes)
    for flag, given in (
        (f"crs.target_crs={crs}", crs is not None),
        (f"metadata.focal={focal}", focal is not None),
        ("tracks.require_connected=true", require_connected),
    ):
        if given:
            settings = changed(settings, [flag])
    use_compilation_cache()
    show = _Progress(quiet=quiet or as_json)
    result = run_pipeline(
        photos,
        out,
        settings,
        until=stage,
        geotags=geotags,
        resources=Resources(workers=workers, max_memory=max_memory),
        tell=show,
    )
    facts = summary(result)
    if as_json:
        print(to_json(facts))
    elif not result.stages_run:
        print("nothing to do")
    elif not quiet:
        _print_summary(result, out)
    return 0


class _Progress:
    """One line a stage as it ends; while a stage goes over photos, a line that is overwritten on a terminal."""

    def __init__(self, *, quiet: bool) -> None:
        self.quiet, self.live = quiet, sys.stderr.isatty()

    def __call__(self, event: Event) -> None:
        if self.quiet:
            return
        if self.live and event.kind != "end":
            count = f"{event.done} of {many(event.total, 'photo')}" if event.kind == "photo" else "..."
            print(f"{_CLEAR}{event.stage:<10}{count}", end="", file=sys.stderr, flush=True)
        if event.kind == "end":
            if self.live:
                print(_CLEAR, end="", file=sys.stderr, flush=True)
            if event.total:
                first, *more = stage_lines(event)
                print(f"{event.stage:<10}{first}   {event.seconds:.1f} s", flush=True)
                for line in more:
                    print(f"{'':<10}{line}", flush=True)


def _print_summary(result: Run, out: Path) -> None:
    facts = summary(result)
    rows: list[tuple[str, str | Sequence[str]]] = []
    if "adjust" in facts:
        rows = _result_rows(facts["adjust"])
    left_out = [f"{entry['name']}: {entry['reason']}" for entry in facts["left_out"]]
    if left_out:
        rows.append(("left out", left_out))
    if "export" in facts:
        rows.append(("files", [f"{out / 'export'}: {first_of(facts['export']['files'], most=20)}"]))
    print()
    print(table(rows))


def _result_rows(adjust: dict) -> list[tuple[str, str | Sequence[str]]]:
    rows: list[tuple[str, str | Sequence[str]]] = [
        ("images", f"{adjust['images']} of {adjust['photos']} adjusted"),
        (
            "points",
            f"{adjust['points']:,}, {adjust['points_seen_thrice']:,} of them in three images or more; "
            f"{adjust['observations']:,} observations",
        ),
        ("error", f"median {adjust['median_px']:.2f} px, {adjust['inlier_rate']:.1%} inliers"),
    ]
    if adjust["gnss_rms_m"] is not None:
        east, north, up = adjust["gnss_rms_m"]
        rows.append(
            ("GNSS fit", f"RMS {east:.2f}, {north:.2f}, {up:.2f} m east, north, up over {adjust['num_gnss']} positions")
        )
    if adjust["findings"]:
        rows.append(("findings", list(adjust["findings"])))
    return rows
