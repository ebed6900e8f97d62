"""From photos to a georeferenced cloud: one module a stage, wired by `_stages.py` and run by `_runner.py`.

`import jaxba.pipeline` loads nothing else: a worker that runs one stage loads that stage alone (PEP 562).
"""

import importlib
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from jaxba.pipeline._events import Event, Run
    from jaxba.pipeline._runner import run_pipeline
    from jaxba.pipeline._settings import Settings, changed, default_settings, explained, from_toml, to_toml
    from jaxba.pipeline._stages import NAMES, STAGES
    from jaxba.pipeline._status import Status, project_settings, status
    from jaxba.pipeline._summary import stage_lines, summary
    from jaxba.pipeline._workers import Resources

__all__ = [
    "NAMES", "STAGES", "Event", "Resources", "Run", "Settings", "Status", "changed", "default_settings", "explained",
    "from_toml", "project_settings", "run_pipeline", "stage_lines", "status", "summary", "to_toml",
]  # fmt: skip

_MODULE_OF = {
    "NAMES": "_stages",
    "STAGES": "_stages",
    "Event": "_events",
    "Resources": "_workers",
    "Run": "_events",
    "Settings": "_settings",
    "Status": "_status",
    "changed": "_settings",
    "default_settings": "_settings",
    "explained": "_settings",
    "from_toml": "_settings",
    "project_settings": "_status",
    "run_pipeline": "_runner",
    "stage_lines": "_summary",
    "status": "_status",
    "summary": "_summary",
    "to_toml": "_settings",
}


def __getattr__(name: str) -> object:
    if name not in _MODULE_OF:
        raise AttributeError(f"module 'jaxba.pipeline' has no attribute {name!r}")
    globals()[name] = value = getattr(importlib.import_module(f"jaxba.pipeline.{_MODULE_OF[name]}"), name)
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
