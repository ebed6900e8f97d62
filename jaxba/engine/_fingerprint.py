"""Fingerprints: equal for equal values, whatever file, folder or process they come from.

`fingerprint(value)` goes over a tree of dataclasses, arrays and plain values; paths count as nothing, since a moved
folder holds the same photos. `code_version(module)` covers the source of a module and of all of jaxba that it imports,
also inside its functions: a changed solver reruns what is solved with it, and nothing else. What a stage's `lines` and
`facts` say of its outputs does not count, nor what is imported for them alone: other words rerun nothing.
"""

import ast
import dataclasses
import enum
import functools
import hashlib
import importlib.util
import sys
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np


def fingerprint(*values: Any) -> str:
    """Return 32 hexadecimal digits of the contents of the values.

    >>> fingerprint((1, "a")) == fingerprint((1, "a")), fingerprint(1) == fingerprint(1.0)
    (True, False)
    """
    state = hashlib.sha256()
    for part in _parts(values):
        state.update(part)
    return state.hexdigest()[:32]


def _parts(value: Any) -> Iterator[bytes | memoryview]:
    """Yield the bytes of a value: a tag of its kind and length before its contents, so that no two trees agree."""
    if isinstance(value, Path):
        return
    if isinstance(value, enum.Enum):
        value = value.value
    if value is None or isinstance(value, bool | int | float | str | bytes):
        text = value if isinstance(value, bytes) else repr(value).encode()
        yield f"{type(value).__name__}{len(text)}:".encode()
        yield text
    elif isinstance(value, np.ndarray | np.generic):
        array = np.ascontiguousarray(value)
        yield f"array{array.dtype.str}{array.shape}:".encode()
        yield array.reshape(-1).view(np.uint8).data
    elif dataclasses.is_dataclass(value) and not isinstance(value, type):
        yield f"{type(value).__name__}(".encode()
        for field in dataclasses.fields(value):
            yield f"{field.name}=".encode()
            yield from _parts(getattr(value, field.name))
        yield b")"
    elif (digests := getattr(value, "digests", None)) is not None:  # stored on disk, digests beside it
        yield from _parts(digests)
    elif isinstance(value, Mapping):
        yield f"map{len(value)}(".encode()
        for key in sorted(value):
            yield from _parts(key)
            yield from _parts(value[key])
        yield b")"
    elif isinstance(value, tuple | list):
        yield f"list{len(value)}(".encode()
        for entry in value:
            yield from _parts(entry)
        yield b")"
    else:
        raise TypeError(f"no fingerprint of a {type(value).__name__}")


@functools.cache
def code_version(module: str) -> str:
    """Return a fingerprint of the source of a stage's module and of all that it imports of jaxba, directly or not.

    The functions `lines` and `facts` of a stage do not count, nor what is imported for them alone. Stages are the
    module itself and the public ones beside it, whose outputs it may import.
    """
    return fingerprint(_reached(module)[0])


def packages(module: str) -> frozenset[str]:
    """Return the packages beside jaxba and Python's own that the same code imports.

    >>> sorted(packages("jaxba.vision._decode"))
    ['PIL', 'cv2', 'jaxtyping', 'numpy']
    """
    return frozenset(name.partition(".")[0] for name in _reached(module)[1]) - sys.stdlib_module_names


@functools.cache
def _reached(module: str) -> tuple[dict[str, bytes], set[str]]:
    """Return the sources of jaxba that a stage's module reaches, by name, and the names of the other modules.

    Behind a package that is imported whole, as in `from jaxba import io`, all of its names are reached.
    """
    assert _source(module) is not None
    package = module.rpartition(".")[0]
    sources, others, waiting = {}, set(), [module]
    while waiting:
        name = waiting.pop()
        path = _source(name)
        if path is None:
            others.add(name)
        elif name not in sources:
            source = path.read_bytes()
            within, _, last = name.rpartition(".")
            is_stage = name == module or (within == package and not last.startswith("_"))
            sources[name], imports = _without_words(source) if is_stage else (source, _imports(source))
            waiting.extend(imports)
            stub = path.with_suffix(".pyi")
            if stub.is_file():
                waiting.extend(_behind(name, stub))
    return sources, others


