"""The engine of a dask cluster: a scheduler and two workers of this machine, as an administrator starts them."""

import contextlib
import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from concurrent.futures import CancelledError
from pathlib import Path
from typing import Any

import distributed
import psutil
import pytest
from small_survey import FAST, Survey
from worker_calls import double, double_slowly, killed_once

import jaxba
from jaxba import JaxbaError
from jaxba.engine import Resources, _cluster, changed
from jaxba.engine._engines import crew, work
from jaxba.engine._items import Item
from jaxba.pipeline import PIPELINE, Event, Run, run_pipeline
from jaxba.sfm import _rounds

ROOT = Path(__file__).parents[2]


@contextlib.contextmanager
def started(module: str, *options: str) -> Iterator[psutil.Process]:
    """Run one of dask's commands; its workers find what tests call."""
    path = [str(ROOT), str(Path(__file__).parent), *filter(None, [os.environ.get("PYTHONPATH")])]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(path)}
    command = [sys.executable, "-m", module, *options]
    process = subprocess.Popen(command, env=environment, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    try:
        yield psutil.Process(process.pid)
    finally:
        process.terminate()
        try:
            process.wait(20)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()


@contextlib.contextmanager
def scheduler_in(folder: Path) -> Iterator[tuple[Path, psutil.Process]]:
    """Run a scheduler; yield the file that it has written, and its process."""
    file = folder / "scheduler.json"
    options = "--host=127.0.0.1", "--port=0", f"--scheduler-file={file}", "--no-dashboard"
    with started("distributed.cli.dask_scheduler", *options) as process:
        until = time.monotonic() + 60
        while not (file.exists() and file.read_text().strip().endswith("}")):
            assert process.is_running() and time.monotonic() < until
            time.sleep(0.1)
        yield file, process


def workers(file: Path, count: int) -> contextlib.AbstractContextManager[psutil.Process]:
    options = f"--nworkers={count}", "--nthreads=1", "--no-dashboard", f"--scheduler-file={file}"
    return started("distributed.cli.dask_worker", *options)


@pytest.fixture(scope="module")
def scheduler(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """The file of a scheduler with two workers of one thread each."""
    with scheduler_in(tmp_path_factory.mktemp("dask")) as (file, _), workers(file, 2):
        yield file


def kill(scheduler: Path, count: int) -> list[int]:
    """Kill as many workers as are asked for, once they are there; return their processes' numbers."""
    with _cluster._client(Resources(scheduler_file=str(scheduler))) as client:
        client.wait_for_workers(2, timeout=60)
        killed = sorted(client.run(os.getpid).values())[:count]
    for pid in killed:
        os.kill(pid, signal.SIGKILL)
    return killed


def items(*numbers: int) -> list[Item]:
    return [Item(name=str(number), arguments=(number,), need_bytes=1e8) for number in numbers]


def outcomes(call: Any, todo: list[Item], resources: Resources) -> dict[str, tuple[object, str | None]]:
    ended = [(item.name, (result, failed)) for item, result, failed in work(call, todo, resources)]
    assert len(ended) == len(todo)
    return dict(ended)


def test_every_item_has_its_result_and_what_goes_wrong_costs_itself_alone(scheduler: Path):
    resources = Resources(scheduler_file=str(scheduler), time_limit=3.0)
    found = outcomes(double, items(1, 14, 2, 15, 3, 21, 4), resources)
    assert [found[name] for name in "1234"] == [(2, None), (4, None), (6, None), (8, None)]
    reasons = {name: str(reason) for name, (_, reason) in found.items()}
    assert reasons["14"].startswith("its worker process tcp://") and "was lost twice" in reasons["14"]
    assert "was stopped by a fault of jaxba and not of the input (ValueError: odd" in reasons["15"]
    assert reasons["21"] == "took longer than 3 s; raise --time-limit, or look at the file"


def test_an_item_whose_worker_is_killed_is_tried_again(scheduler: Path, tmp_path: Path):
    todo = [Item(name=str(n), arguments=(tmp_path, n), need_bytes=1e8) for n in range(3)]
    found = outcomes(killed_once, todo, Resources(scheduler_file=str(scheduler)))
    assert found == {str(n): (2 * n, None) for n in range(3)}


def test_items_whose_workers_are_killed_while_others_are_recorded_have_their_results(scheduler: Path):
    ending = work(double_slowly, items(*range(8)), Resources(scheduler_file=str(scheduler)))
    found = [next(ending)]
    time.sleep(1.0)  # the workers have done what they were given, and keep it
    kill(scheduler, 2)
    found += ending
    assert {item.name: (result, failed) for item, result, failed in found} == {str(n): (2 * n, None) for n in range(8)}


def test_an_error_of_the_run_stops_it_and_names_the_worker(scheduler: Path):
    with pytest.raises(JaxbaError, match=r"disk full \(on the worker tcp://127"):
        list(work(double, items(1, 16), Resources(scheduler_file=str(scheduler))))


def test_an_item_that_no_worker_has_the_memory_for_is_named(scheduler: Path):
    large = Item(name="large", arguments=(1,), need_bytes=1e15)
    ((_, result, reason),) = list(work(double, [large], Resources(scheduler_file=str(scheduler))))
    assert result is None and reason is not None and reason.startswith("needs about 1000000.0 GB of memory")
    assert reason.endswith("raise the --memory-limit of dask worker")


def test_a_worker_of_other_versions_is_refused_by_name(scheduler: Path, monkeypatch: pytest.MonkeyPatch):
    here = _cluster.installed()
    monkeypatch.setattr(_cluster, "installed", lambda: {**here, "numpy": "1.0"})
    message = rf"worker tcp://.* on .*: it has numpy {re.escape(here['numpy'])}, and this process has 1\.0; .*\.lock\)"
    with pytest.raises(JaxbaError, match=message):
        list(work(double, items(1), Resources(scheduler_file=str(scheduler))))


def test_a_worker_that_does_not_see_the_project_is_refused(
    scheduler: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    seen = tmp_path / "of this project"
    seen.write_text("one")
    todo = [Item(name="1", arguments=(1,), need_bytes=1e8, reads=(seen,))]
    assert outcomes(double, todo, Resources(scheduler_file=str(scheduler))) == {"1": (2, None)}
    # another folder of the same name lies there
    monkeypatch.setattr(_cluster, "_seen", lambda paths: dict.fromkeys(paths, "other"))
    with pytest.raises(JaxbaError, match=r"does not see .*of this project as this machine does\. Photos and project"):
        list(work(double, todo, Resources(scheduler_file=str(scheduler))))


def test_a_scheduler_that_is_not_there_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(_cluster, "_ANSWER_S", 1.0)
    with pytest.raises(JaxbaError, match=r"workers\.scheduler=tcp://127\.0\.0\.1:9: no scheduler answers .* in 1 s"):
        list(work(double, items(1), Resources(scheduler="tcp://127.0.0.1:9")))
    absent = tmp_path / "absent.json"
    with pytest.raises(JaxbaError, match=r"absent\.json: no file of a dask scheduler \(.*No such file"):
        list(work(double, items(1), Resources(scheduler_file=str(absent))))
    with pytest.raises(JaxbaError, match=r"no certificates for tls://a:1\. Set DASK_DISTRIBUTED__COMM__TLS__CA_FILE"):
        list(work(double, items(1), Resources(scheduler="tls://a:1")))
    with pytest.raises(JaxbaError, match="give one of the two"):
        Resources(scheduler="tcp://a:1", scheduler_file="b")


def test_a_scheduler_that_goes_or_has_no_worker_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(_cluster, "_PATIENCE_S", 1.0)
    monkeypatch.setattr(_cluster, "_ANSWER_S", 3.0)
    with scheduler_in(tmp_path) as (file, process):
        resources = Resources(scheduler_file=str(file))
        with pytest.raises(JaxbaError, match=r"has no worker to give anything to\. What is done is kept; start"):
            list(work(double, items(1), resources))
        with workers(file, 1):
            monkeypatch.setattr(_cluster, "_PATIENCE_S", 30.0)
            ending = work(double_slowly, items(*range(20)), resources)
            next(ending)
            process.kill()
            monkeypatch.setattr(_cluster, "_PATIENCE_S", 1.0)
            with pytest.raises(JaxbaError, match=r"scheduler no longer answers\. What is done is kept; start it"):
                list(ending)


def test_a_client_that_trips_over_a_worker_that_comes_asks_again(scheduler: Path, monkeypatch: pytest.MonkeyPatch):
    client, trips = distributed.Client, [3]

    def tripping(*arguments: Any, **options: Any) -> distributed.Client:
        if trips[0]:
            trips[0] -= 1
            raise AssertionError
        return client(*arguments, **options)

    monkeypatch.setattr(distributed, "Client", tripping)
    assert outcomes(double, items(1), Resources(scheduler_file=str(scheduler))) == {"1": (2, None)}
    trips[0] = 99
    with pytest.raises(JaxbaError, match="no scheduler answers at tcp"):
        list(work(double, items(1), Resources(scheduler_file=str(scheduler))))


def test_a_crew_has_an_executor_a_thread(scheduler: Path):
    with crew(Resources(scheduler_file=str(scheduler)), ()) as found:
        assert found is not None and len(found.executors) == 2 and 1e8 < found.memory_bytes < 1e12
        assert [executor.submit(double, k).result() for k, executor in enumerate(found.executors)] == [0, 2]
        with pytest.raises(JaxbaError, match=r"disk full \(on a worker of "):
            found.executors[0].submit(double, 16).result()
    with crew(Resources(), ()) as none:
        assert none is None


@pytest.mark.parametrize("count", [1, 2])
def test_a_crew_whose_workers_are_lost_works_with_those_that_come(scheduler: Path, count: int):
    with crew(Resources(scheduler_file=str(scheduler)), ()) as found:
        assert found is not None
        given = [executor.submit(double_slowly, k) for k, executor in enumerate(4 * found.executors)]
        killed = kill(scheduler, count)
        assert [future.result(90) for future in given] == [2 * k for k in range(8)]
        # a thread each again, once the workers are there again
        with _cluster._client(Resources(scheduler_file=str(scheduler))) as client:
            client.wait_for_workers(2, timeout=60)
        pids = {executor.submit(os.getpid).result(90) for executor in found.executors}
        assert len(pids) == 2 and not pids & set(killed)


def test_a_worker_that_comes_to_a_crew_is_compared_first(scheduler: Path, monkeypatch: pytest.MonkeyPatch):
    here = _cluster.installed()
    with crew(Resources(scheduler_file=str(scheduler)), ()) as found:
        assert found is not None
        given = found.executors[0].submit(double_slowly, 1)
        monkeypatch.setattr(_cluster, "installed", lambda: {**here, "numpy": "1.0"})
        kill(scheduler, 2)
        with pytest.raises(JaxbaError, match=r"worker tcp://.* it has numpy .*, and this process has 1\.0; .*\.lock\)"):
            given.result(90)


def test_a_crew_says_what_to_do_where_a_call_ends_its_workers(scheduler: Path):
    with crew(Resources(scheduler_file=str(scheduler)), ()) as found:
        assert found is not None
        with pytest.raises(JaxbaError, match=r"end on the same piece of work \(3 in a row, .*Raise the --memory-limit"):
            found.executors[0].submit(double, 13).result()
        given = found.executors[0].submit(double_slowly, 1)
        assert given.cancel()
        with pytest.raises(CancelledError):
            given.result()


def test_tiles_whose_scheduler_goes_are_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(_cluster, "_ANSWER_S", 3.0)
    problem = jaxba.synthetic.uav_block(60, side_overlap=0.7, points_per_image=40.0).problem

    def go(done: int, total: int) -> None:
        process.kill()
        process.wait()

    with scheduler_in(tmp_path) as (file, process), workers(file, 1):
        resources = Resources(scheduler_file=str(file))
        with (
            pytest.raises(JaxbaError, match=r"scheduler no longer answers\. What is done is kept; start it again"),
            crew(resources, ()) as found,
        ):
            assert found is not None
            monkeypatch.setattr(_cluster, "_PATIENCE_S", 10.0)
            jaxba.solve_tiled(problem, num_tiles=4, executors=found.executors, folder=tmp_path, on_tile=go)


@pytest.mark.slow
def test_a_run_on_a_cluster_makes_the_same_bytes_though_workers_are_killed(
    scheduler: Path, made: Survey, photos: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    killed: set[int] = set()

    def kill_in_stage(event: Any) -> None:
        """Kill a worker in the middle of features, and one in the middle of matching."""
        if event.kind == "photo" and event.done == 2:
            killed.update(kill(scheduler, 1))

    def in_tiles(survey: Survey, *changes: str, tell: Callable[[Event], None] = lambda event: None) -> Run:
        """Run two rounds with tiles of three photos, which are fewer than may be asked for."""
        settings = changed(PIPELINE.settings, [*FAST, "workers.workers=1", "adjust.max_rounds=2", *changes])
        monkeypatch.setitem(vars(settings["tiles"]), "chunk_size", 3)
        return run_pipeline(survey.photos, survey.project, settings, tell=tell)

    alone = made.copy(tmp_path / "alone")
    assert in_tiles(alone).stages_run == ("adjust", "export")
    tile = _rounds._Told.tile

    def kill_in_tile(told: _rounds._Told, done: int, total: int) -> None:
        tile(told, done, total)
        if (told.round, told.num_steps, done, total) == (2, 1, 4, 6):
            killed.update(kill(scheduler, 1))

    monkeypatch.setattr(_rounds._Told, "tile", kill_in_tile)
    own = Survey(photos, tmp_path / "project")
    run = in_tiles(own, f"workers.scheduler_file={scheduler}", tell=kill_in_stage)
    assert len(killed) == 3 and not run.facts["left_out"]
    names = sorted(path.relative_to(alone.project) for path in (alone.project / "export").rglob("*") if path.is_file())
    assert names
    for name in names:
        assert (own.project / name).read_bytes() == (alone.project / name).read_bytes(), name
