import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import psutil
import pytest
from worker_calls import double, double_slowly, hold, killed_once, killed_with_the_lock, threads

from jaxba import JaxbaError
from jaxba.engine import Resources, _pool
from jaxba.engine._engines import fewer_workers, work
from jaxba.engine._items import Item, crashed, lacked_memory


def items(*numbers: int, need_bytes: float = 1e8) -> list[Item]:
    return [Item(name=str(number), arguments=(number,), need_bytes=need_bytes) for number in numbers]


def outcomes(call, todo: list[Item], resources: Resources) -> dict[str, tuple[object, str | None]]:
    ended = [(item.name, (result, failed)) for item, result, failed in work(call, todo, resources)]
    assert len(ended) == len(todo)
    return dict(ended)


def is_worker(process: psutil.Process) -> bool:
    try:
        return "spawn_main" in " ".join(process.cmdline())
    except psutil.NoSuchProcess:  # it has ended since it was listed
        return False


@pytest.mark.parametrize("workers", [1, 2])
def test_every_item_has_its_result(workers):
    found = outcomes(double, items(*range(6)), Resources(workers=workers))
    assert found == {str(i): (2 * i, None) for i in range(6)}


def test_what_goes_wrong_with_an_item_costs_that_item_alone_and_is_named():
    found = outcomes(double, items(1, 13, 2, 14, 15, 3, 18, 19, 20, 21, 4), Resources(workers=2, time_limit=2.0))
    assert [found[name] for name in "1234"] == [(2, None), (4, None), (6, None), (8, None)]
    reasons = {name: reason for name, (_, reason) in found.items()}
    assert reasons["13"] == (
        "its worker process was killed by SIGKILL twice, the second time with no other beside it: out of memory, or a "
        "broken file that crashes the decoder"
    )
    assert "ended with exit code 3 twice" in reasons["14"]
    for name, words in (("15", "ValueError: odd"), ("18", "Awkward: odd"), ("19", "SystemExit: 4")):
        assert f"was stopped by a fault of jaxba and not of the input ({words}" in reasons[name]
        assert "please report it" in reasons[name]
    assert "SIGSEGV" in reasons["20"]
    assert {name for name, reason in reasons.items() if reason and lacked_memory(reason)} == {"13"}
    assert {name for name, reason in reasons.items() if reason and crashed(reason)} == {"14", "20"}
    assert reasons["21"] == "took longer than 2 s; raise --time-limit, or look at the file"


def test_an_item_whose_worker_is_killed_from_outside_is_tried_again(tmp_path: Path):
    todo = [Item(name=str(n), arguments=(tmp_path, n), need_bytes=1e8) for n in range(3)]
    assert outcomes(killed_once, todo, Resources(workers=2)) == {str(n): (2 * n, None) for n in range(3)}


@pytest.mark.slow
def test_a_worker_that_is_killed_as_it_holds_the_lock_on_the_others_stops_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(_pool, "_STUCK_S", 5.0)
    todo = [Item(name=str(n), arguments=(tmp_path, n), need_bytes=1e8) for n in range(8)]
    begun = time.monotonic()
    found = outcomes(killed_with_the_lock, todo, Resources(workers=2, time_limit=5.0))
    assert found == {str(n): (2 * n, None) for n in range(8)} and (tmp_path / "killed").exists()
    assert time.monotonic() - begun < 45  # the workers themselves wait for the lock for 60 s


def test_no_item_is_lost_while_workers_are_killed_again_and_again():
    """The killer hits working and idle workers, and such as have just begun; a pool may break and is replaced."""
    todo = [Item(name=str(n), arguments=(n,), need_bytes=1e8) for n in range(30)]
    stop, kills, found = threading.Event(), [], {}

    def kill() -> None:
        seen = 0
        while not stop.wait(0.2):
            alive = [child for child in psutil.Process().children() if is_worker(child)]
            if alive and len(found) > seen and len(kills) < 4:  # an item has ended since
                seen = len(found)
                kills.append(alive[len(kills) % len(alive)].pid)
                os.kill(kills[-1], signal.SIGKILL)

    killer = threading.Thread(target=kill)
    killer.start()
    try:
        for item, result, reason in work(double_slowly, todo, Resources(workers=2)):
            assert item.name not in found
            found[item.name] = (result, reason)
    finally:
        stop.set()
        killer.join()
    lost = {name for name, (_, reason) in found.items() if reason}
    assert len(kills) >= 3 and len(found) == len(todo) and len(lost) <= 1  # an item may be hit twice
    assert all(found[name] == (2 * int(name), None) for name in found if name not in lost)


