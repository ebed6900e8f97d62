"""Everything that a report says, as plain values: `report.json`, made of the records that the stages left.

The form is told in `_schema.py`. Numbers that are not known are None; a section that has no data says why in `none`.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import jaxba
from jaxba.engine._project import SETTINGS, SUMMARY, TIMES, Project, list_paths
from jaxba.engine._settings import from_toml
from jaxba.engine._stage import Pipeline, left_out
from jaxba.engine._store import sha256
from jaxba.engine._versions import installed
from jaxba.report._findings import sentences
from jaxba.report._recorded import Recorded, recorded
from jaxba.report._summary import finite
from jaxba.report.document._calibration import cameras, correlation, statistics
from jaxba.report.document._glossary import GLOSSARY
from jaxba.report.document._key_figures import key_figures
from jaxba.report.document._lights import lights, verdict
from jaxba.report.document._material import Material
from jaxba.report.document._photos import cloud, overlap, pairs, photo_rows
from jaxba.report.document._residuals import residuals
from jaxba.report.document._sigmas import sigmas
from jaxba.report.document._survey import accuracy_section, attitudes, bars, control, place, positions

SCHEMA = 1


def report_facts(folder: Path, pipeline: Pipeline) -> dict[str, Any]:
    """Return what there is to report of a project, also of one whose run has not ended.

    Raises `JaxbaError` where the folder is no project, or a list that the run was given cannot be read any more.
    """
    project = Project(folder, make=False)
    found = recorded(folder, pipeline)
    summary, seconds = project.read_json(SUMMARY), project.read_json(TIMES)
    material = Material(
        folder=project.folder,
        found=found,
        summary=summary if isinstance(summary, dict) else {},
        settings=from_toml(project.folder / SETTINGS, pipeline.settings),
        defaults=pipeline.settings,
        seconds=seconds if isinstance(seconds, dict) else {},
    )
    return facts_of(
        material,
        project=_project(material, project),
        left_out=_left_out(material, pipeline),
        processing=_processing(material, project, pipeline),
    )


def facts_of(
    material: Material,
    *,
    project: Mapping[str, Any],
    left_out: Sequence[Mapping[str, str]],
    processing: Mapping[str, Any],
    audit: Mapping[str, Any] | None = None,
    more_lights: Sequence[dict[str, Any]] = (),
) -> dict[str, Any]:
    """Return the facts of records, of a project or of an audit.

    - `project`, `left_out`, `processing`, `audit`: these sections. `more_lights`: before those of the records.
    """
    rows = [*more_lights, *lights(material)]
    photos = photo_rows(material)
    facts = {
        "schema": SCHEMA,
        "project": project,
        **({} if audit is None else {"audit": audit}),
        "verdict": verdict(material, rows),
        "quality": rows,
        "findings": sentences(material.found.findings),
        "summary": [],
        "sigmas": sigmas(material),
        "cloud": cloud(material),
        "photos": photos,
        "pairs": pairs(material),
        "overlap": overlap(material),
        "residuals": residuals(material),
        "cameras": cameras(material),
        "correlation": correlation(material),
        "positions": positions(material, photos),
        "attitudes": attitudes(material),
        "control": control(material),
        "bars": bars(material),
        "statistics": statistics(material),
        "accuracy": accuracy_section(material),
        "left_out": left_out,
        "processing": processing,
        "glossary": [{"term": term, "text": text} for term, text in GLOSSARY.items()],
    }
    facts["summary"] = key_figures(material, facts)
    plain: dict[str, Any] = finite(facts)
    return plain


def _project(material: Material, project: Project) -> dict[str, Any]:
    times = sorted(photo.time for photo in material.photos if photo.time)
    state, reason = _state(material.found)
    given, _ = project.read_given()
    return {
        "name": material.folder.absolute().name,
        "photos": str(given.photos),
        "jaxba": jaxba.__version__,
        "state": state,
        "reason": reason,
        **place(material.frame),
        "first_photo": times[0] if times else None,
        "last_photo": times[-1] if times else None,
        "outputs": project.export.name,
    }


def _state(found: Recorded) -> tuple[str, str | None]:
    """Return how the last run ended, and why where it did not."""
    if found.running is not None:
        return "running", f"A run works on it: {found.running}."
    if found.killed is not None:
        return "killed", f"The last run was killed in the stage {found.killed}; run the same command again to go on."
    if found.stopped is not None:
        return "stopped", f"The last run stopped in the stage {found.stopped.name}: {found.stopped.reason}"
    if found.stale is not None:
        return "unfinished", f"The stage {found.stale} is out of date, so that it and what follows are left out here."
    if found.done.export is None:
        return "unfinished", "The run did not go on to the export."
    return "complete", None


def _left_out(material: Material, pipeline: Pipeline) -> list[dict[str, str]]:
    return [
        {"stage": stage, "name": entry.name, "reason": entry.reason}
        for stage, entries in left_out(pipeline.stages, material.done).items()
        for entry in entries
    ]


def _processing(material: Material, project: Project, pipeline: Pipeline) -> dict[str, Any]:
    """Return parameters, stages with their times, versions, and hashes of what came in and went out."""
    done = material.done
    parameters = []
    for section, params in material.settings.items():
        for name, value in vars(params).items():
            default = getattr(material.defaults[section], name)
            parameters.append(
                {
                    "section": section,
                    "name": name,
                    "value": _text(value),
                    "default": _text(default),
                    "changed": value != default,
                }
            )
    said = material.summary.get("stages", {})
    exported = done.export
    return {
        "parameters": parameters,
        "stages": [
            {"name": name, "seconds": material.seconds.get(name), "lines": list(said.get(name, ()))}
            for name in pipeline.names
        ],
        "versions": [{"name": name, "version": version} for name, version in sorted(installed().items())],
        "inputs": [*_lists(project), *({"name": p.name, "what": "photo", "sha256": p.sha256} for p in material.photos)],
        "outputs": []
        if exported is None
        else [{"name": n, "sha256": h} for n, h in zip(exported.files, exported.sha256, strict=True)],
    }


def _lists(project: Project) -> list[dict[str, str]]:
    """Return the lists that the run was given, or found among the photos."""
    given, _ = project.read_given()
    return [
        {"name": path.name, "what": what, "sha256": sha256(path)}
        for what, path in list_paths(given).items()
        if path is not None
    ]


def _text(value: Any) -> str:
    return "none" if value is None else str(value).lower() if isinstance(value, bool) else str(value)
