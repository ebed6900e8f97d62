"""Files to types and back: `tile.npz` (all that a problem holds) and BAL text; files that appear whole or not at all.

`import jaxba.io` loads no jax, so that a program that only writes files stays light: the readers and writers of
problems load it when they are first used (PEP 562).
"""

import importlib
from typing import TYPE_CHECKING

from jaxba.io._atomic import refuse_same_file, write_atomically

if TYPE_CHECKING:
    from jaxba.io._bal import read_bal, what_bal_cannot_hold, write_bal
    from jaxba.io._problem import read_problem
    from jaxba.io._schema import SCHEMA, schema_markdown
    from jaxba.io._tile import read_tile, write_tile

__all__ = [
    "SCHEMA", "read_bal", "read_problem", "read_tile", "refuse_same_file", "schema_markdown", "what_bal_cannot_hold",
    "write_atomically", "write_bal", "write_tile",
]  # fmt: skip

_MODULE_OF = {
    "SCHEMA": "jaxba.io._schema",
    "read_bal": "jaxba.io._bal",
    "read_problem": "jaxba.io._problem",
    "read_tile": "jaxba.io._tile",
    "schema_markdown": "jaxba.io._schema",
    "what_bal_cannot_hold": "jaxba.io._bal",
    "write_bal": "jaxba.io._bal",
    "write_tile": "jaxba.io._tile",
}


def __getattr__(name: str) -> object:
    if name not in _MODULE_OF:
        raise AttributeError(f"module 'jaxba.io' has no attribute {name!r}")
    globals()[name] = value = getattr(importlib.import_module(_MODULE_OF[name]), name)
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
