"""Descend: the host's loop over a solver's compiled steps."""

import time
from collections.abc import Callable
from typing import NamedTuple

import jax

from jaxba.ba._compiled import Compiled
from jaxba.ba._rows import Unknowns
from jaxba.ba._solution import HistoryStep
from jaxba.ba._solvers import RUNNING, State
from jaxba.ba._system import System


class Reached(NamedTuple):
    """Where the loop stopped and how it got there."""

    unknowns: Unknowns
    state: State
    history: list[HistoryStep]
    interrupted: bool


def descend(
    run: Compiled,
    unknowns: Unknowns,
    system: System,
    max_nfev: int,
    callback: Callable[[HistoryStep], None] | None = None,
) -> Reached:
    """Step until the solver has converged or `max_nfev` steps were tried; Ctrl-C ends it with what was reached."""
    started = time.perf_counter()
    state: State = run.init(unknowns, system)
    history = [HistoryStep(step=0, seconds=0.0, cost=float(state.cost), accepted=True, trust=float(state.trust))]
    interrupted = False
    try:
        while int(state.status) == RUNNING and len(history) <= max_nfev:
            reached = run.step(unknowns, state, system)
            entry = _history_step(len(history), started, jax.device_get(reached[1]))
            (unknowns, state), _ = reached, history.append(entry)
            if callback is not None:
                callback(history[-1])
    except KeyboardInterrupt:
        interrupted = True
    return Reached(unknowns, state, history, interrupted)


def _history_step(step: int, started: float, state: State) -> HistoryStep:
    return HistoryStep(
        step=step,
        seconds=time.perf_counter() - started,
        cost=float(state.cost),
        accepted=bool(state.accepted),
        change=float(state.change),
        gradient=float(state.gradient_norm),
        step_norm=float(state.step_norm),
        trust=float(state.trust),
        linear_iterations=int(state.linear_iterations),
        points_held=int(state.points_held),
    )
