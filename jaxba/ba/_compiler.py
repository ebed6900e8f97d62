"""Compiler options: programs are compiled fast rather than to the last percent of speed.

On a CPU XLA's older loop emitters and LLVM's first optimisation level compile a step in 2.9 s instead of 4.4 s, and the
step takes as long: 100 images with 376k rows 814 ms either way, 150 images with 1.1M rows 2.59 instead of 2.61 s.
"""

import functools
from collections.abc import Callable
from typing import Any

import jax
import numpy as np

from jaxba.ba._kept_programs import Program, program

_FAST = {"xla_cpu_use_fusion_emitters": False, "xla_backend_optimization_level": 1}


def fast_jit(function: Callable[..., Any]) -> Callable[..., Any]:
    """Return the function jitted to compile fast, for programs that run some tens of times (`compiler_options`).

    Its arguments' leaves are arrays; nothing compiles, and no backend starts, before the first call.

    >>> import numpy as np
    >>> fast_jit(lambda x: 2 * x)(np.ones(2)).tolist()
    [2.0, 2.0]
    """

    @functools.cache
    def compiled() -> Callable[..., Any]:  # the options are asked for at the first call: importing starts no backend
        return jax.jit(function, compiler_options=compiler_options())

    @functools.wraps(function)
    def call(*arguments: Any) -> Any:
        return compiled()(*arguments)

    return call


def call_compiled(function: Callable[..., Any], *arguments: Any) -> Any:
    """Call a function of concrete arrays, compiled ahead with `compiler_options`.

    For use inside the rule of a derivative, where the values are known: `jit` would compile once under each of jax's
    traces, and takes no options there. `function` is a module's own, or another one would be compiled at each call.

    >>> import numpy as np
    >>> call_compiled(jax.numpy.negative, np.ones(2)).tolist()
    [-1.0, -1.0]
    """
    return compile_ahead(function, *arguments)(*arguments)


def compile_ahead(function: Callable[..., Any], *arguments: Any) -> Callable[..., Any]:
    """Return what `call_compiled` calls for arguments of these shapes, which may be `jax.ShapeDtypeStruct`s."""
    return _ahead(function, *shapes_of(arguments), platform())


def result_shapes(function: Callable[..., Any], *arguments: Any) -> Any:
    """Return what `call_compiled` would return, a tree of `jax.ShapeDtypeStruct`s; a kept program tells it untraced."""
    return _program(function, *shapes_of(arguments), platform()).result


Shapes = tuple[tuple[tuple[int, ...], str], ...]


def shapes_of(arguments: Any) -> tuple[Any, Shapes]:
    """Return the structure of a tree of arrays, numbers or shapes, and shape and type of its leaves."""
    leaves, structure = jax.tree.flatten(arguments)
    return structure, tuple((jax.numpy.shape(leaf), jax.numpy.result_type(leaf).name) for leaf in leaves)


def of_shapes(structure: Any, shapes: Shapes) -> Any:
    """Return the tree of `jax.ShapeDtypeStruct`s that `shapes_of` has taken apart."""
    return jax.tree.unflatten(structure, [jax.ShapeDtypeStruct(shape, dtype) for shape, dtype in shapes])


@functools.lru_cache(maxsize=64)
def _ahead(function: Callable[..., Any], *shapes: Any) -> Callable[..., Any]:
    return _program(function, *shapes).compiled()


@functools.lru_cache(maxsize=16)  # each holds what it was lowered to
def _program(function: Callable[..., Any], structure: Any, shapes: Shapes, _: str) -> Program:
    return program(function, of_shapes(structure, shapes), compiler_options(), made_from=function)


def platform() -> str:
    """Return where programs run: `cpu`, `gpu` or another name of jax's; see `jax_default_device`."""
    device = jax.config.jax_default_device  # pyright: ignore[reportAttributeAccessIssue]
    return jax.default_backend() if device is None else getattr(device, "platform", str(device))


def compiler_options() -> dict[str, Any]:
    """Return the options for `compile` and `jit`; none off the CPU, or where this XLA does not know one of them."""
    return _options_of_cpu() if platform() == "cpu" else {}


@functools.cache
def _options_of_cpu() -> dict[str, Any]:
    probe = jax.jit(lambda x: x + 1).lower(jax.ShapeDtypeStruct((), np.float32))
    try:
        probe.compile(compiler_options=_FAST)
    except (RuntimeError, ValueError):  # "No such compile option"
        return {}
    return dict(_FAST)
