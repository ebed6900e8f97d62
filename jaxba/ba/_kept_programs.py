"""Programs that were compiled once are kept on the disk as they are, so that a later process traces nothing.

jax's persistent cache finds a program by what it was lowered to: tracing and lowering, which take about as long as
reading the compiled code, are done again by every process. Here a program is found by what it is made from: the source
of this package and of `jaxba.geometry`, the versions of what they stand on, the settings of jax, the processor that
jax's cache folder is for, and the function with the shapes and static fields of its arguments. Kept where jax's cache
is (`jax_compilation_cache_dir`), and not at all without one, off the CPU, or where a class or function from elsewhere
takes part, whose source nobody has read.

`JAXBA_KEEP_PROGRAMS=0` in the environment turns it off. An executable that jax has read from its cache lacks a part of
its code when it is written again, and fails only when another process calls it; jax also keeps it in memory, where it
tells of no hit. So nothing is written but what jax tells that it has compiled just now.
"""

import functools
import hashlib
import importlib.metadata
import io
import logging
import os
import pickle
import threading
import zlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from types import FunctionType
from typing import Any, NamedTuple

import jax
import numpy as np
from jax.experimental import serialize_executable

from jaxba._atomic import write_atomically
from jaxba._errors import JaxbaError

_log = logging.getLogger(__name__)
_PACKAGE = Path(__file__).parents[1]
_SOURCES = ("ba", "geometry")
_READ = tuple(f"jaxba.{name}." for name in _SOURCES)
_STANDS_ON = ("jax", "jaxlib", "equinox", "optimistix", "numpy")
_CODE = ".code"
_OTHERS = ("builtins", "numpy", "equinox.", "optimistix.")
_CHANGE_NO_PROGRAM = ("cache", "log", "dump", "traceback", "leak", "guard")  # in names of jax's settings


class Program(NamedTuple):
    """A program for arguments of known shapes.

    - `result`: what it returns, a tree of `jax.ShapeDtypeStruct`s. `compiled`: returns what to call; here time goes.
    """

    result: Any
    compiled: Callable[[], Any]


def program(
    function: Callable[..., Any], arguments: tuple[Any, ...], options: dict[str, Any], *, made_from: Any
) -> Program:
    """Return a function's program, as an earlier call has kept it or else traced and lowered.

    - `arguments`: trees of `jax.ShapeDtypeStruct`s. `options`: of the compiler.
    - `made_from`: what the function depends on beside its arguments: static values, or itself where it is a module's.
    """
    folder, taken, settings = _folder(), _pickled(_shapes(arguments)), _settings()
    origin = _pickled((function.__name__, made_from, options, settings, _versions(), _source()))
    known = None
    if folder is not None and taken is not None and origin is not None:
        known = folder / _digest(origin, taken)
        found = _read(known, arguments)
        if found is not None:
            return found
    # every argument stands in what is lowered, so that its text tells which of two alike a program uses
    traced = jax.jit(function, keep_unused=True).trace(*arguments)
    lowered = traced.lower()

    def compiled() -> Any:
        if known is None or taken is None:
            return lowered.compile(compiler_options=options)
        text = lowered.as_text().encode()
        path = known.with_name(_digest(text, taken, repr((options, settings, _versions())).encode()) + _CODE)
        made = _loaded(path, arguments, traced.out_info)
        if made is None:
            before = _COMPILED.count
            made = lowered.compile(compiler_options=options)
            if _COMPILED.count == before:  # had by jax, on the disk or in memory: what was read cannot be written again
                return made
            _write(path, lambda: zlib.compress(serialize_executable.serialize(made)[0], level=1))
        _write(known, lambda: _pickled((path.name, _shapes(traced.out_info))))
        return made

    return Program(traced.out_info, compiled)


def _digest(*parts: bytes) -> str:
    return hashlib.sha256(b"".join(hashlib.sha256(part).digest() for part in parts)).hexdigest()


def _shapes(tree: Any) -> Any:
    return jax.tree.map(lambda leaf: _Leaf(leaf.shape, leaf.dtype.name), tree)


@dataclass(frozen=True)
class _Leaf:
    shape: tuple[int, ...]
    dtype: str


