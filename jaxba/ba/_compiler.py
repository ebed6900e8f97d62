"""Compiler options: programs that run some tens of times are compiled fast rather than to the last percent of speed.

On a CPU XLA's older loop emitters and LLVM's first optimisation level compile a step in 5.7 s instead of 10.3 s, and
the step takes 2% to 3% longer (18 images with 31k rows: 59.6 instead of 57.6 ms; 40 images with 147k rows: 400 instead
of 390 ms). A block would have to take over 100 s of steps before the default were faster.
"""

import functools
from collections.abc import Callable
from typing import Any

import jax
import numpy as np

_FAST = {"xla_cpu_use_fusion_emitters": False, "xla_backend_optimization_level": 1}


def fast_jit(function: Callable[..., Any]) -> Callable[..., Any]:
    """Return the function jitted with `compiler_options`; its arguments' leaves are arrays.

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


@functools.cache
def compiler_options() -> dict[str, bool | int]:
    """Return the options for `compile` and `jit`; none off the CPU, or where this XLA does not know one of them."""
    if jax.default_backend() != "cpu":
        return {}
    probe = jax.jit(lambda x: x + 1).lower(jax.ShapeDtypeStruct((), np.float32))
    try:
        probe.compile(compiler_options=_FAST)
    except (RuntimeError, ValueError):  # "No such compile option"
        return {}
    return dict(_FAST)
