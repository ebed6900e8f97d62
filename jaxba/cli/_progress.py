"""What is shown while a solve runs: one line that is overwritten on a terminal, or a table with a line a step."""

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from jaxba.ba import HistoryStep

_CLEAR = "\r\x1b[K"
_TITLES = ("step", "cost", "change", "gradient", "length", "trust", "linear", "seconds")


@contextmanager
def line() -> Iterator[Callable[[HistoryStep], None]]:
    """Yield a callback that shows the present step on standard error, a terminal; the line is gone afterwards."""

    with overwritten() as show:
        show("preparing and compiling ...")
        yield lambda s: show(f"step {s.step}   cost {s.cost:.6g}   change {s.change:.2e}   {s.seconds:.1f} s")


@contextmanager
def overwritten() -> Iterator[Callable[[str], None]]:
    """Yield what shows a text on standard error, a terminal, in place of the one before; it is gone afterwards."""

    def show(text: str) -> None:
        print(f"{_CLEAR}{text}", end="", file=sys.stderr, flush=True)

    try:
        yield show
    finally:
        show("")


def print_step(step: HistoryStep, *, to_stderr: bool) -> None:
    """Print a line of the table of steps, with its titles before the first one.

    `trust` is the damping (lm) or the radius (dogleg), `linear` the iterations of the linear solver; a step that was
    refused has a dash for its change.
    """
    stream = sys.stderr if to_stderr else sys.stdout
    if step.step == 1:
        titles = "".join(f"{title:>{12 if title == 'cost' else 10}}" for title in _TITLES[1:])
        print(f"{_TITLES[0]:>5}{titles}", file=stream)
    change = f"{step.change:.2e}" if step.accepted else "-"
    print(
        f"{step.step:>5}{step.cost:>12.6g}{change:>10}{step.gradient:>10.2e}{step.step_norm:>10.2e}{step.trust:>10.1e}"
        f"{step.linear_iterations:>10}{step.seconds:>10.2f}",
        file=stream,
        flush=True,
    )
