"""The pipeline on one screen: each stage, and what of the stages before it goes into it.

A stage is a module with frozen `Inputs`, `Params`, `Outputs` and `run(inputs, params)`. `features` and `match` run once
a photo, in worker processes. Here alone stands which stage needs what; which stage a changed parameter reruns follows
from the contents of its inputs.
"""

import dataclasses
import importlib
from collections.abc import Callable
from dataclasses import dataclass
from types import ModuleType
from typing import Any

import numpy as np

from jaxba.pipeline import adjust, crs, export, features, match, metadata, pairs, start, tracks
from jaxba.pipeline._store import Stored
from jaxba.scene import Left, PhotoFile, Reference, ViewGraph


@dataclass
class Done:
    """What the stages so far have made; None where a stage has not run."""

    files: tuple[PhotoFile, ...]
    geotags: tuple[str, str] | None = None
    metadata: Any = None
    crs: Any = None
    features: Any = None
    features_left_out: tuple[Left, ...] = ()
    pairs: Any = None
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
        frame = self.crs.reference.frame
        if frame is None:
            return self.crs.reference
        frame = dataclasses.replace(
            frame, crs="", epsg=None, crs_name="", unit="", height_note="", height_datum="", height_unit=""
        )
        return dataclasses.replace(self.crs.reference, frame=frame, review=(), notes=())


@dataclass(frozen=True)
class PhotoItem:
    """The inputs of one photo, what of them counts for the fingerprint, and the photo's size."""

    name: str
    inputs: Any
    identity: Any
    megapixels: float


@dataclass(frozen=True)
class Stage:
    """- `inputs`: from what is done. `collect`: for a stage that runs once a photo, from its items' folders."""

    module: ModuleType
    inputs: Callable[[Done], Any]
    collect: Callable[[Done, dict[int, Any], dict[int, str]], Any] | None = None

    @property
    def name(self) -> str:
        return self.module.__name__.rpartition(".")[2]


def _metadata(done: Done) -> metadata.Inputs:
    name, text = done.geotags or ("geo.txt", None)
    return metadata.Inputs(files=done.files, geotags=text, geotags_name=name)


def _crs(done: Done) -> crs.Inputs:
    return crs.Inputs(photos=done.photos)


def _features(done: Done) -> list[PhotoItem]:
    return [
        PhotoItem(photo.name, features.Inputs(photo=photo), (photo.sha256, photo.width_px), photo.megapixels)
        for photo in done.photos
    ]


def _features_collected(done: Done, folders: dict[int, Any], digests: dict[int, str]) -> Stored:
    return Stored(features.Outputs, "features", folders, digests)


def _pairs(done: Done) -> pairs.Inputs:
    return pairs.Inputs(photos=done.photos, reference=done.placed)


def _match(done: Done) -> list[PhotoItem]:
    items, described, reference = [], np.array(sorted(done.features), dtype=int), done.placed
    for image, photo in enumerate(done.photos):
        rows = (done.pairs.pairs[:, 0] == image) & np.isin(done.pairs.pairs[:, 1], described)
        partners, overlap = np.asarray(done.pairs.pairs[rows, 1]), np.asarray(done.pairs.overlap[rows])
        images = [image, *partners.tolist()]
        if image not in done.features or len(partners) == 0:
            continue
        inputs = match.Inputs(
            image=image,
            partners=partners,
            overlap=overlap,
            photos=done.photos,
            reference=reference,
            features=done.features.only(images),
        )
        shapes = [(done.photos[i].focal_px, done.photos[i].width_px, done.photos[i].height_px) for i in images]
        columns = ("xyz_m", "std_m", "quaternion", "attitude_std_rad", "is_used")
        placed = [getattr(reference, column)[images] for column in columns]
        items.append(PhotoItem(photo.name, inputs, (images, overlap, shapes, placed, inputs.features), 1.0))
    return items


def _match_collected(done: Done, folders: dict[int, Any], digests: dict[int, str]) -> match.Outputs:
    parts = Stored(match.Outputs, "view_graph", folders, digests)
    return match.Outputs(view_graph=ViewGraph.concatenate([parts[i] for i in sorted(parts)]))


def _tracks(done: Done) -> tracks.Inputs:
    return tracks.Inputs(photos=done.photos, features=done.features, view_graph=done.match.view_graph)


def _start(done: Done) -> start.Inputs:
    return start.Inputs(
        photos=done.photos,
        reference=done.placed,
        view_graph=done.match.view_graph,
        tracks=done.tracks.tracks,
    )


def _adjust(done: Done) -> adjust.Inputs:
    return adjust.Inputs(
        photos=done.photos,
        reference=done.placed,
        view_graph=done.match.view_graph,
        tracks=done.tracks.tracks,
        block=done.start.block,
    )


def _export(done: Done) -> export.Inputs:
    return export.Inputs(photos=done.photos, reference=done.crs.reference, adjusted=done.adjust)


STAGES = (
    Stage(metadata, _metadata),
    Stage(crs, _crs),
    Stage(features, _features, _features_collected),
    Stage(pairs, _pairs),
    Stage(match, _match, _match_collected),
    Stage(tracks, _tracks),
    Stage(start, _start),
    Stage(adjust, _adjust),
    Stage(export, _export),
)
NAMES = tuple(stage.name for stage in STAGES)


def run_photo(module: str, folder: Any, inputs: Any, params: Any, key: str) -> str | None:
    """Run a stage for one photo in a worker and save what it makes; return why it could not, or None."""
    from jaxba._errors import JaxbaError
    from jaxba.pipeline._store import save, save_failure

    stage = importlib.import_module(module)
    try:
        outputs = stage.run(inputs, params)
    except JaxbaError as error:
        save_failure(folder, str(error), key)
        return str(error)
    save(folder, outputs, key)
    return None