def _folder() -> Path | None:
    """Return where programs are kept; None where they are not."""
    config: Any = jax.config
    given = config.jax_compilation_cache_dir if os.environ.get("JAXBA_KEEP_PROGRAMS") != "0" else None
    if not given or not config.jax_enable_compilation_cache or not os.path.isdir(given):
        return None
    return Path(given) / "jaxba" if jax.default_backend() == "cpu" and jax.device_count() == 1 else None


class _Pickler(pickle.Pickler):
    """Refuses what is made by code that may change unseen."""

    def reducer_override(self, obj: Any) -> Any:
        if isinstance(obj, type | FunctionType) and not obj.__module__.startswith((*_READ, *_OTHERS)):
            raise pickle.PicklingError(f"{obj.__module__}.{obj.__qualname__} is not of jaxba")
        return NotImplemented


def _pickled(value: Any) -> bytes | None:
    """Return bytes that are equal for equal values; None of what holds code from elsewhere."""
    with io.BytesIO() as file:
        pickler = _Pickler(file, protocol=5)
        pickler.fast = True  # no reference to what came before, which one value may have and its equal not
        try:
            pickler.dump(value)
        except (pickle.PicklingError, TypeError, AttributeError, ValueError) as error:
            _log.debug("a program is not kept: %s", error)
            return None
        return file.getvalue()


def _settings() -> tuple[tuple[str, str], ...]:
    names = [name for name in jax.config.values if not any(word in name for word in _CHANGE_NO_PROGRAM)]
    found = [(name, repr(getattr(jax.config, name, None))) for name in sorted(names)]
    return (*found, *((name, os.environ.get(name, "")) for name in ("XLA_FLAGS", "JAX_PLATFORMS")))


@functools.cache
def _versions() -> tuple[str, ...]:
    return tuple(importlib.metadata.version(name) for name in _STANDS_ON)


@functools.cache
def _source() -> bytes:
    """Return a digest of the modules that programs are made by."""
    digest = hashlib.sha256()
    for path in sorted(path for name in _SOURCES for path in (_PACKAGE / name).rglob("*.py")):
        digest.update(f"{path.relative_to(_PACKAGE).as_posix()}\n".encode() + path.read_bytes())
    return digest.digest()


class _Compiled(threading.local):
    """Counts what jax has compiled and written in this thread; what it has in memory it does not tell of."""

    count = 0

    def __call__(self, event: str, **_: Any) -> None:
        self.count += event == "/jax/compilation_cache/cache_misses"


_COMPILED = _Compiled()
jax.monitoring.register_event_listener(_COMPILED)


def _read(known: Path, arguments: tuple[Any, ...]) -> Program | None:
    """Return the program of a file; None where there is none that can be read."""
    try:
        name, result = pickle.loads(known.read_bytes())
        leaves, tree = jax.tree.flatten(result)
        result = jax.tree.unflatten(tree, [jax.ShapeDtypeStruct(leaf.shape, leaf.dtype) for leaf in leaves])
    except FileNotFoundError:
        return None
    except Exception as error:  # whatever a damaged file may raise: the program is made anew, and the file with it
        _log.info("a kept program cannot be read: %s", error)
        return None
    loaded = _loaded(known.with_name(name), arguments, result)
    return None if loaded is None else Program(result, lambda: loaded)


@functools.cache
def _make_lapack_known() -> None:
    """Lower a factorisation: jaxlib finds LAPACK's functions then, and a loaded program would call none."""
    jax.jit(jax.numpy.linalg.cholesky).lower(jax.ShapeDtypeStruct((1, 1), np.float32))


def _loaded(path: Path, arguments: tuple[Any, ...], result: Any) -> Any:
    """Return what a file's code is called by; None where there is none that can be read."""
    try:
        _make_lapack_known()
        code = zlib.decompress(path.read_bytes())
        trees = jax.tree.structure((arguments, {})), jax.tree.structure(result)
        return serialize_executable.deserialize_and_load(code, *trees)
    except FileNotFoundError:
        return None
    except Exception as error:  # as above
        _log.info("a kept program cannot be read: %s", error)
        return None


def _write(path: Path, content: Callable[[], bytes | None]) -> None:
    """Keep what there is to keep, where that is possible."""
    try:
        found = content()
        if found is not None:
            path.parent.mkdir(exist_ok=True)
            with write_atomically(path) as file:
                file.write(found)
    except (ValueError, NotImplementedError, OSError, JaxbaError) as error:  # constants in it, a full disk
        _log.info("a program is not kept: %s", error)
