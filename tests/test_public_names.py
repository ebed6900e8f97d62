import ast
import importlib
import subprocess
import sys
from pathlib import Path

import pytest

import jaxba

SOURCE = Path(jaxba.__file__).read_text()
NAMES = sorted(jaxba._MODULE_OF)


@pytest.mark.parametrize("name", NAMES)
def test_public_name_is_that_of_its_module(name: str):
    assert getattr(jaxba, name) is getattr(importlib.import_module(jaxba._MODULE_OF[name]), name)


@pytest.mark.parametrize("name", sorted(jaxba._MODULES))
def test_public_module_is_the_module(name: str):
    assert getattr(jaxba, name) is importlib.import_module(jaxba._MODULES[name])


def test_no_public_name_stands_twice():
    listed = [name for names in jaxba._NAMES.values() for name in names] + list(jaxba._MODULES)
    assert sorted(listed) == sorted(set(listed))


def test_names_for_type_checkers_are_the_names_at_run_time():
    block = next(node for node in ast.parse(SOURCE).body if isinstance(node, ast.If))
    imports = [node for node in block.body if isinstance(node, ast.ImportFrom)]
    typed = {(node.module, alias.name, alias.asname) for node in imports for alias in node.names}
    names = {(module, name, name) for name, module in jaxba._MODULE_OF.items()}
    modules = {(*target.rsplit(".", 1), public) for public, target in jaxba._MODULES.items()}
    assert typed == names | modules


def test_public_names_are_offered_for_completion():
    assert set(NAMES) | set(jaxba._MODULES) <= set(dir(jaxba))


def test_unknown_name_is_an_attribute_error():
    with pytest.raises(AttributeError, match="no attribute 'Hubert'"):
        _ = jaxba.Hubert  # pyright: ignore[reportAttributeAccessIssue]


def test_import_loads_nothing_heavy():
    heavy = {"jax", "jaxlib", "numpy", "scipy", "equinox", "cv2", "pyproj", "pandas"}
    code = f"import sys, jaxba; print(*sorted({heavy!r} & set(sys.modules)))"
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert run.stdout.split() == []
