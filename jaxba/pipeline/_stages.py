"""The pipeline on one screen: each stage, and what of the stages before it goes into it.

A stage is a module with frozen `Inputs`, `Params`, `Outputs` and `run(inputs, params)`. `features` and `match` run once
a photo, in worker processes. Here alone stands which stage needs what; which stage a changed parameter reruns follows
from the contents of its inputs.
"""

import dataclasses
import errno
import importlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from types import ModuleType
from typing import Any

import numpy as np

from jaxba.engine._key import Key
from jaxba.engine._store import load
from jaxba.pipeline import adjust, control, crs, export, features, match, metadata, pairs, start, tracks
from jaxba.pipeline._detected import Detected
from jaxba.pipeline._fallback import FallbackKeypoints, WithFallback
from jaxba.pipeline._pair_record import PairRecord
from jaxba.pipeline._routing import Routing, route
from jaxba.scene import Left, PhotoFile, Reference, ViewGraph


@dataclass
class Done:
    """What the stages so far have made; None where a stage has not run. `settings`: parameters by stage."""

    files: tuple[PhotoFile, ...]
    settings: Mapping[str, Any]
    geotags: tuple[str, str] | None = None
    gcp: tuple[str, str] | None = None
    check: tuple[str, str] | None = None
    metadata: Any = None
    crs: Any = None
    control: Any = None
    pairs: Any = None
    features: Any = None
    features_left_out: tuple[Left, ...] = ()
    match: Any = None
    match_left_out: tuple[Left, ...] = ()
    tracks: Any = None
    start: Any = None
    adjust: Any = None
    export: Any = None

    @property
    def photos(self) -> Any:
        return self.metadata.photos

    @property
    def placed(self) -> Reference:
        """The reference without the target CRS: nothing before the export depends on it."""
        frame = self.control.reference.frame
        if frame is None:
            return self.control.reference
        frame = dataclasses.replace(
            frame, crs="", epsg=None, crs_name="", unit="", height_note="", height_datum="", height_unit=""
        )
        return dataclasses.replace(self.control.reference, frame=frame, review=(), notes=())

    @property
    def routing(self) -> Routing:
        """The detector of the block, and the figures behind it."""
        params, found = self.settings["features"], self.pairs
        return route(
            self.photos,
            self.crs.reference,
            found.pairs,
            found.overlap,
            detector=params.detector,
            sift_gsd_m=params.sift_gsd,
            sift_overlap=params.sift_overlap,
        )


@dataclass(frozen=True)
class PhotoItem:
    """The inputs of one photo, what of them counts, by name, the photo's size, and how many others go with it."""

    name: str
    inputs: Any
    identity: dict[str, Any]
    megapixels: float
    partners: int = 0


@dataclass(frozen=True)
class Stage:
    """A stage and how it is fed.

    - `inputs`: from what is done. `collect`: for a stage that runs once a photo, from its items' folders.
    - `useless`: photos of which such a stage made something that nothing can be done with.
    """

    module: ModuleType
    inputs: Callable[[Done], Any]
    collect: Callable[[Done, dict[int, Any], dict[int, str]], Any] | None = None
    useless: Callable[[Done, Any], tuple[Left, ...]] = lambda done, outputs: ()

    @property
    def name(self) -> str:
        return self.module.__name__.rpartition(".")[2]


def _metadata(done: Done) -> metadata.Inputs:
    name, text = done.geotags or ("geo.txt", None)
    return metadata.Inputs(files=done.files, geotags=text, geotags_name=name)


def _crs(done: Done) -> crs.Inputs:
    return crs.Inputs(photos=done.photos)


def _control(done: Done) -> control.Inputs:
    return control.Inputs(
        photos=done.photos,
        reference=done.crs.reference,
        target_crs=done.crs.target_crs,
        gcp=done.gcp,
        check=done.check,
    )


def _pairs(done: Done) -> pairs.Inputs:
    return pairs.Inputs(photos=done.photos, reference=done.placed)


def _features(done: Done) -> list[PhotoItem]:
    """Each photo with what was decided for the block; the figures behind it may change as long as it stays."""
    routing = done.routing
    items = []
    for photo in done.photos:
        inputs = features.Inputs(
            photo=photo,
            detector=routing.detector,
            is_height_varying=routing.is_height_varying and routing.detector == "orb",  # nothing to others
        )
        identity = {
            "photo": (photo.sha256, photo.width_px),
            "detector": inputs.detector,
            "varying height": inputs.is_height_varying,
        }
        items.append(PhotoItem(photo.name, inputs, identity, photo.megapixels))
    return items


def _features_collected(done: Done, folders: dict[int, Any], digests: dict[int, str]) -> Detected:
    return Detected(folders, digests, done.routing)


def _without_keypoints(done: Done, found: Detected) -> tuple[Left, ...]:
    empty = {index: features for index in sorted(found) if (features := found[index]).num_keypoints == 0}
    return tuple(Left(name=done.photos[i].name, reason="; ".join(f.notes) + ".") for i, f in empty.items())


