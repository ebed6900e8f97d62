"""`jaxba audit`: what is wrong with another program's result, by its own claims and its own measurements."""

import contextlib
import sys
from pathlib import Path
from typing import Any

from jaxba.cli._run_progress import LiveLine, steps_told
from jaxba.cli._text import labelled, many, to_json, wrapped
from jaxba.engine._compile_cache import use_compilation_cache

_LABEL = 10


def run(model: Path, *, out: Path, gcp: Path | None, crs: str | None, as_json: bool) -> int:
    """Audit a model, say what was found; return 1 where there is a fault, else 0."""
    use_compilation_cache()
    from jaxba.audit import audit
    from jaxba.report import sentences

    show = LiveLine() if sys.stderr.isatty() and not as_json else None
    with contextlib.nullcontext() if show is None else steps_told(show.step):
        try:
            found = audit(model, out, gcp=gcp, crs=crs)
        finally:
            if show is not None:
                show.clear()
    code = 1 if found.faults else 0
    if as_json:
        sections = {
            name: found.facts[name] for name in ("verdict", "audit", "control", "quality", "summary", "findings")
        }
        print(to_json({**sections, "report": str(found.page), "exit_code": code}))
        return code
    others = [finding for finding in found.findings if finding not in found.faults]
    for label, text in [
        *_model_rows(found.facts),
        *_control_rows(found.facts["control"]),
        *labelled("faults", sentences(found.faults)),
        *labelled("findings", sentences(others)),
        ("report", str(found.page)),
    ]:
        print(wrapped(label, text, _LABEL))
    print(many(len(found.faults), "fault") if code else "no fault was found")
    return code


def _control_rows(control: dict[str, Any]) -> list[tuple[str, str]]:
    if "none" in control:
        return []
    known = [f"{rms:.3f}" for rms in control["control_rms_m"] if rms is not None]
    rms = f", RMS {', '.join(known)} m east, north, up" if known else ""
    return [("control", f"{many(control['num_control'], 'control point')}, {control['num_check']} check points{rms}")]


def _model_rows(facts: dict[str, Any]) -> list[tuple[str, str]]:
    audit = facts["audit"]
    by_name = {row["name"]: row for row in audit["claims"]}
    counts = ", ".join(f"{by_name[name]['recomputed']:,.0f} {name}" for name in ("images", "points", "observations"))
    error = by_name["mean reprojection error"]
    unit = f" {error['unit']}"
    stated = "none is stated" if error["stated"] is None else f"stated {error['stated']:.6g}{unit}"
    seen = audit["observations"]
    after = {row["name"]: row["value"] for row in facts["summary"]}
    return [
        ("model", f"{audit['model']}: {audit['program']}, {counts}"),
        (
            "error",
            f"mean {error['recomputed']:.6g}{unit} over points, {stated}; cost {by_name['cost']['recomputed']:.7g}",
        ),
        (
            "adjusted",
            f"median {after['Median reprojection error']}, sigma of a coordinate "
            f"{after['Sigma of an image coordinate']}; {seen['rejected']:,} of {seen['num']:,} observations rejected, "
            f"{seen['wrong']:,} miss their points by over {seen['wrong_limit_px']:.1f} px",
        ),
    ]
