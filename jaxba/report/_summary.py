"""What a run tells people: a line or two a stage as it ends, and the facts of the whole run for JSON."""

import math
import re
from collections.abc import Sequence
from dataclasses import asdict
from typing import Any

import numpy as np

from jaxba.engine._words import many, some_photos
from jaxba.pipeline._detected import Detected
from jaxba.pipeline._events import Event, Run
from jaxba.pipeline._pair_record import pair_facts, pair_lines
from jaxba.pipeline._stages import Done
from jaxba.report._control_summary import control_facts, control_lines
from jaxba.scene import EdgeStatus, Left, ViewGraph

_MOST_LINES = 10
_NUMBER = re.compile(r"(?<![\w.])\d+(?:\.\d+)?(?!\w)")


def stage_lines(event: Event) -> list[str]:
    """Return what a stage made in one line, then its notes and what it could not use."""
    outputs = event.outputs
    notes: list[str] = []
    if event.stage == "metadata":
        cameras = len({photo.camera for photo in outputs.photos})
        left = f", {many(len(event.left_out), 'file')} left out" if event.left_out else ""
        first = f"{many(len(outputs.photos), 'photo')}, {many(cameras, 'camera')}{left}"
        notes = [*outputs.notes, *_grouped(event.left_out)]
    elif event.stage == "crs":
        reference = outputs.reference
        where = reference.frame.crs_name if reference.frame is not None else "no place on earth"
        first = f"{where}; {int(reference.is_used.sum())} of {len(reference.is_used)} positions used"
        notes = [*reference.notes, *_grouped(reference.review)]
    elif event.stage == "control":
        first, notes = control_lines(outputs)
    elif event.stage == "features":
        found = {index: outputs[index] for index in sorted(outputs)}
        counts = [features.num_keypoints for features in found.values()]
        first = f"{sum(counts):,} keypoints, median {int(np.median(counts)):,} an image" if counts else "no keypoints"
        used = [i for i, features in found.items() if features.num_keypoints]
        texts = [(i, text) for i in used for text in (*outputs.tunings[i].reasons, *found[i].notes)]
        odd = [Left(name=event.photos[i], reason=text) for i, text in texts]
        notes = [*outputs.routing.reasons, *_grouped(event.left_out), *_grouped(_with_ranges(odd))]
    elif event.stage == "pairs":
        share = f" ({len(outputs.pairs) / outputs.num_all:.0%})" if outputs.num_all else ""
        first = f"{len(outputs.pairs):,} of {outputs.num_all:,} pairs{share}, {outputs.method}"
        notes = list(outputs.notes)
        if notes and notes[0].startswith(f"{len(outputs.pairs):,} of {outputs.num_all:,} pairs"):
            first = notes.pop(0).removesuffix(".")
    elif event.stage == "match":
        graph: ViewGraph = outputs.view_graph
        good, weak = (int((graph.status == status).sum()) for status in (EdgeStatus.GOOD, EdgeStatus.WEAK))
        rejected = len(graph.pairs) - good - weak
        first = f"{good:,} good pairs, {weak:,} weak, {rejected:,} rejected; {len(graph.matches):,} matches"
        notes = [*pair_lines(graph, outputs.record), *_grouped(event.left_out)]
    elif event.stage == "tracks":
        tracks = outputs.tracks
        largest = f"{len(tracks.components[0])} of {many(len(event.photos), 'photo')} in the largest group"
        first = f"{tracks.num_tracks:,} tracks, {tracks.num_observations:,} observations; {largest}"
        notes = list(outputs.notes)
    elif event.stage == "start":
        block = outputs.block
        first = f"{many(block.num_images, 'image')}, {block.num_points:,} points"
        notes = [*block.notes, *_grouped(event.left_out)]
    elif event.stage == "adjust":
        first = f"median {outputs.median_px:.2f} px, {many(outputs.rounds, 'round')}"
        notes = _grouped(event.left_out)
    else:
        first = many(len(outputs.files), "file")
        notes = list(outputs.notes)
    return [first, *event.notes, *notes]


