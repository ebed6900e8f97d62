"""`jaxba run`: the pipeline with its progress, then what a surveyor wants to know of the result."""

import math
import re
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from jaxba.cli._cache import use_compilation_cache
from jaxba.cli._config import configured
from jaxba.cli._main import INTERRUPTED
from jaxba.cli._text import first_of, many, to_json, wrapped
from jaxba.pipeline import Event, Resources, Run, changed, run_pipeline, stage_lines, summary

_CLEAR = "\r\x1b[K"
_LABEL, _SUMMARY_LABEL = 10, 12


def run(
    photos: Path,
    *,
    out: Path,
    config: Path | None,
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
    settings = changed(configured(config, quiet=quiet or as_json), changes)
    for flag, given in (
        (f"crs.target_crs={crs}", crs is not None),
        (f"metadata.focal={focal}", focal is not None),
        ("tracks.require_connected=true", require_connected),
    ):
        if given:
            settings = changed(settings, [flag])
    use_compilation_cache()
    show = _Progress(quiet=quiet or as_json)
    try:
        result = run_pipeline(
            photos,
            out,
            settings,
            until=stage,
            geotags=geotags,
            resources=Resources(workers=workers, max_memory=max_memory),
            tell=show,
        )
    except KeyboardInterrupt:
        print("jaxba: interrupted; what is done is kept, and the same command goes on from there.", file=sys.stderr)
        return INTERRUPTED
    finally:
        show.clear()
    if as_json:
        print(to_json(summary(result)))
    elif not quiet:
        _print_summary(result, out)
    return 0


class _Progress:
    """One line a stage as it ends; on a terminal, a line that is overwritten while a stage runs."""

    def __init__(self, *, quiet: bool) -> None:
        self.quiet, self.live = quiet, sys.stderr.isatty()
        self.said: set[str] = set()

    def __call__(self, event: Event) -> None:
        if self.quiet:
            return
        if self.live and event.kind != "end":
            count = f"{event.done} of {many(event.total, 'photo')}" if event.kind == "photo" else "..."
            print(f"{_CLEAR}{event.stage:<{_LABEL}}{count}", end="", file=sys.stderr, flush=True)
        if event.kind == "end":
            self.clear()
            if event.total:
                first, *notes = stage_lines(event)
                print(wrapped(event.stage, f"{first}   {event.seconds:.1f} s", _LABEL), flush=True)
                for note in notes:
                    if news := self._news(note):
                        print(wrapped("", news, _LABEL), flush=True)

    def clear(self) -> None:
        """Wipe the line that is overwritten."""
        if self.live and not self.quiet:
            print(_CLEAR, end="", file=sys.stderr, flush=True)

    def _news(self, note: str) -> str:
        """Return the sentences of a note that this run has not said yet."""
        sentences = re.split(r"(?<=\.) (?=[A-Z])", note)
        news = [sentence for sentence in sentences if sentence not in self.said]
        self.said.update(sentences)
        return " ".join(news)


def _print_summary(result: Run, out: Path) -> None:
    facts = summary(result)
    rows: list[tuple[str, str]] = []
    if "adjust" in facts:
        rows = _result_rows(facts["adjust"])
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
    if not result.stages_run:
        print("nothing to do: the photos and settings are those of the last run")
    print()
    for label, text in rows:
        print(wrapped(label, text, _SUMMARY_LABEL))


def _result_rows(adjust: dict[str, Any]) -> list[tuple[str, str]]:
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
    for label, finding in zip(["findings"] + [""] * len(adjust["findings"]), adjust["findings"], strict=False):
        rows.append((label, finding))
    return rows
