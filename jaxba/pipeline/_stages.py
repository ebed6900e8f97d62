"""The pipeline on one screen: each stage, and what of the stages before it goes into it.

A stage is a module with frozen `Inputs`, `Params`, `Outputs` and `run(inputs, params)`. `features` and `match` run once
a photo, in worker processes. Here alone stands which stage needs what; which stage a changed parameter reruns follows
from the contents of its inputs.
"""

import dataclasses
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from jaxba.engine._parameters import Parameters
from jaxba.engine._stage import Item, Pipeline, Stage
from jaxba.engine._store import load
from jaxba.engine._versions import versions_of
from jaxba.engine._work import Work
from jaxba.engine._workers import Resources
from jaxba.pipeline import adjust, control, crs, export, features, match, metadata, pairs, retrieval, start, tracks
from jaxba.pipeline._done import Done, made
from jaxba.pipeline._fallback import FallbackKeypoints, WithFallback
from jaxba.pipeline._settings import sections
from jaxba.pipeline._tiles import Tiles
from jaxba.scene import LEARNED, LeftOut, PairRecord, Reference, ViewGraph
from jaxba.vision import learned_packages


def _metadata(done: Done) -> metadata.Inputs:
    name, text = done.geotags or ("geo.txt", None)
    return metadata.Inputs(
        files=done.files, geotags=text, geotags_name=name, is_geotags_found="geotags" in done.found_lists,
        own_lists=done.own_lists,
    )  # fmt: skip


def _crs(done: Done) -> crs.Inputs:
    return crs.Inputs(photos=done.photos)


def _control(done: Done) -> control.Inputs:
    return control.Inputs(
        photos=done.photos,
        reference=made(done.crs).reference,
        target_crs=made(done.crs).target_crs,
        gcp=done.gcp,
        check=done.check,
        bars=done.bars,
        is_gcp_found="gcp" in done.found_lists,
    )


def _pairs(done: Done) -> pairs.Inputs:
    return pairs.Inputs(photos=done.photos, reference=done.placed)


def _features(done: Done) -> list[Item]:
    """Each photo with what was decided for the block; the figures behind it may change as long as it stays."""
    routing, params, items = done.routing, done.settings["features"], []
    assert isinstance(params, features.Params)
    used = versions_of(learned_packages(routing.detector)) if routing.detector in LEARNED else None
    for photo in done.photos:
        inputs = features.Inputs(
            photo=photo,
            detector=routing.detector,
            is_height_varying=routing.is_height_varying and routing.detector == "orb",  # nothing to others
        )
        identity = {
            "photo": (photo.sha256, photo.width_px),
            "mask": None if photo.mask is None else photo.mask.sha256,
            "detector": inputs.detector,
            "varying height": inputs.is_height_varying,
            "learned by": used,
        }
        megapixels = features.megapixels_to_hold(photo, routing.detector, params)
        items.append(Item(photo.name, inputs, identity, megapixels))
    return items


def _features_collected(done: Done, folders: dict[int, Path], digests: dict[int, str]) -> features.Detected:
    return features.Detected(folders, digests, done.routing)


def _features_fit(folder: Path, items: Sequence[Work], params: features.Params, resources: Resources) -> None:
    features.check_store(folder, len(items), items[0].inputs.detector, params, resources)


def _features_left_out(done: Done) -> tuple[LeftOut, ...]:
    found = () if done.match is None else done.match.fallback
    matched = {done.photos[entry.image].name for entry in found}  # SIFT found some after all
    return tuple(entry for entry in done.features_left_out if entry.name not in matched)


def _without_keypoints(done: Done, found: features.Detected) -> tuple[LeftOut, ...]:
    empty = {index: entry for index in sorted(found) if (entry := found[index]).num_keypoints == 0}
    return tuple(LeftOut(name=done.photos[i].name, reason="; ".join(f.notes) + ".") for i, f in empty.items())


def _retrieval(done: Done) -> retrieval.Inputs:
    found = made(done.pairs)
    return retrieval.Inputs(
        pairs=found.pairs,
        overlap=found.overlap,
        by_order=found.by_order,
        features=made(done.features) if len(found.by_order) else {},
    )


def _partners(done: Done) -> list[np.ndarray]:
    """Return for each photo the rows of the candidate pairs that it is matched in: its partners come after it."""
    is_described = np.zeros(len(done.photos), bool)
    is_described[list(made(done.features))] = True
    pairs = made(done.retrieval).pairs  # in rising order
    ends = np.searchsorted(pairs[:, 0], np.arange(len(done.photos) + 1))
    return [
        rows[is_described[pairs[rows, 1]]] if is_described[image] else rows[:0]
        for image, rows in enumerate(map(np.arange, ends[:-1], ends[1:]))
    ]


