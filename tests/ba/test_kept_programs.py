"""Programs on the disk: a later process traces nothing, and no program is taken for another one."""

import errno
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import equinox as eqx
import jax
import numpy as np
import pytest
from jax.experimental.compilation_cache import compilation_cache

import jaxba
from jaxba.ba import _compiler, _descend, _kept_programs
from jaxba.ba._compiler import call_compiled

_SOLVE = """
import sys, jax, jaxba
traced = []
jax.monitoring.register_event_duration_secs_listener(lambda name, _, **what: traced.append(what.get("fun_name")))
jax.config.update("jax_enable_x64", True)
jax.config.update("jax_compilation_cache_dir", sys.argv[1])
problem = jaxba.synthetic.uav_block(4, points_per_image=12.0, seed=3).problem
solution = jaxba.solve(problem, max_nfev=3)
print("step" in traced, "init" in traced, "plain_cost" in traced, jax.numpy.asarray(solution.points).tobytes().hex())
"""


class Doubled(eqx.Module):
    """A value of a class that is not jaxba's."""

    value: jax.Array | np.ndarray


def _doubled(value: jax.Array) -> jax.Array:
    return 2 * value


def _of_module(module: Doubled) -> jax.Array:
    return 2 * module.value


def _settings_without_promotion() -> tuple[tuple[str, str], ...]:
    with jax.numpy_rank_promotion("raise"):
        return _SETTINGS()


_SETTINGS = _kept_programs._settings


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """Where one test's programs are kept, jax's cache being empty; this module counts as one of jaxba's."""
    monkeypatch.delenv("JAXBA_KEEP_PROGRAMS", raising=False)
    monkeypatch.setattr(_kept_programs, "_READ", (*_kept_programs._READ, __name__))
    before = jax.config.jax_compilation_cache_dir  # pyright: ignore[reportAttributeAccessIssue]
    for cache in (str(tmp_path), before):
        jax.config.update("jax_compilation_cache_dir", cache)
        compilation_cache.reset_cache()
        _forget()
        if cache != before:
            yield tmp_path / "jaxba"


def _forget() -> None:
    """Be like a process that has compiled nothing."""
    _descend._compile.cache_clear()
    _compiler._ahead.cache_clear()
    _compiler._program.cache_clear()
    jax.clear_caches()


def _kept(folder: Path) -> int:
    return sum(path.suffix == "" for path in folder.glob("*"))


def test_another_process_traces_no_step_and_computes_the_same_bytes(folder: Path) -> None:
    problem = jaxba.synthetic.uav_block(4, points_per_image=12.0, seed=3).problem
    here = np.asarray(jaxba.solve(problem, max_nfev=3).points)
    assert _kept(folder) == 3
    there = subprocess.run([sys.executable, "-c", _SOLVE, str(folder.parent)], capture_output=True, text=True)
    assert there.stdout.split() == ["False", "False", "False", here.tobytes().hex()], there.stderr


@pytest.mark.parametrize(
    "change",
    [
        lambda patch: patch.setattr(_kept_programs, "_source", lambda: b"edited"),
        lambda patch: patch.setattr(_kept_programs, "_versions", lambda: ("jax 99",)),
        lambda patch: patch.setenv("XLA_FLAGS", "--xla_cpu_enable_fast_math=false"),
        lambda patch: patch.setattr(_compiler, "compiler_options", lambda: {"xla_backend_optimization_level": 0}),
        lambda patch: patch.setattr(_kept_programs, "_settings", _settings_without_promotion),
    ],
    ids=["source", "versions", "flags", "options", "settings"],
)
def test_what_is_made_from_something_else_is_another_program(
    folder: Path, monkeypatch: pytest.MonkeyPatch, change: Callable[[pytest.MonkeyPatch], None]
) -> None:
    # breaks where an edited source, or another jax, is answered with the old program
    for _ in "12":
        _forget()
        assert call_compiled(_doubled, np.ones(3)).tolist() == [2.0] * 3
        assert _kept(folder) == 1
    change(monkeypatch)
    for path in folder.parent.glob("*-cache"):  # of jax, which may find the change without meaning
        path.unlink()
    _forget()
    call_compiled(_doubled, np.ones(3))
    assert _kept(folder) == 2


def test_code_from_elsewhere_is_kept_by_no_name(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    # breaks where a user's own loss or camera, edited since, is answered with the old program
    given = Doubled(np.ones(3))
    assert call_compiled(_of_module, given).tolist() == [2.0] * 3 and _kept(folder) == 1
    monkeypatch.setattr(_kept_programs, "_READ", ())
    _forget()
    assert call_compiled(_of_module, given).tolist() == [2.0] * 3 and _kept(folder) == 1


def test_what_jax_had_compiled_before_is_not_written_however_often_it_is_asked_for(folder: Path) -> None:
    # breaks where an executable that was read, which lacks a part of its code when it is written, is kept: the second
    # time jax has it in memory and tells of no hit
    call_compiled(_doubled, np.ones(3))
    shutil.rmtree(folder)
    _forget()  # like a process that finds jax's cache alone
    for _ in range(3):
        _compiler._ahead.cache_clear()
        _compiler._program.cache_clear()
        assert call_compiled(_doubled, np.ones(3)).tolist() == [2.0] * 3
        assert not list(folder.glob("*.code"))


@pytest.mark.parametrize("suffix", ["", ".code"])
def test_a_damaged_file_is_written_anew(folder: Path, suffix: str) -> None:
    call_compiled(_doubled, np.ones(3))
    (path,) = (path for path in folder.glob("*") if path.suffix == suffix)
    whole = path.read_bytes()
    for damaged in (b"", whole[: len(whole) // 2], b"\x80\x05garbage"):
        path.write_bytes(damaged)
        jax.config.update("jax_compilation_cache_dir", str(folder.parent))
        _forget()
        assert call_compiled(_doubled, np.ones(3)).tolist() == [2.0] * 3
    assert suffix == ".code" or path.read_bytes() == whole


def test_a_full_disk_costs_nothing_but_time(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(_kept_programs, "write_atomically", full)
    assert call_compiled(_doubled, np.ones(3)).tolist() == [2.0] * 3 and not _kept(folder)
