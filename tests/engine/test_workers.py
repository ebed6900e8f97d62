import psutil
import pytest

from jaxba import JaxbaError, _sizes
from jaxba._sizes import bytes_of, machine_memory
from jaxba.engine import Resources, _workers, changed
from jaxba.engine._workers import memory_for
from jaxba.pipeline import PIPELINE


def test_the_number_of_workers_follows_from_megapixels_and_memory():
    assert Resources(workers=8, max_memory=10.7e9).num_workers(memory_for(20.0)) == 2
    assert Resources(workers=8, max_memory=1e9).num_workers(memory_for(20.0)) == 1
    assert Resources(workers=3, max_memory=100e9).num_workers(memory_for(1.0)) == 3


def test_workers_that_are_asked_for_count_where_the_system_tells_no_cores(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.delattr(_workers.os, "sched_getaffinity", raising=False)
    assert Resources(workers=3, max_memory=100e9).num_workers(1e9) == 3


@pytest.mark.parametrize(
    ("text", "bytes_"),
    [
        ("0.8", 12.8e9), (0.5, 8e9), (1.0, 16e9), ("4GB", 4e9), ("4 gb", 4e9), ("4G", 4e9), ("800MB", 8e8),
        ("1.5TB", 1.5e12), ("2GiB", 2 * 2**30), (4e9, 4e9), ("4e9", 4e9), ("500000000", 5e8),
    ],
)  # fmt: skip
def test_amounts_are_shares_or_bytes_as_people_write_them(text, bytes_):
    assert bytes_of(text, 16e9) == bytes_


def test_the_settings_take_amounts_as_texts():
    settings = changed(PIPELINE.settings, ["workers.max_memory=800MB", "workers.workers=2", "workers.max_store=0.5"])
    assert settings["workers"] == Resources(max_memory="800MB", workers=2, max_store=0.5)
    assert Resources(max_memory="800MB").memory_bytes == 8e8
    assert Resources(max_memory="0.5").memory_bytes == machine_memory() / 2


@pytest.mark.parametrize(("text", "limited"), [("4000000000\n", True), ("max\n", False)])
def test_memory_is_that_of_the_container(tmp_path, monkeypatch: pytest.MonkeyPatch, text: str, limited: bool):
    (tmp_path / "memory.max").write_text(text)
    monkeypatch.setattr(_sizes, "_CONTAINER_LIMITS", (tmp_path / "memory.max", tmp_path / "gone"))
    assert machine_memory() == (4_000_000_000 if limited else psutil.virtual_memory().total)


def test_the_time_limit_grows_with_the_work_unless_it_is_given():
    assert Resources().seconds_for(20.0) == 260.0
    assert Resources(time_limit=30.0).seconds_for(20.0) == 30.0


def test_a_share_or_a_number_of_photos_may_fail():
    assert [Resources(max_failed=limit).num_may_fail(10) for limit in (0.0, 0.25, 0.5, 1.0, 3.0, 100.0)] == [
        0,
        2,
        5,
        1,
        3,
        100,
    ]


@pytest.mark.parametrize(
    ("field", "value", "message"),
    [
        ("workers", 0, "workers.workers=0 is out of range; allowed: 1 to 1024"),
        ("max_memory", 0.99, "workers.max_memory=0.99: give a share from 0.1 to 0.95, or an amount from 100MB"),
        ("max_memory", 0.0, "workers.max_memory=0.0: give"),
        ("max_memory", 50.0, "workers.max_memory=50.0: give"),
        ("max_memory", "4 apples", "workers.max_memory=4 apples: give"),
        ("max_memory", "50MB", "workers.max_memory=50MB: give"),
        ("max_store", 0.01, "workers.max_store=0.01: give a share from 0.1 to 1, or an amount from 1MB"),
        ("time_limit", 0.5, "workers.time_limit=0.5 is out of range; allowed: 1 to 86400"),
        ("max_failed", -1.0, "workers.max_failed=-1.0 is out of range"),
        ("max_failed", 2.5, "workers.max_failed=2.5: give a share below 1, or a whole number"),
    ],
)
def test_resources_out_of_range_are_refused(field, value, message):
    with pytest.raises(JaxbaError, match=message):
        Resources(**{field: value})
