import pytest
from worker_calls import double, threads

from jaxba import JaxbaError
from jaxba.pipeline import Resources
from jaxba.pipeline._workers import Item, memory_for, work


def items(*numbers: int, need_bytes: float = 1e8) -> list[Item]:
    return [Item(name=str(number), arguments=(number,), need_bytes=need_bytes) for number in numbers]


@pytest.mark.parametrize("workers", [1, 2])
def test_every_item_has_its_result_in_its_place(workers):
    found = list(work(double, items(*range(6)), Resources(workers=workers)))
    assert [(item.name, result, failed) for item, result, failed in found] == [(str(i), 2 * i, None) for i in range(6)]


def test_a_worker_that_dies_costs_its_item_alone():
    found = {
        item.name: (result, failed) for item, result, failed in work(double, items(1, 13, 2, 14, 15, 3), Resources())
    }
    assert [found[name][0] for name in "123"] == [2, 4, 6]
    assert "killed by SIGKILL" in found["13"][1] and "exit code 3" in found["14"][1] and "odd" in found["15"][1]


def test_an_item_over_the_memory_limit_is_named_and_not_begun():
    mixed = [*items(1), *items(13, need_bytes=2e9)]
    found = {item.name: failed for item, _, failed in work(double, mixed, Resources(max_memory=1e9))}
    assert found["1"] is None and "needs about 2.0 GB of memory, 1.0 GB are allowed; raise --max-memory" in found["13"]


def test_a_worker_that_takes_more_than_its_share_of_memory_loses_its_item_alone():
    found = {item.name: failed for item, _, failed in work(double, items(17, 1), Resources(workers=1, max_memory=5e8))}
    assert found["1"] is None and "not enough memory" in found["17"]


def test_an_error_of_the_run_itself_stops_it():
    with pytest.raises(JaxbaError, match="disk full"):
        list(work(double, items(16), Resources(workers=1)))


def test_workers_use_one_thread_of_opencv_and_blas():
    (_, found, _), *_ = work(threads, items(0), Resources(workers=1))
    assert found["cv2"] == 1 and set(found["blas"]) <= {1}


def test_the_number_of_workers_follows_from_megapixels_and_memory():
    assert Resources(workers=8, max_memory=10.7e9).num_workers(memory_for(20.0)) == 2
    assert Resources(workers=8, max_memory=1e9).num_workers(memory_for(20.0)) == 1
    assert Resources(workers=3, max_memory=100e9).num_workers(memory_for(1.0)) == 3


@pytest.mark.parametrize(
    ("field", "value"), [("workers", 0), ("max_memory", 0.99), ("max_memory", 0.0), ("max_memory", 50.0)]
)
def test_resources_out_of_range_are_refused(field, value):
    with pytest.raises(JaxbaError, match=f"{field} {value:g}: give"):
        Resources(**{field: value})