def _match(done: Done) -> list[Item]:
    """Each photo with its partners alone, counted from 0, placed from the photo: no other photo changes any of it.

    Rounded, since a photo more or less may move the origin of heights: 0.1 mm and a thousandth of the overlap.
    Heights above ground, the files and their size count where ORB may fall back to SIFT, and nowhere else.
    """
    items, reference = [], done.placed
    found, candidates = made(done.features), made(done.retrieval)
    is_orb = any(found[index].detector == "orb" for index in list(found)[:1])  # all are of one kind
    for image, (photo, rows) in enumerate(zip(done.photos, _partners(done), strict=True)):
        if len(rows) == 0:
            continue
        images = [image, *candidates.pairs[rows, 1].tolist()]
        photos = tuple(done.photos[i] for i in images)
        inputs = match.Inputs(
            image=0,
            partners=np.arange(1, len(images)),
            overlap=np.round(candidates.overlap[rows], 3),
            photos=photos,
            reference=_reference_of(reference, images, with_heights=is_orb),
            features=found.only(images),
        )
        identity = {
            "cameras": [(entry.focal_px, entry.width_px, entry.height_px) for entry in photos],
            "overlap": inputs.overlap,
            "positions and attitudes": inputs.reference,
            "features": inputs.features,
        }
        megapixels = 1.0
        if np.isfinite(inputs.reference.height_above_ground_m[0]):
            identity["photos"] = [(entry.sha256, entry.mask.sha256 if entry.mask else None) for entry in photos]
            megapixels = max(entry.megapixels for entry in photos)
        items.append(Item(photo.name, inputs, identity, megapixels, len(rows)))
    return items


def _reference_of(reference: Reference, images: list[int], *, with_heights: bool) -> Reference:
    """Return what is measured of some images, without a frame, positions from the first of them."""
    heights_m = np.round(reference.height_above_ground_m[images], 2)
    xyz_m = reference.xyz_m[images]
    return Reference(
        frame=None,
        xyz_m=np.round(xyz_m - xyz_m[0], 4) + 0.0,  # no -0.0
        std_m=np.round(reference.std_m[images], 6),
        quaternion=reference.quaternion[images],
        attitude_std_rad=reference.attitude_std_rad[images],
        is_used=reference.is_used[images],
        height_above_ground_m=heights_m if with_heights else np.full(len(images), np.nan),
    )


def _match_collected(done: Done, folders: dict[int, Path], digests: dict[int, str]) -> match.Outputs:
    graphs, records, notes = [], [], []
    fallback: dict[int, FallbackKeypoints] = {}
    partners = _partners(done)
    for image in sorted(folders):
        part = load(folders[image], match.Outputs)
        pairs = made(done.retrieval).pairs[partners[image]]
        graphs.append(dataclasses.replace(part.view_graph, pairs=np.ascontiguousarray(pairs)))
        images = [image, *pairs[:, 1].tolist()]
        for entry in part.fallback:  # the same of an image, whichever photo it was matched with
            fallback.setdefault(images[entry.image], dataclasses.replace(entry, image=images[entry.image]))
        records.append(part.record)
        notes += part.notes
    found = tuple(fallback[image] for image in sorted(fallback))
    graph, record = ViewGraph.concatenate(graphs), PairRecord.concatenate(records)  # rising already: the same order
    return match.Outputs(view_graph=graph, record=record, fallback=found, notes=tuple(notes))


def _tracks(done: Done) -> tracks.Inputs:
    found, matched = made(done.features), made(done.match)
    described = WithFallback(found, matched.fallback) if matched.fallback else found
    return tracks.Inputs(photos=done.photos, features=described, view_graph=matched.view_graph)


def _start(done: Done) -> start.Inputs:
    return start.Inputs(
        photos=done.photos,
        reference=done.placed,
        view_graph=made(done.match).view_graph,
        tracks=made(done.tracks).tracks,
        control=made(done.control).control.without_check_points(),
    )


def _adjust(done: Done) -> adjust.Inputs:
    tiles, block = done.settings["tiles"], made(done.start).block
    assert isinstance(tiles, Tiles)
    assumed_datum = made(done.control).reference.assumed_datum
    return adjust.Inputs(
        photos=done.photos,
        reference=dataclasses.replace(done.placed, assumed_datum=assumed_datum),
        view_graph=made(done.match).view_graph,
        tracks=made(done.tracks).tracks,
        block=block,
        features=made(done.features),
        control=made(done.control).control,
        bars=made(done.control).bars,
        chunk_size=tiles.chunk_size if block.num_images > tiles.chunk_size else None,
    )


def _export(done: Done) -> export.Inputs:
    placed = made(done.control)
    return export.Inputs(
        photos=done.photos,
        reference=placed.reference,
        adjusted=made(done.adjust),
        control=placed.control,
        bars=placed.bars,
    )


STAGES = (
    Stage(metadata, _metadata, left_out=lambda done: done.metadata.left_out, reads_places=True, reads_given=True),
    Stage(crs, _crs),
    Stage(control, _control, reads_given=True),
    Stage(pairs, _pairs),
    Stage(features, _features, _features_collected, _features_left_out, _without_keypoints, _features_fit),
    Stage(retrieval, _retrieval),
    Stage(match, _match, _match_collected, lambda done: done.match_left_out),
    Stage(tracks, _tracks),
    Stage(start, _start, left_out=lambda done: done.start.block.unregistered),
    Stage(adjust, _adjust, left_out=lambda done: done.adjust.block.unregistered, takes_room=True),
    Stage(export, _export, writes_files=True),
)
NAMES = tuple(stage.name for stage in STAGES)
PIPELINE = Pipeline(STAGES, sections({stage.name: stage.module.Params() for stage in STAGES}), Done)


def default_settings() -> dict[str, Parameters]:
    """Return the defaults of every section, to be changed and handed to a run."""
    return dict(PIPELINE.settings)
