"""Diagnosis of a project: what looks poor, the likely cause with its figures, and the cure.

One function a symptom, each from what the stages recorded to a diagnosis or none. A run that stopped with an error, or
was killed, is diagnosed from the stages that ended. Causes come before what follows from them.
"""

from collections.abc import Callable
from pathlib import Path

from jaxba.engine._stage import Pipeline
from jaxba.report._recorded import Recorded, recorded
from jaxba.report.diagnosis import (
    _adjustment as adjustment,
    _control as control,
    _limits as limits,
    _matching as matching,
    _place as place,
)
from jaxba.report.diagnosis._diagnosis import Diagnosis

Rule = Callable[[Recorded], Diagnosis | None]

RULES: tuple[Rule, ...] = (
    limits.killed,
    limits.out_of_date,
    limits.over_memory,
    limits.crashed,
    limits.over_store,
    place.far_off,
    place.mixed_datum,
    place.contradicting_gnss,
    matching.few_matches,
    matching.several_groups,
    matching.degenerate,
    adjustment.large_median,
    adjustment.at_bound,
    adjustment.out_of_steps,
    control.poor_control,
)


def diagnose(folder: Path, pipeline: Pipeline) -> list[Diagnosis]:
    """Return what looks poor in a project; empty where nothing does. Nothing is run or changed.

    Raises `JaxbaError` where the folder is no project.
    """
    return diagnoses(recorded(folder, pipeline))


def diagnoses(case: Recorded) -> list[Diagnosis]:
    """Return what looks poor by what the stages recorded, beside the findings of the adjustment."""
    found = [diagnosis for rule in RULES if (diagnosis := rule(case)) is not None]
    said = limits.stopped(case)
    return [*found, said] if said is not None else found
