"""Checkpoints of solves in tiles: a second call goes on to the same bytes, and bad files are named."""

import dataclasses
from pathlib import Path

import jax
import numpy as np
import pytest
from test_tiles import everything

import jaxba
from jaxba import JaxbaError
from jaxba.geometry import Huber


def test_a_second_call_goes_on_from_the_checkpoint_to_the_same_bytes(tmp_path: Path) -> None:
    # breaks where anything that decides on a step is not kept
    problem, path = everything(), tmp_path / "standing"
    options = {"loss": Huber(1.0), "num_tiles": 4, "max_nfev": 6}
    once = jaxba.solve_tiled(problem, **options)

    def stop(step: jaxba.ba.HistoryStep) -> None:
        if step.step in (2, 3):
            raise KeyboardInterrupt

    for steps in (2, 3):
        broken = jaxba.solve_tiled(problem, **options, checkpoint=path, callback=stop)
        assert broken.result == "interrupted" and broken.num_steps == steps
        assert [file.name for file in tmp_path.iterdir()] == ["standing"]
    with pytest.raises(JaxbaError, match=r"standing: is the checkpoint of another problem or loss; remove it"):
        jaxba.solve_tiled(problem, loss=Huber(2.0), checkpoint=path)
    whole = jaxba.solve_tiled(problem, **options, checkpoint=path)
    values, others = (jax.tree.leaves(dataclasses.replace(solution, report=None)) for solution in (once, whole))
    for value, same in zip(values, others, strict=True):
        np.testing.assert_array_equal(value, same)
    costs = [[dataclasses.replace(step, seconds=0.0) for step in of.report.history] for of in (once, whole)]
    assert costs[0] == costs[1]
    assert not path.exists()


def test_a_folder_keeps_a_checkpoint_of_each_solve(tmp_path: Path) -> None:
    # breaks where solves share a file, the second call takes a step, or gets what other stops have led to
    problem, steps, done = everything(), [], []
    options = {"loss": Huber(1.0), "num_tiles": 4, "checkpoint": tmp_path, "callback": steps.append}
    first = jaxba.solve_tiled(problem, **options, max_nfev=2)
    again = jaxba.solve_tiled(problem, **options, max_nfev=2, on_tile=lambda *tile: done.append(tile))
    assert len(steps) == 2 and not done and len(list(tmp_path.iterdir())) == 1
    for value, same in zip(
        *(jax.tree.leaves(dataclasses.replace(solution, report=None)) for solution in (first, again)), strict=True
    ):
        np.testing.assert_array_equal(value, same)
    further = jaxba.solve_tiled(problem, **options, max_nfev=3, on_tile=lambda *tile: done.append(tile))
    assert further.num_steps == 3 and len(steps) == 5 and len(list(tmp_path.iterdir())) == 2
    assert done == [(number, 8) for number in range(1, 9)] * 3


def test_a_checkpoint_that_cannot_be_written_is_refused_or_told(tmp_path: Path) -> None:
    with pytest.raises(JaxbaError, match=r"nowhere/standing: not written, .*create the folder first"):
        jaxba.solve_tiled(everything(), checkpoint=tmp_path / "nowhere" / "standing")
    folder = tmp_path / "folder"
    folder.mkdir()

    def gone(step: jaxba.ba.HistoryStep) -> None:
        if step.step == 1:
            (folder / "standing").unlink()
            folder.rmdir()

    options = {"loss": Huber(1.0), "num_tiles": 4, "max_nfev": 2}
    with pytest.warns(RuntimeWarning, match=r"standing: not written, .*The solve goes on without a checkpoint"):
        assert jaxba.solve_tiled(everything(), **options, checkpoint=folder / "standing", callback=gone).num_steps == 2


@pytest.mark.parametrize("content", [b"", b"PK no archive", b"text"])
def test_a_checkpoint_that_cannot_be_read_is_named(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "standing"
    path.write_bytes(content)
    with pytest.raises(JaxbaError, match=r"standing: is no checkpoint that can be read .*remove it to begin anew"):
        jaxba.solve_tiled(everything(), checkpoint=path)
