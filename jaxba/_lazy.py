"""Packages whose names load their modules when they are first used (PEP 562), so that importing them costs nothing."""

import importlib
import sys
from collections.abc import Callable, Mapping


def lazy(
    package: str, module_of: Mapping[str, str], modules: Mapping[str, str] | None = None
) -> tuple[Callable[[str], object], Callable[[], list[str]]]:
    """Return `__getattr__` and `__dir__` of a package.

    - `module_of`: the full name of the module that defines each name.
    - `modules`: the same for names that are modules themselves.

    Asking for another name raises `AttributeError`, as a plain package does.
    """
    modules = {} if modules is None else modules

    def load(name: str) -> object:
        if name in module_of:
            value = getattr(importlib.import_module(module_of[name]), name)
        elif name in modules:
            value = importlib.import_module(modules[name])
        else:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        setattr(sys.modules[package], name, value)
        return value

    def names() -> list[str]:
        loaded = vars(sys.modules[package])
        dunders = (name for name in loaded if name.startswith("__"))
        return sorted({*dunders, *loaded.get("__all__", ()), *module_of, *modules})

    return load, names
