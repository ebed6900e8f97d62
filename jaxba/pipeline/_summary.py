"""What a run tells people: a line or two a stage as it ends, and the facts of the whole run for JSON."""

from typing import Any

import numpy as np

from jaxba.pipeline._runner import Event, Run
from jaxba.scene import EdgeStatus, Left, ViewGraph


def stage_lines(event: Event) -> list[str]:
    """Return what a stage made in one line, then its notes and what it could not use."""
    outputs = event.outputs
    notes: list[str] = []
    if event.stage == "metadata":
        cameras = len({photo.camera for photo in outputs.photos})
        first = f"{_many(len(outputs.photos), 'photo')}, {_many(cameras, 'camera')}"
        notes = [*outputs.notes, *_left(outputs.left_out)]
    elif event.stage == "crs":
        reference = outputs.reference
        where = reference.frame.crs_name if reference.frame is not None else "no place on earth"
        first = f"{where}; {int(reference.is_used.sum())} of {len(reference.is_used)} positions used"
        notes = [*reference.notes, *_left(reference.review)]
    elif event.stage == "features":
        counts = [outputs[index].num_keypoints for index in sorted(outputs)]
        first = f"{sum(counts):,} keypoints, median {int(np.median(counts)):,} an image" if counts else "no keypoints"
        notes = _left(event.left_out)
    elif event.stage == "pairs":
        share = f" ({len(outputs.pairs) / outputs.num_all:.0%})" if outputs.num_all else ""
        first = f"{len(outputs.pairs):,} of {outputs.num_all:,} pairs{share}, {outputs.method}"
        notes = list(outputs.notes)
    elif event.stage == "match":
        graph: ViewGraph = outputs.view_graph
        good, weak = (int((graph.status == status).sum()) for status in (EdgeStatus.GOOD, EdgeStatus.WEAK))
        rejected = len(graph.pairs) - good - weak
        first = f"{good:,} good pairs, {weak:,} weak, {rejected:,} rejected; {len(graph.matches):,} matches"
        notes = _left(event.left_out)
    elif event.stage == "tracks":
        tracks = outputs.tracks
        groups = [len(component) for component in tracks.components]
        first = (
            f"{tracks.num_tracks:,} tracks, {tracks.num_observations:,} observations; largest group {groups[0]} images"
        )
    elif event.stage == "start":
        block = outputs.block
        first = f"{block.num_images} images, {block.num_points:,} points"
        notes = [*block.notes, *_left(block.unregistered)]
    elif event.stage == "adjust":
        first = f"median {outputs.median_px:.2f} px, {_many(outputs.rounds, 'round')}"
    else:
        first = _many(len(outputs.files), "file")
        notes = list(outputs.notes)
    return [first, *notes]


def summary(run: Run) -> dict[str, Any]:
    """Return the facts of a run as plain values: figures of the result, and all that was left out, named."""
    done = run.done
    facts: dict[str, Any] = {"stages_run": list(run.stages_run)}
    left: list[tuple[str, Left]] = []
    if done.metadata is not None:
        left += [("metadata", entry) for entry in done.metadata.left_out]
    left += [("features", entry) for entry in done.features_left_out]
    left += [("match", entry) for entry in done.match_left_out]
    if done.crs is not None:
        reference = done.crs.reference
        frame = reference.frame
        facts["crs"] = {
            "name": None if frame is None else frame.crs_name,
            "epsg": None if frame is None else frame.epsg,
            "heights": None if frame is None else frame.height_note,
            "review": [{"name": entry.name, "reason": entry.reason} for entry in reference.review],
        }
    if done.pairs is not None:
        facts["pairs"] = {"candidates": len(done.pairs.pairs), "all": done.pairs.num_all, "method": done.pairs.method}
    if done.adjust is not None:
        adjusted = done.adjust
        block = adjusted.block
        left += [("start", entry) for entry in block.unregistered]
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
    if done.export is not None:
        facts["export"] = {"files": list(done.export.files), "notes": list(done.export.notes)}
    facts["left_out"] = [{"stage": stage, "name": entry.name, "reason": entry.reason} for stage, entry in left]
    return facts


def _left(entries: tuple[Left, ...]) -> list[str]:
    return [f"{entry.name}: {entry.reason}" for entry in entries]


def _many(count: int, noun: str) -> str:
    return f"{count:,} {noun}{'' if count == 1 else 's'}"
