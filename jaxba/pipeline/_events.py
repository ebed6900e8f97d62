"""What a run tells while it goes, and what it hands back."""

from dataclasses import dataclass
from typing import Any, Literal

from jaxba.pipeline._stages import Done
from jaxba.scene import Left


@dataclass(frozen=True)
class Event:
    """What a run tells while it goes.

    - `kind`: `begin` and `end` of a stage; `todo` where it has anything to do, before it does so, with `by_photos`
      photo by photo; `photo` after each of them.
    - `done`, `total`: photos that were worked on; `total` 0 means that nothing had to be done.
    - `share`: of a stage's work that is done, where photos count by their megapixels and by the photos beside them.
    - `outputs`: at the end, what the stage made. `left_out`: files that no stage before left out, and this one did;
      after a photo, that one, where it failed. `notes`: what should be known of how the stage was done.
    - `photos`: at the end, the names of the photos by image index.
    """

    kind: Literal["begin", "todo", "photo", "end"]
    stage: str
    done: int = 0
    total: int = 0
    seconds: float = 0.0
    outputs: Any = None
    left_out: tuple[Left, ...] = ()
    photos: tuple[str, ...] = ()
    share: float = 0.0
    notes: tuple[str, ...] = ()
    by_photos: bool = False


@dataclass(frozen=True)
class Run:
    """What a run made, stage by stage, and which stages had anything to do.

    - `lines`: what each stage said, as `stage_lines` has it.
    - `stopped`: the stage that could not end, and why; None where all did.
    """

    done: Done
    stages_run: tuple[str, ...]
    lines: dict[str, list[str]]
    stopped: Left | None = None
