"""`quick_jit`: for references, derivatives and eager code of tests, which run once and over a few numbers."""

from collections.abc import Callable
from typing import Any

import jax

# on a CPU: a third of the time to compile; the numbers are those of `jax.jit` but for rounding
OPTIONS = {"xla_cpu_use_fusion_emitters": False, "xla_backend_optimization_level": 0}


def quick_jit(function: Callable[..., Any], **options: Any) -> Callable[..., Any]:
    """Return `jax.jit(function)`, compiled fast instead of to run fast."""
    return jax.jit(function, compiler_options=OPTIONS if jax.default_backend() == "cpu" else None, **options)
