"""What `jaxba run` shows while it goes on: the pace and the time left, a line on a terminal, lines in a log, JSON."""

import json
import logging
import os
import shutil
from itertools import pairwise

import pytest

from jaxba.cli import _run_progress as progress
from jaxba.cli._run_progress import JsonLines, LiveLine, LogLines, Pace, duration, steps_told
from jaxba.pipeline import Event
from jaxba.scene import LeftOut


class Clock:
    """A clock that is set by hand."""

    def __init__(self) -> None:
        self.now = 100.0

    def __call__(self) -> float:
        return self.now


def photo(done: int, total: int, *, share: float | None = None, failed: str | None = None) -> Event:
    left = () if failed is None else (LeftOut(name=failed, reason="cut short"),)
    return Event("photo", "features", done, total, left_out=left, share=done / total if share is None else share)


def test_the_time_left_is_what_is_left_at_the_pace_so_far():
    pace = Pace()
    for done in range(1, 6):
        assert done >= 5 or pace.left_s is None  # four photos are needed
        pace.see(10 + 2.0 * done, done, done / 20)
    assert pace.seconds_a_photo == pytest.approx(2) and pace.left_s == pytest.approx(15 * 2)


def test_nothing_is_said_of_the_time_before_three_seconds():
    pace = Pace()
    for done in range(1, 30):
        pace.see(0.1 * done, done, done / 100)
    assert pace.left_s is None and pace.seconds_a_photo is None
    pace.see(3.2, 32, 0.32)
    assert pace.left_s == pytest.approx(0.68 * 3.1 / 0.31)


def test_photos_count_by_their_work_in_the_time_left():
    """Ten small photos are done, ten of fourfold size are left: they take four times as long."""
    pace = Pace()
    for done in range(1, 11):
        pace.see(float(done), done, done / 50)
    assert pace.left_s == pytest.approx(40)


def test_the_pace_is_that_of_late():
    pace, now = Pace(), 0.0
    for done in range(1, 101):
        now += 10.0 if done <= 5 else 1.0
        pace.see(now, done, done / 200)
    assert pace.left_s == pytest.approx(100)


def test_a_terminal_shows_one_line_with_photos_failures_pace_and_time_left(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
):
    clock = Clock()
    show = LiveLine(clock)
    show(Event("begin", "features"))
    show(Event("todo", "features", 0, 100, by_photos=True))
    for done in range(1, 11):
        clock.now += 3.0
        show(photo(done, 100, failed="a.jpg" if done == 2 else None))
    monkeypatch.setattr(shutil, "get_terminal_size", lambda: os.terminal_size((40, 24)))
    show(photo(11, 100))
    show(Event("end", "features", 100, 100))
    texts = capsys.readouterr().err.split("\r\x1b[K")
    assert texts[:3] == ["", "features  ...", "features  ..."] and texts[3] == "features  1 of 100 photos"
    assert texts[5] == "features  3 of 100 photos, 1 failed"
    assert texts[12] == "features  10 of 100 photos, 1 failed, 3.0 s a photo, 4 min left"
    assert len(texts[13]) == 39 and texts[14] == ""


def test_a_log_has_plain_lines_and_not_too_many(capsys: pytest.CaptureFixture[str]):
    clock = Clock()
    show = LogLines(clock)
    show(Event("begin", "features"))
    show(Event("todo", "features", 0, 1000, by_photos=True))
    begins, said = capsys.readouterr().err, dict[float, str]()
    for done in range(1, 1001):  # 500 s, and a tenth of the photos each 50 s
        clock.now += 0.5
        show(photo(done, 1000))
        if lines := capsys.readouterr().err:
            said[clock.now] = lines
    assert begins == "features  begins, 1000 photos\n" and len(said) == 9
    assert all(49 < b - a < 52 for a, b in pairwise([100.0, *said]))
    assert said[150.0] == "features  100 of 1000 photos, 2.0 photos a second, 7 min left\n"
    assert all(line.startswith("features  ") and line.count("\n") == 1 for line in said.values())
    show(photo(500, 1000))
    show(Event("begin", "adjust"))
    show(Event("todo", "adjust", 0, 1))
    show.step("round 1, median 0.50 px")  # too soon
    clock.now += 11
    show.step("round 2, median 0.31 px")
    lines = capsys.readouterr().err
    assert lines.splitlines() == ["adjust    begins", "adjust    round 2, median 0.31 px"]
    assert all(character == "\n" or character.isprintable() for character in lines)


def test_a_stage_with_nothing_to_do_has_no_line_in_a_log(capsys: pytest.CaptureFixture[str]):
    show = LogLines()
    show(Event("begin", "features"))
    show(Event("end", "features"))
    assert capsys.readouterr().err == ""


def test_json_events_have_the_fields_that_are_documented(capsys: pytest.CaptureFixture[str]):
    clock = Clock()
    show = JsonLines(clock)
    show.say("run_begin", version="1", photos="photos", out="project")
    show(Event("begin", "features"))
    show(Event("todo", "features", 0, 8, by_photos=True))
    for done in range(1, 6):
        clock.now += 2
        show(photo(done, 8, failed="a.jpg" if done == 2 else None))
    show.step("at work")
    events = [json.loads(line) for line in capsys.readouterr().err.splitlines()]
    assert [event["event"] for event in events] == [
        "run_begin", "stage_begin", "progress", "progress", "item_failed", *["progress"] * 4, "step",
    ]  # fmt: skip
    assert events[2] | {"time": ""} == {
        "time": "", "event": "progress", "stage": "features", "done": 0, "total": 8, "share": 0.0, "eta_s": None,
    }  # fmt: skip
    assert {"stage": "features", "name": "a.jpg", "reason": "cut short"}.items() <= events[4].items()
    assert events[-2]["eta_s"] == pytest.approx(6.0) and events[-2]["share"] == 0.625
    assert events[-1] | {"time": ""} == {"time": "", "event": "step", "stage": "features", "text": "at work"}
    documented = progress.__doc__ or ""
    left = LeftOut(name="a.jpg", reason="cut short")
    show(Event("end", "features", 8, 8, seconds=10.0, left_out=(left,), lines=("8 photos",)))
    events.append(json.loads(capsys.readouterr().err))
    assert events[-1] | {"time": ""} == {
        "time": "", "event": "stage_end", "stage": "features", "total": 8, "seconds": 10.0, "lines": ["8 photos"],
        "left_out": [{"name": "a.jpg", "reason": "cut short"}],
    }  # fmt: skip
    for event in events:
        row = documented[documented.index(f"| `{event['event']}` |") :].partition("\n| `")[0]  # to the next event's
        assert all(f"`{field}`" in row for field in event.keys() - {"time", "event"}), event["event"]


def test_steps_are_told_while_the_block_runs_and_no_longer():
    told: list[str] = []
    logger = logging.getLogger("jaxba.sfm._adjust")
    with steps_told(told.append):
        logger.info("round %d, median %.2f px", 1, 0.5)
    logger.info("round 2")
    assert told == ["round 1, median 0.50 px"] and not logging.getLogger("jaxba.sfm").handlers


@pytest.mark.parametrize(
    ("seconds", "text"),
    [
        (3, "under 10 s"),
        (42, "40 s"),
        (57, "55 s"),
        (59, "1 min"),
        (200, "3 min"),
        (3590, "1 h"),
        (7700, "2 h 10 min"),
    ],
)
def test_times_are_said_as_people_say_them(seconds: int, text: str):
    assert duration(float(seconds)) == text
