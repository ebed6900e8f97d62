"""The facts of a whole run, as plain values for JSON: figures of the result, and all that was left out, named."""

import math
from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any

from jaxba.engine._stage import Stage, left_out
from jaxba.report._told import Told
from jaxba.scene import Control, LeftOut, ScaleBars, described


def told_of(done: Any, left_out: tuple[LeftOut, ...] = ()) -> Told:
    """Return what the stages' `lines` and `facts` need, from what is done so far. `left_out`: by the stage in hand."""
    names = () if done.metadata is None else tuple(photo.name for photo in done.photos)
    control, bars = Control.nothing(), ScaleBars.nothing()
    if done.control is not None:
        control, bars = done.control.control, done.control.bars
    return Told(photos=names, left_out=left_out, control=control, bars=bars)


def summary(
    stages: Sequence[Stage],
    done: Any,
    *,
    stages_run: Sequence[str],
    lines: Mapping[str, Sequence[str]],
    stopped: LeftOut | None = None,
) -> dict[str, Any]:
    """Return the facts of a run: what each stage says, and the `facts` of each that has made something.

    - `stages_run`: those that had anything to do. `stopped`: the stage that could not end, and why.

    `left_out` names each file once, with the first stage that could not use it. Numbers that are not finite are None.
    """
    facts: dict[str, Any] = {"stages_run": list(stages_run)}
    if stopped is not None:
        facts["stopped"] = {"stage": stopped.name, "reason": stopped.reason}
    facts["stages"] = {stage: list(said) for stage, said in lines.items()}
    told = told_of(done)
    for stage in stages:
        outputs = getattr(done, stage.name)
        if outputs is not None:
            found, notes = described("the figures of this stage", partial(stage.module.facts, outputs, told), {})
            facts |= found
            if notes:
                facts["stages"].setdefault(stage.name, []).extend(notes)
    facts["left_out"] = [
        {"stage": stage, "name": entry.name, "reason": entry.reason}
        for stage, entries in left_out(stages, done).items()
        for entry in entries
    ]
    return finite(facts)


def left_out_by_last_run(facts: object, stage: str) -> tuple[LeftOut, ...]:
    """Return what a run's summary says a stage could not use: also photos whose worker died, which leave no record.

    - `facts`: of `summary.json`; anything else says nothing.
    """
    entries = facts.get("left_out", ()) if isinstance(facts, dict) else ()
    return tuple(LeftOut(name=entry["name"], reason=entry["reason"]) for entry in entries if entry["stage"] == stage)


def finite(value: Any) -> Any:
    """Return plain values in which None stands for numbers that are not finite, which JSON lacks."""
    if isinstance(value, dict):
        return {key: finite(entry) for key, entry in value.items()}
    if isinstance(value, list | tuple):
        return [finite(entry) for entry in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
