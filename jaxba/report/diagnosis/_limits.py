"""Rules on limits: a run that was killed, photos that need more memory than is allowed, features that do not fit."""

from jaxba._sizes import bytes_of, machine_memory, size_text
from jaxba.engine import _items
from jaxba.engine._words import some
from jaxba.engine._workers import Resources, memory_for
from jaxba.report._recorded import Recorded
from jaxba.report.diagnosis._diagnosis import Diagnosis
from jaxba.scene import LeftOut
from jaxba.vision import most_keypoints, store_bytes

_BY_PHOTOS = ("features", "match")


def killed(case: Recorded) -> Diagnosis | None:
    """The run was killed: what it needed there against what the machine has."""
    if case.killed is None:
        return None
    stage, photos = case.killed, () if case.done.metadata is None else case.done.photos
    resources: Resources = case.done.settings["workers"]
    cause, figures = f"The run was killed in stage {stage}", {"stage": stage}
    if photos and stage in _BY_PHOTOS:
        largest = max(photos, key=lambda photo: photo.megapixels)
        need = memory_for(largest.megapixels)
        count = resources.num_workers(need)
        figures |= {"workers": count, "need_bytes": count * need, "allowed_bytes": resources.memory_bytes}
        cause += (
            f": {count} workers take up to {count * need / 1e9:.1f} GB at {largest.megapixels:.1f} megapixels, "
            f"workers.max_memory={resources.max_memory} allows {resources.memory_bytes / 1e9:.1f} GB of "
            f"{machine_memory() / 1e9:.1f} GB"
        )
    elif photos:
        size = "" if case.done.tracks is None else f", {case.done.tracks.tracks.num_observations:,} observations"
        cause += f": {len(photos):,} photos{size}, {machine_memory() / 1e9:.1f} GB of memory"
    return Diagnosis(
        name="killed",
        cause=f"{cause}. By the system where memory ended, by a time limit, or by hand.",
        cure="Run again: what is done is kept. If it is killed in the same stage again, set fewer features.nfeatures, "
        "use fewer --workers or a lower --max-memory, or smaller parts of the block.",
        figures=figures,
    )


def over_memory(case: Recorded) -> Diagnosis | None:
    """Photos that cannot be worked on within the memory that is allowed, or whose worker died of it."""
    if case.done.metadata is None:
        return None
    resources: Resources = case.done.settings["workers"]
    allowed = resources.memory_bytes
    need = {photo.name: memory_for(photo.megapixels) for photo in case.done.photos}
    over = [name for name, count in need.items() if count > allowed]
    lost = [left for left in _failed(case) if _items.lacked_memory(left.reason) and left.name not in over]
    names = [*over, *(left.name for left in lost)]
    if not names:
        return None
    largest = max(need[name] for name in names)
    allows = f"workers.max_memory={resources.max_memory} allows {size_text(allowed)}"
    causes, cures = [], []
    if over:
        causes.append(
            f"{len(over)} of {len(need)} photos do not fit into the memory ({some(over, 3)}): one takes up to "
            f"{size_text(largest)}, {allows}."
        )
        cures.append("Raise --max-memory, or scale the photos down.")
    if lost:
        causes.append(
            f"The workers of {len(lost)} of {len(need)} photos ended as they do without memory "
            f"({some([left.name for left in lost], 3)}), the first: {lost[0].reason.rstrip('.')}. {allows}."
        )
        cures.append("Use fewer --workers, set fewer features.nfeatures, or close other programs.")
    return Diagnosis(
        name="out of memory",
        cause=" ".join(causes),
        cure=" ".join(cures),
        figures={"photos": names, "need_bytes": largest, "allowed_bytes": allowed},
    )


def crashed(case: Recorded) -> Diagnosis | None:
    """Photos whose worker died of something else than memory: a broken file that crashes the decoder."""
    lost = [left for left in _failed(case) if _items.crashed(left.reason)]
    if not lost:
        return None
    names = [left.name for left in lost]
    return Diagnosis(
        name="crash",
        cause=f"The workers of {len(lost)} photos died ({some(names, 3)}), the first: {lost[0].reason.rstrip('.')}.",
        cure="Open these photos in another program; copy them anew from the card, or leave them out.",
        figures={"photos": names},
    )


def _failed(case: Recorded) -> list[LeftOut]:
    """Return the photos that failed where photos are worked on, each once."""
    found = {left.name: left for name in _BY_PHOTOS for left in case.failed.get(name, ())}
    return list(found.values())


def over_store(case: Recorded) -> Diagnosis | None:
    """Features that would not fit on the disk."""
    if case.stopped is None or case.stopped.name != "features" or case.done.pairs is None:
        return None
    resources: Resources = case.done.settings["workers"]
    detector, nfeatures = case.done.routing.detector, case.done.settings["features"].nfeatures
    need = store_bytes(len(case.done.photos), detector, most_keypoints(detector, nfeatures))
    allowed = bytes_of(resources.max_store, float("nan"))  # a share of a disk whose room has changed since says nothing
    if not need > allowed:
        return None
    return Diagnosis(
        name="out of disk",
        cause=f"Features of {len(case.done.photos):,} photos take up to {size_text(need)} on the disk, "
        f"workers.max_store={resources.max_store} allows {size_text(allowed)}.",
        cure="Set fewer features.nfeatures, take fewer photos, or raise --max-store.",
        figures={"need_bytes": need, "allowed_bytes": allowed},
    )


def out_of_date(case: Recorded) -> Diagnosis | None:
    """A run that ended, whose records are of other inputs or other code: they say nothing."""
    if case.stale is None or case.stopped is not None or case.killed is not None or case.running is not None:
        return None
    return Diagnosis(
        name="out of date",
        cause=f"What stage {case.stale} recorded was made from other inputs or parameters, or by another version of "
        "jaxba: it is not looked at, nor what follows it.",
        cure="Run again; `jaxba status` tells what has to be made anew.",
        figures={"stage": case.stale},
    )


def stopped(case: Recorded) -> Diagnosis | None:
    """What the run itself said when it stopped."""
    if case.stopped is None:
        return None
    return Diagnosis(
        name="stopped",
        cause=f"The run stopped in stage {case.stopped.name}: {case.stopped.reason}",
        cure="Do what the message says and run again: what is done is kept.",
        figures={"stage": case.stopped.name},
    )
