"""The report of an audit: the facts of a project's report, made of the model's new adjustment, with its own section.

Stages that an audit has not leave no records, so that their sections say that there is nothing.
"""

import dataclasses
import hashlib
from pathlib import Path
from typing import Any

from jaxba import __version__
from jaxba.audit._readjust import Readjusted
from jaxba.engine._versions import installed
from jaxba.pipeline import PIPELINE, adjust, control, metadata, start, tracks
from jaxba.report import Recorded, Told
from jaxba.report.document import Material, facts_of, place
from jaxba.scene import Finding, Reconstruction

_SECTIONS = "adjust", "control", "verify"  # whose parameters an audit uses


def report_facts(
    folder: Path,
    path: Path,
    given: Reconstruction,
    found: Readjusted,
    findings: tuple[Finding, ...],
    section: dict[str, Any],
) -> dict[str, Any]:
    """Return the facts of the report in a folder.

    - `path`: of the model. `findings`: in place of those of the adjustment. `section`: the audit's own.
    """
    done = PIPELINE.begin(files=(), settings=PIPELINE.settings)
    done.metadata = metadata.Outputs(photos=found.photos, left_out=())
    done.control = found.controlled
    done.tracks = tracks.Outputs(tracks=found.tracks)
    done.start = start.Outputs(block=found.start)
    done.adjust = dataclasses.replace(found.outputs, findings=findings)
    material = Material(
        folder=folder,
        found=Recorded(done=done, stopped=None, killed=None, running=None, stale=None, failed={}),
        summary={},
        settings=PIPELINE.settings,
        defaults=PIPELINE.settings,
        seconds={},
    )
    project = {
        "name": path.absolute().name,
        "photos": str(path.absolute().parent),
        "jaxba": __version__,
        "state": "complete",
        "reason": None,
        **place(material.frame),
        "first_photo": None,
        "last_photo": None,
        "outputs": folder.name,
    }
    left_out = [{"stage": "control", "name": of.name, "reason": of.reason} for of in found.controlled.left_out]
    return facts_of(
        material,
        project=project,
        left_out=left_out,
        processing=_processing(given, found),
        audit=section,
        more_lights=[_light(section)],
    )


def _light(section: dict[str, Any]) -> dict[str, Any]:
    count = section["fault_count"]
    kinds = ", ".join(dict.fromkeys(fault["kind"] for fault in section["faults"]))
    return {
        "name": "The model itself",
        "value": "no fault" if not count else "1 fault" if count == 1 else f"{count} faults",
        "state": "poor" if count else "good",
        "text": f"By its claims and its new adjustment: {kinds}."
        if count
        else "Its claims are so, and its own measurements confirm it.",
        "limits": "good without a fault; each fault's limit stands beside its figure",
    }


def _processing(given: Reconstruction, found: Readjusted) -> dict[str, Any]:
    parameters = [
        {"section": section, "name": name, "value": str(value), "default": str(value), "changed": False}
        for section in _SECTIONS
        for name, value in vars(PIPELINE.settings[section]).items()
    ]
    told = Told(photos=tuple(photo.name for photo in found.photos), control=found.controlled.control)
    said = {"control": control.lines(found.controlled, told), "adjust": adjust.lines(found.outputs, told)}
    return {
        "parameters": parameters,
        "stages": [{"name": name, "seconds": None, "lines": lines} for name, lines in said.items()],
        "versions": [{"name": name, "version": version} for name, version in sorted(installed().items())],
        "inputs": [
            {"name": file.name, "sha256": hashlib.sha256(file.read_bytes()).hexdigest()} for file in given.files
        ],
        "outputs": [],
    }
