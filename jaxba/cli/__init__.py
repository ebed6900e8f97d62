"""The command line: `run`, `simulate`, `solve`, `info`, `synthetic`; it parses, calls and prints, and does no maths.

`_main` parses, with one module behind each command; `_options` holds what `solve` takes. jax, numpy and scipy are
loaded by the command's own module, so that `--help` and a mistyped option answer at once (0.2 s, nearly all of it the
parser).
"""

from jaxba.cli._main import main

__all__ = ["main"]
