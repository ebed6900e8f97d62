"""What is shown while `jaxba run` goes on: a line that is overwritten, plain lines in a log, or JSON events.

Lines of stages that have ended go to standard output, as part of the result; progress goes to standard error.

With `--log-json` each line of standard error is one object. All have `time` (ISO 8601, UTC) and `event`:

| `event` | other fields |
|---|---|
| `run_begin` | `version`, `photos`, `out`: the folders |
| `stage_begin` | `stage` |
| `progress` | `stage`; `done`, `total`: photos to be worked on, or 1 for all at once; `share`: of the work done; |
|  | `eta_s`: seconds that the stage still takes, null before enough is known |
| `step` | `stage`, `text`: what a stage that does all photos at once is at |
| `item_failed` | `stage`, `name`, `reason`: a photo that it could not work on |
| `stage_end` | `stage`; `total`: what had to be done, 0 for nothing; `seconds`, `lines`: as people read them; |
|  | `left_out`: list of `name` and `reason` |
| `run_end` | `seconds`, `stages_run`: those that had anything to do |
| `stopped` | `stage` (null before the first), `reason`: the exit code is 2 |
| `interrupted` | `stage`: by Ctrl-C, the exit code is 130 |
"""

import contextlib
import datetime
import logging
import re
import shutil
import sys
import time
from collections import deque
from collections.abc import Callable, Iterator

from jaxba.cli._text import many, to_json, wrapped
from jaxba.pipeline import Event

_CLEAR = "\r\x1b[K"
LABEL = 10
_LOG_EVERY_S, _LOG_SHARE, _LOG_ANYWAY_S = 10.0, 0.1, 60.0
_WINDOW_S, _WINDOW_SHARE = 30.0, 0.3
_LEAST_PHOTOS, _LEAST_S = 3, 3.0


class Pace:
    """How fast a stage goes by the photos of the last 30 seconds, or of the last third of its time where that is more.

    Nothing is said before the fourth photo and the third second after the first one, which holds the workers' start.
    """

    def __init__(self) -> None:
        self._seen: deque[tuple[float, int, float]] = deque()
        self._first_s: float | None = None

    def see(self, now_s: float, done: int, share: float) -> None:
        """Note how many photos are done, and what share of the work they are."""
        self._first_s = now_s if self._first_s is None else self._first_s
        self._seen.append((now_s, done, share))
        window_s = max(_WINDOW_S, _WINDOW_SHARE * (now_s - self._first_s))
        while len(self._seen) > _LEAST_PHOTOS + 1 and self._seen[1][0] <= now_s - window_s:
            self._seen.popleft()

    @property
    def seconds_a_photo(self) -> float | None:
        """Seconds from one photo to the next; None before enough is known."""
        seconds, photos, _ = self._since()
        return seconds / photos if photos else None

    @property
    def left_s(self) -> float | None:
        """Seconds that the rest takes at this pace; None before enough is known."""
        seconds, _, share = self._since()
        return (1 - self._seen[-1][2]) * seconds / share if share else None

    def _since(self) -> tuple[float, int, float]:
        """Return seconds, photos and share since the beginning of the window; zeros before enough is known."""
        if not self._seen:
            return 0.0, 0, 0.0
        (begun_s, before, share_before), (now_s, done, share) = self._seen[0], self._seen[-1]
        if done - before < _LEAST_PHOTOS or now_s - begun_s < _LEAST_S:
            return 0.0, 0, 0.0
        return now_s - begun_s, done - before, share - share_before


class _Counting:
    """What both kinds of lines say of a stage: how many photos, how many failed, how fast, how long still."""

    def __init__(self, clock: Callable[[], float]) -> None:
        self.clock, self.stage = clock, ""
        self.pace, self.failed = Pace(), 0

    def see(self, event: Event) -> None:
        if event.kind == "begin":
            self.stage, self.pace, self.failed = event.stage, Pace(), 0
        if event.kind == "photo":
            self.failed += len(event.left_out)
            self.pace.see(self.clock(), event.done, event.share)

    def text(self, event: Event) -> str:
        parts = [f"{event.done} of {many(event.total, 'photo')}"]
        if self.failed:
            parts.append(f"{self.failed} failed")
        if (seconds := self.pace.seconds_a_photo) is not None and event.done < event.total:
            parts.append(f"{seconds:.1f} s a photo" if seconds > 1 else f"{1 / seconds:.1f} photos a second")
        if (left := self.pace.left_s) is not None and event.done < event.total:
            parts.append(f"{duration(left)} left")
        return ", ".join(parts)


class LiveLine:
    """One line on a terminal, overwritten by each event."""

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self.counting = _Counting(clock)

    def __call__(self, event: Event) -> None:
        self.counting.see(event)
        if event.kind == "end":
            self.clear()
        else:
            self._show(self.counting.text(event) if event.kind == "photo" else "...")

    def step(self, text: str) -> None:
        self._show(text)

    def clear(self) -> None:
        """Wipe the line."""
        print(_CLEAR, end="", file=sys.stderr, flush=True)

    def _show(self, text: str) -> None:
        line = f"{self.counting.stage:<{LABEL}}{text}"[: shutil.get_terminal_size().columns - 1]
        print(f"{_CLEAR}{line}", end="", file=sys.stderr, flush=True)