def _partners(done: Done, image: int) -> np.ndarray:
    """Return the rows of the candidate pairs that a photo is matched in: its partners come after it."""
    described = np.array(sorted(done.features), dtype=int)
    first, second = done.pairs.pairs[:, 0], done.pairs.pairs[:, 1]
    return np.flatnonzero((first == image) & np.isin(second, described) & np.isin(first, described))


def _match(done: Done) -> list[PhotoItem]:
    """Each photo with its partners alone, counted from 0, placed from the photo: no other photo changes any of it.

    Rounded, since a photo more or less may move the origin of heights: 0.1 mm and a thousandth of the overlap.
    Heights above ground, the files and their size count where ORB may fall back to SIFT, and nowhere else.
    """
    items, reference = [], done.placed
    is_orb = any(done.features[index].detector == "orb" for index in list(done.features)[:1])  # all are of one kind
    for image, photo in enumerate(done.photos):
        rows = _partners(done, image)
        if len(rows) == 0:
            continue
        images = [image, *done.pairs.pairs[rows, 1].tolist()]
        photos = tuple(done.photos[i] for i in images)
        inputs = match.Inputs(
            image=0,
            partners=np.arange(1, len(images)),
            overlap=np.round(done.pairs.overlap[rows], 3),
            photos=photos,
            reference=_reference_of(reference, images, with_heights=is_orb),
            features=done.features.only(images),
        )
        identity = {
            "cameras": [(entry.focal_px, entry.width_px, entry.height_px) for entry in photos],
            "overlap": inputs.overlap,
            "positions and attitudes": inputs.reference,
            "features": inputs.features,
        }
        megapixels = 1.0
        if np.isfinite(inputs.reference.height_above_ground_m[0]):
            identity["photos"] = [entry.sha256 for entry in photos]
            megapixels = max(entry.megapixels for entry in photos)
        items.append(PhotoItem(photo.name, inputs, identity, megapixels, len(rows)))
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


def _match_collected(done: Done, folders: dict[int, Any], digests: dict[int, str]) -> match.Outputs:
    graphs, records = [], []
    fallback: dict[int, FallbackKeypoints] = {}
    for image in sorted(folders):
        part = load(folders[image], match.Outputs)
        pairs = done.pairs.pairs[_partners(done, image)]
        graphs.append(dataclasses.replace(part.view_graph, pairs=np.ascontiguousarray(pairs)))
        images = [image, *pairs[:, 1].tolist()]
        for entry in part.fallback:  # the same of an image, whichever photo it was matched with
            fallback.setdefault(images[entry.image], dataclasses.replace(entry, image=images[entry.image]))
        records.append(part.record)
    found = tuple(fallback[image] for image in sorted(fallback))
    graph, record = ViewGraph.concatenate(graphs), PairRecord.concatenate(records)  # rising already: the same order
    return match.Outputs(view_graph=graph, record=record, fallback=found)


def _tracks(done: Done) -> tracks.Inputs:
    found = WithFallback(done.features, done.match.fallback) if done.match.fallback else done.features
    return tracks.Inputs(photos=done.photos, features=found, view_graph=done.match.view_graph)


def _start(done: Done) -> start.Inputs:
    return start.Inputs(
        photos=done.photos,
        reference=done.placed,
        view_graph=done.match.view_graph,
        tracks=done.tracks.tracks,
        control=done.control.control.without_check_points(),
    )


def _adjust(done: Done) -> adjust.Inputs:
    return adjust.Inputs(
        photos=done.photos,
        reference=done.placed,
        view_graph=done.match.view_graph,
        tracks=done.tracks.tracks,
        block=done.start.block,
        features=done.features,
        control=done.control.control,
    )


def _export(done: Done) -> export.Inputs:
    made = done.control
    return export.Inputs(photos=done.photos, reference=made.reference, adjusted=done.adjust, control=made.control)


STAGES = (
    Stage(metadata, _metadata),
    Stage(crs, _crs),
    Stage(control, _control),
    Stage(pairs, _pairs),
    Stage(features, _features, _features_collected, _without_keypoints),
    Stage(match, _match, _match_collected),
    Stage(tracks, _tracks),
    Stage(start, _start),
    Stage(adjust, _adjust),
    Stage(export, _export),
)
NAMES = tuple(stage.name for stage in STAGES)


def run_photo(module: str, folder: Any, inputs: Any, params: Any, key: Key) -> str | None:
    """Run a stage for one photo in a worker and save what it makes; return why it could not, or None."""
    from jaxba._errors import JaxbaError
    from jaxba.engine._store import save, save_failure

    stage = importlib.import_module(module)
    try:
        outputs = stage.run(inputs, params)
    except JaxbaError as error:
        system = error.__cause__ or error.__context__
        number = system.errno if isinstance(system, OSError) else None
        if number == errno.ENOMEM:
            raise MemoryError from error
        if number is None:  # else it is not the photo's fault but the machine's, and may go well another time
            save_failure(folder, str(error), key)
        return str(error)
    save(folder, outputs, key)
    return None
