"""Every test runs in float64, with the shapes and types of annotated functions and classes checked at run time.

What was compiled once, by these tests, the commands that they start, or `python -m jaxba`, is not compiled again: they
share one cache on the disk.
"""

import gc
import importlib
import os
import pkgutil
import sys
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import hypothesis
import jax
import jaxtyping
import pytest
from threadpoolctl import threadpool_limits

import jaxba
from jaxba.engine._compile_cache import use_compilation_cache

if TYPE_CHECKING:
    from commands import Cli
    from small_survey import Survey

# what tests share is imported by name, by them and by the workers that they start
sys.path += [str(folder) for folder in (Path(__file__).parent, *sorted(Path(__file__).parent.glob("[a-z]*/")))]
jax.config.update("jax_enable_x64", True)
use_compilation_cache()
# the session's processes keep the cores busy among them: further threads of BLAS only wait for each other, which took
# half of the time of dense references. numpy and scipy have a BLAS each, which hears of it once it is loaded
for library in ("numpy.linalg", "scipy.linalg"):
    importlib.import_module(library)
threadpool_limits(1, user_api="blas")
# tracing makes objects by the million and next to no cycles: a collection every 700 of them took an eighth of the time
gc.set_threshold(100_000, 20, 50)
# the same examples each time, however long one takes on a machine that is busy
hypothesis.settings.register_profile("tests", derandomize=True, database=None, deadline=None)
hypothesis.settings.load_profile("tests")
# works only on modules that are not imported yet. The engine holds no arrays: files and settings, in calls by the ten
# thousand, whose types pyright knows
jaxtyping.install_import_hook(
    [f"jaxba.{module.name}" for module in pkgutil.iter_modules(jaxba.__path__) if module.name != "engine"],
    "type_checks.checked",
)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Deal the files to the processes: those with the most slow tests first, as many tests to each.

    Each process begins with its share of the order, and takes over from the end of the other's when it is done.
    """
    files: dict[Path, list[pytest.Item]] = defaultdict(list)
    for item in items:
        files[item.path].append(item)
    slow = {path: sum(item.get_closest_marker("slow") is not None for item in found) for path, found in files.items()}
    shares: list[list[pytest.Item]] = [[] for _ in range(int(os.environ.get("PYTEST_XDIST_WORKER_COUNT", "1")))]
    for number, path in enumerate(sorted(files, key=lambda path: (-slow[path], path))):
        share = shares[number % len(shares)] if slow[path] else min(shares, key=len)
        share += files[path]
    items[:] = [item for share in shares for item in share]


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


@pytest.fixture
def cli(capsys: pytest.CaptureFixture[str]) -> "Cli":
    """Run a command; return its exit code, standard output and standard error."""
    from commands import caller

    return caller(capsys)


@pytest.fixture
def undrawn(monkeypatch: pytest.MonkeyPatch) -> None:
    """Leave out the cloud's picture, which takes most of an export's time."""
    from jaxba.pipeline import export

    monkeypatch.setattr(export, "_picture", lambda *given: b"none")


@pytest.fixture(scope="module", autouse=True)
def _few_programs() -> Iterator[None]:
    """Unload programs in time, and let the collector pass over the millions of objects that jax keeps of a module."""
    yield
    _unload_programs()
    gc.freeze()


def _unload_programs() -> None:
    """Forget what jax has compiled, once it is much.

    A compiled program holds several memory mappings, of which Linux grants a process 65,530; beyond them the compiler
    waits for ever. The tests of one file take 19,000 at most.
    """
    maps = Path("/proc/self/maps")
    if maps.exists() and maps.read_bytes().count(b"\n") > 40_000:
        gc.unfreeze()
        jax.clear_caches()
        gc.collect()
