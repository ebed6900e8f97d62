"""What the sentences on a stage need beside what it made."""

from dataclasses import dataclass, field

from jaxba.scene import Control, LeftOut, ScaleBars


@dataclass(frozen=True, kw_only=True)
class Told:
    """What is known of a run when a stage's `lines` and `facts` are asked for.

    - `photos`: names, by image index. `left_out`: files that no stage before left out, and this one did.
    - `control`: the surveyed points. `bars`: the scale bars.
    """

    photos: tuple[str, ...] = ()
    left_out: tuple[LeftOut, ...] = ()
    control: Control = field(default_factory=Control.nothing)
    bars: ScaleBars = field(default_factory=ScaleBars.nothing)