def _behind(package: str, stub: Path) -> Iterator[str]:
    """Yield the modules that the names of a package come from, which loads them when they are first used."""
    for node in ast.parse(stub.read_bytes()).body:
        if isinstance(node, ast.ImportFrom):
            yield from ([f"{package}.{node.module}"] if node.module else [f"{package}.{a.name}" for a in node.names])


_OF_WORDS = ("lines", "facts")


@functools.cache
def _without_words(source: bytes) -> tuple[bytes, tuple[str, ...]]:
    """Return a stage's source without its functions that only say what was made, and the modules that the rest imports.

    Of the import statements at the top level, the names that the rest uses are kept.
    """
    tree = ast.parse(source)
    says = [node for node in tree.body if isinstance(node, ast.FunctionDef) and node.name in _OF_WORDS]
    imports = [node for node in tree.body if isinstance(node, ast.Import | ast.ImportFrom)]
    lines = source.splitlines(keepends=True)
    for node in (*says, *imports):
        assert node.end_lineno is not None
        lines[node.lineno - 1 : node.end_lineno] = [b""] * (node.end_lineno - node.lineno + 1)
    tree.body = [node for node in tree.body if node not in says]
    used = {node.id for node in ast.walk(tree) if isinstance(node, ast.Name)}
    for node in imports:
        node.names = [alias for alias in node.names if (alias.asname or alias.name).partition(".")[0] in used]
    kept = [ast.unparse(node) for node in imports if node.names]  # the same name may come to stand for something else
    return b"".join(lines) + "\n".join(kept).encode(), tuple(sorted(_imported(tree)))


@functools.cache
def _source(module: str) -> Path | None:
    """Return the file of a module of jaxba; None for other modules."""
    if not module.startswith("jaxba."):
        return None
    found = importlib.util.find_spec("jaxba")
    assert found is not None and found.origin is not None
    path = Path(found.origin).parent.joinpath(*module.split(".")[1:])
    for candidate in (path.with_suffix(".py"), path / "__init__.py"):
        if candidate.is_file():
            return candidate
    return None


@functools.cache  # stages have most modules in common, and each is parsed once: 0.35 s for all of them instead of 1.0
def _imports(source: bytes) -> tuple[str, ...]:
    """Return the modules that a source imports."""
    return tuple(_imported(ast.parse(source)))


def _imported(tree: ast.Module) -> Iterator[str]:
    """Yield the modules that are imported; a name from a package of jaxba is followed to where it is defined."""
    for node in _statements(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module and node.module.partition(".")[0] == "jaxba":
            yield from (_home(node.module, alias.name) for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module:
            yield node.module


def _statements(node: ast.AST) -> Iterator[ast.AST]:
    """Yield the statements in a node, not their expressions, which hold no imports and take most of a walk's time."""
    for part in ("body", "handlers", "orelse", "finalbody", "cases"):
        for child in getattr(node, part, ()):
            yield child
            yield from _statements(child)


@functools.cache
def _home(module: str, name: str) -> str:
    """Return the module behind `from module import name`: a submodule, the source of a package's name, or itself."""
    if _source(f"{module}.{name}") is not None:
        return f"{module}.{name}"
    path = _source(module)
    if path is None or path.name != "__init__.py":
        return module
    origin = _origins(path).get(name)
    if origin is None:
        return module
    level, within = origin
    return _home(f"{module}.{within}" if level else within, name)


@functools.cache
def _origins(path: Path) -> dict[str, tuple[int, str]]:
    """Return where the names of a package come from: the level of the import, 0 if absolute, and the module."""
    stub = path.with_suffix(".pyi")  # of a package whose names load their modules when they are first used
    found: dict[str, tuple[int, str]] = {}
    for node in _statements(ast.parse((stub if stub.is_file() else path).read_bytes())):
        if isinstance(node, ast.ImportFrom) and node.module:
            for alias in node.names:
                found.setdefault(alias.name, (node.level, node.module))
    return found