def test_workers_that_end_before_they_begin_stop_the_run(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(_pool, "_prepare_worker", os.abort)
    with pytest.raises(
        JaxbaError, match=r"end before they begin \(3 times in a row\)\. In a script, .*; else raise --max-memory"
    ):
        list(work(double, items(1, 2), Resources(workers=1)))


def test_an_item_over_the_memory_limit_is_named_and_not_begun():
    mixed = [*items(1), *items(13, need_bytes=2e9)]
    found = outcomes(double, mixed, Resources(max_memory="1GB"))
    assert found["1"] == (2, None)
    assert found["13"] == (None, "needs about 2.0 GB of memory, 1.0 GB are allowed; raise --max-memory")


def test_a_worker_that_takes_more_than_its_share_of_memory_loses_its_item_alone():
    found = outcomes(double, items(17, 1), Resources(workers=1, max_memory=5e8))
    assert found["1"][1] is None and "not enough memory" in str(found["17"][1])


@pytest.mark.skipif(sys.platform != "linux", reason="only Linux limits the memory of a process")
def test_an_item_that_took_more_than_its_share_is_tried_again_with_all_of_the_memory():
    """Two workers may take 2 GB each, and 1 GB of addresses beside it; one alone 4 GB."""
    sizes = [int(3.5e9), 1000]
    todo = [Item(name=str(size), arguments=(size,), need_bytes=1e8) for size in sizes]
    assert outcomes(hold, todo, Resources(workers=2, max_memory="4GB")) == {str(n): (n, None) for n in sizes}


def test_an_error_of_the_run_itself_stops_it():
    with pytest.raises(JaxbaError, match="disk full"):
        list(work(double, items(16), Resources(workers=1)))


def test_workers_use_one_thread_of_opencv_and_blas():
    (_, found, _), *_ = work(threads, items(0), Resources(workers=1))
    assert found["cv2"] == 1 and set(found["blas"]) == {1}


def test_workers_that_the_memory_does_not_allow_are_said():
    todo = items(1, 2, 3, need_bytes=2e9)
    assert fewer_workers(todo, Resources(workers=3, max_memory="5GB")) == (
        "2 of 3 workers: a photo needs up to 2.0 GB of memory, 5.0 GB are allowed for all; --max-memory raises it."
    )
    assert fewer_workers(todo, Resources(workers=3, max_memory="6GB")) is None
    assert fewer_workers(todo, Resources(workers=8, max_memory="6GB")) is None  # there are three items


RUN_THAT_HANGS = """
import sys
sys.path.append({folder!r})
from worker_calls import double
from jaxba.engine import Resources
from jaxba.engine._engines import work
from jaxba.engine._items import Item
if __name__ == "__main__":
    print("begun", flush=True)
    list(work(double, [Item(name=str(n), arguments=(21,), need_bytes=1e8) for n in range(2)], Resources(workers=2)))
"""


def test_workers_end_soon_after_a_run_that_is_killed(tmp_path: Path):
    (tmp_path / "hangs.py").write_text(RUN_THAT_HANGS.format(folder=str(Path(__file__).parent)))
    with subprocess.Popen([sys.executable, tmp_path / "hangs.py"], stdout=subprocess.PIPE) as run:
        try:
            until = time.monotonic() + 60
            workers: list[psutil.Process] = []
            while len(workers) < 2 and time.monotonic() < until:
                time.sleep(0.1)
                found = psutil.Process(run.pid).children()
                workers = [child for child in found if "spawn_main" in " ".join(child.cmdline())]
            time.sleep(1)  # they are at work, which takes ten minutes
        finally:
            run.kill()
    assert len(workers) == 2
    _, alive = psutil.wait_procs(workers, timeout=10)
    assert not alive
