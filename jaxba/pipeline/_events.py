"""What a run tells while it goes, and what it hands back."""

from dataclasses import dataclass
from typing import Any, Literal

from jaxba.pipeline._done import Done
from jaxba.scene import LeftOut


@dataclass(frozen=True)
class Event:
    """What a run tells while it goes.

    - `kind`: `begin` and `end` of a stage; `todo` where it has anything to do, before it does so, with `by_photos`
      photo by photo; `photo` after each of them.
    - `done`, `total`: photos that were worked on; `total` 0 means that nothing had to be done.
    - `share`: of a stage's work that is done, where photos count by their megapixels and by the photos beside them.
    - `left_out`: files that no stage before left out, and this one did; after a photo, that one, where it failed.
    - `lines`: at the end, what the stage made in words: one line, then notes and what it could not use.
    """

    kind: Literal["begin", "todo", "photo", "end"]
    stage: str
    done: int = 0
    total: int = 0
    seconds: float = 0.0
    left_out: tuple[LeftOut, ...] = ()
    share: float = 0.0
    lines: tuple[str, ...] = ()
    by_photos: bool = False


@dataclass(frozen=True)
class Run:
    """What a run made, stage by stage, and which stages had anything to do.

    - `facts`: of the run as plain values, as `summary.json` holds them.
    """

    done: Done
    stages_run: tuple[str, ...]
    facts: dict[str, Any]
