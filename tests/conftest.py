"""Every test runs in float64, with the shapes and types of each annotated function and class checked at run time.

What one process of a session has compiled, the others and the commands that tests start do not compile again.
"""

import gc
import os
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import hypothesis
import jax
import jaxtyping
import pytest

if TYPE_CHECKING:
    from small_survey import Survey

# what tests share is imported by name, by them and by the workers that they start
sys.path += [str(folder) for folder in (Path(__file__).parent, *sorted(Path(__file__).parent.glob("[a-z]*/")))]
jax.config.update("jax_enable_x64", True)
_cache: tempfile.TemporaryDirectory[str] | None = None  # lasts as long as the session's first process
if "JAX_COMPILATION_CACHE_DIR" not in os.environ:
    _cache = tempfile.TemporaryDirectory(prefix="jaxba-compiled-")
    for name, value in (
        ("jax_compilation_cache_dir", _cache.name),
        ("jax_persistent_cache_min_compile_time_secs", 0.0),
        ("jax_persistent_cache_min_entry_size_bytes", -1),
    ):
        jax.config.update(name, value)
        os.environ[name.upper()] = str(value)
# the same examples each time, however long one takes on a machine that is busy
hypothesis.settings.register_profile("tests", derandomize=True, database=None, deadline=None)
hypothesis.settings.load_profile("tests")
jaxtyping.install_import_hook("jaxba", "beartype.beartype")  # works only on modules that are not imported yet


@pytest.fixture(scope="session")
def data_dir() -> Path:
    """Folder of real data: `JAXBA_DATA`, or `shared/data` beside the project."""
    path = Path(os.environ.get("JAXBA_DATA") or Path(__file__).parents[2] / "shared" / "data")
    if not path.is_dir():
        pytest.skip(f"needs real data, and {path} is no folder; set JAXBA_DATA to it")
    return path


@pytest.fixture(scope="session")
def photos(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Photos of a small simulated survey; not to be changed."""
    from small_survey import make_photos, once, shared_folder

    return once(shared_folder(tmp_path_factory), "survey", make_photos) / "photos"


@pytest.fixture(scope="session")
def made(tmp_path_factory: pytest.TempPathFactory, photos: Path) -> "Survey":
    """One whole run on them; not to be changed."""
    from small_survey import Survey, make_project, once, shared_folder

    return Survey(photos, once(shared_folder(tmp_path_factory), "run", make_project(photos)) / "project")


# run real sizes, which optimised code pays for
_LARGE = {"test_solve", "test_recovery", "test_cli", "test_cli_run", "test_cli_run_progress", "test_initialise"}


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_setup(item: pytest.Item) -> None:
    """Leave out XLA's costly optimisations where dozens of tiny programs are compiled: half the time.

    The pipeline's tests share a run that one process has made, and hold results to its last bit: code that is compiled
    otherwise rounds otherwise. So a change of this option also forgets the programs of before.
    """
    quick = item.path.stem not in _LARGE and item.path.parent.name != "pipeline"
    if quick != jax.config.read("jax_disable_most_optimizations"):
        jax.config.update("jax_disable_most_optimizations", quick)
        jax.clear_caches()


@pytest.fixture(scope="module", autouse=True)
def _few_programs() -> Iterator[None]:
    """Unload programs in time, and let the collector pass over the millions of objects that jax keeps of a module."""
    yield
    _unload_programs()
    gc.freeze()


def _unload_programs() -> None:
    """Forget what jax has compiled, once it is much.

    A compiled program holds several memory mappings, of which Linux grants a process 65,530; beyond them the compiler
    waits for ever.
    """
    maps = Path("/proc/self/maps")
    if maps.exists() and maps.read_bytes().count(b"\n") > 20_000:
        gc.unfreeze()
        jax.clear_caches()
        gc.collect()