class LogLines:
    """Plain lines: one as a stage begins to work, then one after 10 seconds and a tenth of its work, or a minute."""

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self.counting, self.clock = _Counting(clock), clock
        self.said_s, self.said_share = 0.0, 0.0

    def __call__(self, event: Event) -> None:
        self.counting.see(event)
        if event.kind == "todo":
            self._say("begins" + (f", {many(event.total, 'photo')}" if event.by_photos else ""), 0.0)
        if event.kind == "photo" and event.done < event.total:
            since_s = self.clock() - self.said_s
            enough = event.share - self.said_share >= _LOG_SHARE or since_s >= _LOG_ANYWAY_S
            if since_s >= _LOG_EVERY_S and enough:
                self._say(self.counting.text(event), event.share)

    def step(self, text: str) -> None:
        if self.clock() - self.said_s >= _LOG_EVERY_S:
            self._say(text, 0.0)

    def clear(self) -> None:
        """Nothing is overwritten."""

    def _say(self, text: str, share: float) -> None:
        print(f"{self.counting.stage:<{LABEL}}{text}", file=sys.stderr, flush=True)
        self.said_s, self.said_share = self.clock(), share


class JsonLines:
    """One JSON object a line; see the table above."""

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self.counting = _Counting(clock)

    def __call__(self, event: Event) -> None:
        self.counting.see(event)
        if event.kind == "begin":
            self.say("stage_begin", stage=event.stage)
        elif event.kind == "end":
            left = [{"name": entry.name, "reason": entry.reason} for entry in event.left_out]
            lines, seconds = list(event.lines), round(event.seconds, 3)
            self.say("stage_end", stage=event.stage, total=event.total, seconds=seconds, lines=lines, left_out=left)
        else:
            for entry in event.left_out:
                self.say("item_failed", stage=event.stage, name=entry.name, reason=entry.reason)
            left_s = self.counting.pace.left_s
            self.say(
                "progress",
                stage=event.stage,
                done=event.done,
                total=event.total,
                share=round(event.share, 4),
                eta_s=None if left_s is None else round(left_s, 1),
            )

    def step(self, text: str) -> None:
        self.say("step", stage=self.counting.stage, text=text)

    def clear(self) -> None:
        """Nothing is overwritten."""

    def say(self, event: str, **facts: object) -> None:
        """Print one event."""
        moment = datetime.datetime.now(datetime.UTC).isoformat(timespec="milliseconds").replace("+00:00", "Z")
        print(to_json({"time": moment, "event": event, **facts}), file=sys.stderr, flush=True)


Progress = LiveLine | LogLines | JsonLines
"""What shows a run: called with each event; `step` says what a stage that does all photos at once is at."""


class StageLines:
    """What each stage made, as it ends, on standard output; no sentence twice in a run."""

    def __init__(self) -> None:
        self.said: set[str] = set()

    def __call__(self, event: Event) -> None:
        if event.kind != "end" or not event.total:
            return
        first, *notes = event.lines
        print(wrapped(event.stage, f"{first}   {event.seconds:.1f} s", LABEL), flush=True)
        for note in notes:
            if news := self._news(note):
                print(wrapped("", news, LABEL), flush=True)

    def _news(self, note: str) -> str:
        """Return the sentences of a note that this run has not said yet."""
        sentences = re.split(r"(?<=\.) (?=[A-Z])", note)
        news = [sentence for sentence in sentences if sentence not in self.said]
        self.said.update(sentences)
        return " ".join(news)


@contextlib.contextmanager
def steps_told(step: Callable[[str], None]) -> Iterator[None]:
    """Call `step` with what start and adjustment log of their steps while the block runs."""

    class Told(logging.Handler):
        def emit(self, record: logging.LogRecord) -> None:
            step(record.getMessage())

    logger, told = logging.getLogger("jaxba.sfm"), Told(logging.INFO)
    before = logger.level
    logger.addHandler(told)
    logger.setLevel(logging.INFO)
    try:
        yield
    finally:
        logger.removeHandler(told)
        logger.setLevel(before)


def duration(seconds: float) -> str:
    """Return a time as people say it: `under 10 s`, `40 s`, `3 min`, `2 h 10 min`.

    >>> duration(42.0), duration(200.0), duration(7700.0)
    ('40 s', '3 min', '2 h 10 min')
    """
    if seconds < 10:
        return "under 10 s"
    if seconds < 57.5:
        return f"{5 * round(seconds / 5)} s"
    minutes = round(seconds / 60)
    if minutes < 60:
        return f"{minutes} min"
    hours, tens = divmod(round(seconds / 600), 6)
    return f"{hours} h {10 * tens} min" if tens else f"{hours} h"