def summary(run: Run) -> dict[str, Any]:
    """Return the facts of a run as plain values: figures of the result, and all that was left out, named.

    `left_out` names each file once, with the first stage that could not use it. `groups` are the photos of each group
    without common tracks, where there is more than one, the largest first. Numbers that are not finite are None.
    """
    done = run.done
    names = () if done.metadata is None else tuple(photo.name for photo in done.photos)
    facts: dict[str, Any] = {"stages_run": list(run.stages_run)}
    if run.stopped is not None:
        facts["stopped"] = {"stage": run.stopped.name, "reason": run.stopped.reason}
    facts["stages"] = {stage: list(lines) for stage, lines in run.lines.items()}
    if done.crs is not None:
        reference = (done.control or done.crs).reference
        frame = reference.frame
        facts["crs"] = {
            "name": None if frame is None else frame.crs_name,
            "epsg": None if frame is None else frame.epsg,
            "heights": None if frame is None else frame.height_note,
            "review": [{"name": entry.name, "reason": entry.reason} for entry in reference.review],
        }
    if done.pairs is not None:
        facts["pairs"] = {"candidates": len(done.pairs.pairs), "all": done.pairs.num_all, "method": done.pairs.method}
    if done.features is not None:
        facts["features"] = _features(done.features, names)
    if done.match is not None:
        facts["match"] = pair_facts(done.match.view_graph, done.match.record)
    if done.tracks is not None and len(done.tracks.tracks.components) > 1:
        facts["groups"] = [[names[image] for image in group] for group in done.tracks.tracks.components]
    if done.adjust is not None:
        adjusted = done.adjust
        block = adjusted.block
        seen = np.bincount(block.observation_point, minlength=block.num_points)
        facts["adjust"] = {
            "photos": len(done.photos),
            "images": block.num_images,
            "points": block.num_points,
            "points_seen_thrice": int((seen >= 3).sum()),
            "observations": block.num_observations,
            "median_px": adjusted.median_px,
            "inlier_rate": adjusted.inlier_rate,
            "gnss_rms_m": None if adjusted.gnss_rms_m is None else list(adjusted.gnss_rms_m),
            "num_gnss": adjusted.num_gnss,
            "camera_model": block.camera_model,
            "cameras": {
                name: {"parameters": list(map(float, row)), "std": list(map(float, std))}
                for name, row, std in zip(
                    block.camera_names, block.camera_parameters, adjusted.intrinsics_std, strict=True
                )
            },
            "findings": list(adjusted.findings),
        }
    if done.control is not None and done.control.control.num_points:
        facts["control"] = control_facts(done)
    if done.export is not None:
        facts["export"] = {"files": list(done.export.files), "notes": list(done.export.notes)}
    facts["left_out"] = [
        {"stage": stage, "name": entry.name, "reason": entry.reason}
        for stage, entries in left_out(done).items()
        for entry in entries
    ]
    return _finite(facts)


def _features(found: Detected, names: Sequence[str]) -> dict[str, Any]:
    """Return the decision on the detector with its figures, and how each photo was looked at, with those of its own."""
    routing = asdict(found.routing)
    return {"routing": routing, "photos": {names[i]: asdict(found.tunings[i]) for i in sorted(found)}}


def left_out_by_last_run(facts: object, stage: str) -> tuple[Left, ...]:
    """Return what a run's summary says a stage could not use: also photos whose worker died, which leave no record.

    - `facts`: of `summary.json`; anything else says nothing.
    """
    entries = facts.get("left_out", ()) if isinstance(facts, dict) else ()
    return tuple(Left(name=entry["name"], reason=entry["reason"]) for entry in entries if entry["stage"] == stage)


def left_out(done: Done) -> dict[str, tuple[Left, ...]]:
    """Return the files that are not in the result, and photos that could not be matched, by stage.

    Each is named once, with the first stage that could not use it.
    """
    found: list[tuple[str, tuple[Left, ...]]] = []
    if done.metadata is not None:
        found.append(("metadata", done.metadata.left_out))
    matched = {done.photos[entry.image].name for entry in done.match.fallback} if done.match is not None else set()
    without = tuple(entry for entry in done.features_left_out if entry.name not in matched)  # SIFT found some after all
    found += [("features", without), ("match", done.match_left_out)]
    found += [(name, made.block.unregistered) for name in ("start", "adjust") if (made := getattr(done, name))]
    result: dict[str, tuple[Left, ...]] = {}
    named: set[str] = set()
    for stage, entries in found:
        result[stage] = tuple(entry for entry in entries if entry.name not in named)
        named.update(entry.name for entry in entries)
    return result


def _grouped(entries: Sequence[Left]) -> list[str]:
    """Return each reason once, with the photos that it concerns; the first few reasons where there are many."""
    names: dict[str, list[str]] = {}
    for entry in entries:
        names.setdefault(entry.reason, []).append(entry.name)
    lines = [f"{some_photos(found)}: {reason}" for reason, found in names.items()]
    if len(lines) <= _MOST_LINES:
        return lines
    rest = sum(len(found) for found in list(names.values())[_MOST_LINES:])
    return [*lines[:_MOST_LINES], f"and {rest} more such files, each with its reason in summary.json."]


def _with_ranges(entries: Sequence[Left]) -> list[Left]:
    """Return the same, with reasons that differ in their numbers alone made one: `1028 to 1459 keypoints`."""
    kinds: dict[str, list[Left]] = {}
    for entry in entries:
        kinds.setdefault(_NUMBER.sub("#", entry.reason), []).append(entry)
    result = []
    for kind, alike in kinds.items():
        columns = zip(*(_NUMBER.findall(entry.reason) for entry in alike), strict=True)
        ends = [(min(column, key=float), max(column, key=float)) for column in columns]
        texts = iter([low if low == high else f"{low} to {high}" for low, high in ends])
        reason = re.sub("#", lambda _, texts=texts: next(texts), kind)
        result += [Left(name=entry.name, reason=reason) for entry in alike]
    return result


def _finite(value: Any) -> Any:
    """Return plain values in which None stands for numbers that are not finite, which JSON lacks."""
    if isinstance(value, dict):
        return {key: _finite(entry) for key, entry in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(entry) for entry in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
