"""Limits that stop a run before it wastes hours: what would not fit on the disk, too many photos that fail."""

import shutil
from collections.abc import Sequence
from pathlib import Path

from jaxba._errors import JaxbaError
from jaxba._sizes import bytes_of, size_text
from jaxba.engine._workers import Resources
from jaxba.scene import LeftOut

_SHOWN = 3


def check_room(store: Path, need: float, resources: Resources, *, what: str, each: str, cure: str) -> None:
    """Raise `JaxbaError` where bytes may not fit on the disk, or are more than is allowed.

    - `store`: the folder where they are to lie; what lies there already is theirs, or is replaced: it counts as free.
    - `what`: they are, with how many. `each`: what one of these takes. `cure`: what to do other than allow more.
    """
    place = next(folder for folder in (store, *store.absolute().parents) if folder.exists())
    free = float(shutil.disk_usage(place).free)
    used = sum(path.stat().st_size for path in store.rglob("*") if path.is_file())
    allowed = min(bytes_of(resources.max_store, free + used), free + used)
    if need > allowed:
        raise JaxbaError(
            f"{what} take up to {size_text(need)} on the disk, {each}; --max-store {resources.max_store} allows "
            f"{size_text(allowed)}, {size_text(free)} are free. {cure}, raise --max-store, or choose an --out on a "
            "larger disk."
        )


def check_failures(stage: str, failed: Sequence[LeftOut], total: int, resources: Resources) -> None:
    """Raise `JaxbaError` where more of a stage's photos failed than may."""
    if len(failed) <= resources.num_may_fail(total):
        return
    raise JaxbaError(
        f"stage {stage}: {len(failed)} of {total} photos failed, and --max-failed {resources.max_failed:g} allows "
        f"{resources.num_may_fail(total)}: {_reasons(failed)}. What is done is kept; see to these photos and run "
        "again, or raise --max-failed."
    )


def _reasons(failed: Sequence[LeftOut]) -> str:
    """Return the commonest reasons, each with the photos that it concerns."""
    names: dict[str, list[str]] = {}
    for left in failed:
        names.setdefault(left.reason.removesuffix("."), []).append(left.name)
    commonest = sorted(names.items(), key=lambda entry: -len(entry[1]))
    texts = [
        ", ".join(found[:_SHOWN]) + (f" and {len(found) - _SHOWN} more" if len(found) > _SHOWN else "") + f": {reason}"
        for reason, found in commonest[:_SHOWN]
    ]
    rest = len(commonest) - _SHOWN
    return "; ".join(texts) + (f"; and {rest} other reasons" if rest > 0 else "")
