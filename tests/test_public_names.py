"""Names that packages load when they are first used: those of their stubs, and nothing heavy before."""

import ast
import importlib
import subprocess
import sys
from pathlib import Path

import pytest

import jaxba

STUBS = sorted(Path(jaxba.__file__).parent.rglob("__init__.pyi"))
NAMES = {
    stub: [
        (node.module, alias.name)
        for node in ast.walk(ast.parse(stub.read_text()))
        if isinstance(node, ast.ImportFrom)
        for alias in node.names
    ]
    for stub in STUBS
}


def _package(stub: Path) -> str:
    return ".".join(["jaxba", *stub.parent.relative_to(STUBS[0].parent).parts])


@pytest.mark.parametrize("stub", STUBS, ids=_package)
def test_a_name_of_a_stub_is_that_of_its_module(stub: Path):
    package = importlib.import_module(_package(stub))
    for module, name in NAMES[stub]:
        found = getattr(package, name)
        if module is None:
            assert found is importlib.import_module(f"{package.__name__}.{name}")
        else:
            assert found is getattr(importlib.import_module(f"{package.__name__}.{module}"), name)


@pytest.mark.parametrize("stub", STUBS, ids=_package)
def test_names_stand_once_and_are_offered_for_completion(stub: Path):
    names = [name for _, name in NAMES[stub]]
    assert sorted(names) == sorted(set(names)) == sorted(dir(importlib.import_module(_package(stub))))


def test_unknown_name_is_an_attribute_error():
    with pytest.raises(AttributeError, match="No jaxba attribute Hubert"):
        _ = jaxba.Hubert  # pyright: ignore[reportAttributeAccessIssue]


def test_import_loads_nothing_heavy():
    heavy = {"jax", "jaxlib", "numpy", "scipy", "equinox", "cv2", "pyproj", "pandas"}
    code = f"import sys, jaxba; print(*sorted({heavy!r} & set(sys.modules)))"
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert run.stdout.split() == []
