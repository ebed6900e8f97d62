"""Tiles in other processes: the same bytes as in this one, whoever works on them and whoever is lost."""

import dataclasses
import functools
import os
import signal
from collections.abc import Callable, Sequence
from concurrent.futures import BrokenExecutor, Executor, Future, ProcessPoolExecutor, ThreadPoolExecutor
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest
from test_tiles import everything, with_own_cameras

import jaxba
from jaxba import JaxbaError, Problem, Solution
from jaxba.ba.tiles import _elsewhere
from jaxba.geometry import AbstractLoss, Huber, Linear

_OPTIONS = {"num_tiles": 4, "max_nfev": 3}
_HUBER = Huber(1.0)


@functools.cache
def _here(problem: Callable[[], Problem], loss: AbstractLoss) -> Solution:
    """Return what this process finds on its own."""
    return jaxba.solve_tiled(problem(), loss=loss, **_OPTIONS)


class _Lost(ThreadPoolExecutor):
    """An executor whose process is lost after some calls: what it was given then comes to nothing."""

    def __init__(self, after: int) -> None:
        super().__init__(1)
        self.left = after

    def submit(self, fn: Any, /, *arguments: Any, **named: Any) -> Future[Any]:
        if self.left < -1:
            raise BrokenExecutor
        self.left -= 1
        if self.left >= 0:
            return super().submit(fn, *arguments, **named)
        future: Future[Any] = Future()
        future.set_exception(BrokenExecutor())
        return future


def _same(first: Solution, second: Solution) -> None:
    for value, same in zip(
        *(jax.tree.leaves(dataclasses.replace(of, report=None)) for of in (first, second)), strict=True
    ):
        np.testing.assert_array_equal(value, same)


@pytest.mark.parametrize(
    ("problem", "loss", "after"),
    [(everything, _HUBER, None), (everything, _HUBER, 7), (with_own_cameras, Linear(), 2)],
    ids=["all there", "one lost", "one lost, own cameras"],
)
def test_executors_give_the_bytes_of_this_process(
    problem: Any, loss: AbstractLoss, after: int | None, tmp_path: Path
) -> None:
    # breaks where a tile depends on what this process holds, or a process that has not been up goes down
    once = _here(problem, loss)
    with ThreadPoolExecutor(2) as whole, ThreadPoolExecutor(1) if after is None else _Lost(after) as other:
        executors: Sequence[Executor] = [other, whole]
        again = jaxba.solve_tiled(problem(), loss=loss, **_OPTIONS, executors=executors, folder=tmp_path)
    _same(once, again)
    assert not any(tmp_path.iterdir())


def test_what_a_process_does_not_keep_lies_in_files_or_is_made_again(tmp_path: Path) -> None:
    # breaks where a system, a factor or equations are gone on the way down
    once = _here(everything, _HUBER)
    opened: list[list[str]] = []

    def look(*_: object) -> None:
        opened.append([path.suffix for path in tmp_path.rglob("factor-*")])

    with ThreadPoolExecutor(1) as only:
        tiny = {"executors": [only], "executor_memory": "100MB", "folder": tmp_path, "on_tile": look}
        with pytest.MonkeyPatch.context() as patched:
            patched.setattr(_elsewhere, "Shelf", lambda limit, *folder: _SHELF(limit / 1e6, *folder))
            again = jaxba.solve_tiled(everything(), loss=Huber(1.0), **_OPTIONS, **tiny)
    assert opened[-1]
    _same(once, again)


_SHELF = _elsewhere.Shelf


def test_a_process_that_is_killed_in_a_tile_costs_no_more_than_its_work(tmp_path: Path) -> None:
    once = _here(everything, _HUBER)
    spawn = get_context("spawn")
    with ProcessPoolExecutor(1, spawn) as first, ProcessPoolExecutor(1, spawn) as second:
        victims = [first.submit(os.getpid).result()]

        def kill(done: int, total: int) -> None:
            if done == 3 and victims:
                os.kill(victims.pop(), signal.SIGKILL)

        options = {"executors": [first, second], "folder": tmp_path, "on_tile": kill}
        again = jaxba.solve_tiled(everything(), loss=Huber(1.0), **_OPTIONS, **options)
        assert not victims
    _same(once, again)


def test_what_cannot_be_done_elsewhere_is_named(tmp_path: Path) -> None:
    problem: Problem = everything()
    with pytest.raises(JaxbaError, match="solve_tiled: executors: give one or more"):
        jaxba.solve_tiled(problem, executors=[])
    with pytest.raises(JaxbaError, match="solve_tiled: executor_memory 'much': give an amount"), _Lost(0) as lost:
        jaxba.solve_tiled(problem, executors=[lost], executor_memory="much")

    class Mine(Linear):
        """A loss that no other process can find."""

    with ThreadPoolExecutor(1) as one, pytest.raises(JaxbaError, match=r"cannot be sent .*Mine.*in a module"):
        jaxba.solve_tiled(problem, loss=Mine(), executors=[one], folder=tmp_path)
    with pytest.raises(JaxbaError, match="executors: the processes of all of them were lost; give"), _Lost(0) as lost:
        jaxba.solve_tiled(problem, executors=[lost], folder=tmp_path)
