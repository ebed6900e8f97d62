"""The command line: `solve`, `info` and `synthetic`; it parses, calls and prints, and does no maths of the adjustment.

`_main` parses, with one module behind each command; `_options` holds what `solve` takes. jax, numpy and scipy are imported
inside the commands, so that `--help` and a mistyped option answer at once (0.3 s, nearly all of it the parser).
"""

from jaxba.cli._main import main

__all__ = ["main"]
